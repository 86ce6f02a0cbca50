"""Errors of the package's own."""


class InputError(ValueError):
    """Input that somebody handed in is unusable.

    The message is one line that names the file or argument, says what is wrong and what to do. The command line prints
    it without a traceback. Wrong shapes, dtypes and devices of tensors are plain ``ValueError``.

    Example:
        >>> etsplat.load_mesh("nowhere.obj")
        Traceback (most recent call last):
        etsplat.core.errors.InputError: mesh nowhere.obj: no such file; check the path
    """

    def __init__(self, message: str) -> None:
        """Escapes what is not printable: names in files may hold ends of lines and worse."""
        shown = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)
        super().__init__("".join(shown))


class EngineUnavailableError(InputError):
    """An engine was asked for that cannot run here; the line says what is missing and how to get it."""
