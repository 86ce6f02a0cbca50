"""Errors of the package's own."""


class InputError(ValueError):
    """Input that somebody handed in is unusable.

    The message is one line that names the file or argument, says what is wrong and what to do. The command line prints
    it without a traceback. Wrong shapes, dtypes and devices of tensors are plain ``ValueError``.
    """


class EngineUnavailableError(InputError):
    """An engine was asked for that cannot run here; the line says what is missing and how to get it."""
