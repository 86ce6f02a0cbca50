"""What JSON texts say, as people's editors leave them."""

import pytest

from etsplat.io.json_text import parse_json


def test_a_mark_of_the_byte_order_says_nothing():
    """Notepad puts one before what it saves."""
    assert parse_json('\ufeff{"frames": []}') == parse_json('{"frames": []}'.encode("utf-8-sig")) == {"frames": []}
    with pytest.raises(ValueError, match="Expecting value"):
        parse_json("\ufeff")
