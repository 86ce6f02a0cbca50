"""Errors that input is answered with."""

import pickle

from etsplat.core.errors import InputError


def test_a_message_is_one_printable_line_whatever_it_names() -> None:
    """Names come from files, which may hold ends of lines, escape sequences of terminals and lone surrogates."""
    error = InputError("scene: 00\n1.jpg\u2028, \x1b[31m, \udc80 and ümlaut.jpg: is missing")
    assert str(error) == r"scene: 00\n1.jpg\u2028, \x1b[31m, \udc80 and ümlaut.jpg: is missing"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
