import json

import pytest

from etsplat.core.errors import InputError
from etsplat.io.georeference import Georeference

SOMEWHERE = Georeference((500_000.125, 5_400_000.0625, 300.5), 0.5, "z", "EPSG:25832")


def test_it_comes_back_as_it_was_to_the_last_bit(tmp_path):
    SOMEWHERE.write(tmp_path)
    assert Georeference.read(tmp_path / "georeference.json") == SOMEWHERE
    assert Georeference.from_json('{"offset": [1, 2, 3]}', "text") == Georeference((1.0, 2.0, 3.0))


def test_a_frame_within_a_frame_is_composed():
    """x_world = offset + scale (x + shift)."""
    assert SOMEWHERE.after((2.0, 4.0, -1.0)).offset == (500_001.125, 5_400_002.0625, 300.0)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ([1, 2, 3], "holds no JSON object"),
        ({"scale": 1}, "no offset of three numbers"),
        ({"offset": [1, 2]}, "no offset of three numbers"),
        ({"offset": [1, 2, float("nan")]}, "no offset of three numbers"),
        ({"offset": [1, 2, True]}, "no offset of three numbers"),
        ({"offset": [1, 2, 3], "scale": 0}, "has a scale that is not"),
        ({"offset": [1, 2, 3], "scale": "2"}, "has a scale that is not"),
        ({"offset": [1, 2, 3], "up": "x"}, "has up = 'x'; it must be y or z"),
        ({"offset": [1, 2, 3], "crs": 25832}, "has a crs that is no text"),
        ({"offset": [1, 2, 3], "zone": 32}, "has 'zone', which is not understood"),
    ],
)
def test_what_it_cannot_mean_is_named(tmp_path, said, message):
    (tmp_path / "georeference.json").write_text(json.dumps(said))
    with pytest.raises(InputError, match=message) as raised:
        Georeference.read(tmp_path / "georeference.json")
    assert "\n" not in str(raised.value)
    (tmp_path / "georeference.json").write_text("{")
    with pytest.raises(InputError, match="not valid JSON"):
        Georeference.read(tmp_path / "georeference.json")
