"""The process of a run on this machine: `LocalExecutor` starts this file.

It reads a pickled `Work` from standard input and writes what `perform` returns to standard output; all that anybody
prints meanwhile goes to standard error. When standard input is closed it is interrupted: whoever started it has ended,
or wants it to end.
"""

import os
import pickle
import signal
import sys
import threading


def main() -> None:
    """Ends with 0 if `perform` returned, with 130 if it was interrupted."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs are started with it ignored
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    try:
        work = pickle.load(sys.stdin.buffer)
        threading.Thread(target=_watch, daemon=True).start()
        from etsplat.tasks.sweeps.work import perform

        text = perform(work)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # nothing is left to be saved
        channel.write(text)
        channel.close()
    except (KeyboardInterrupt, EOFError, BrokenPipeError):
        os._exit(130)  # the thread that watches may hold standard input, which an ordinary end would wait for


def _watch() -> None:
    os.read(0, 1)  # nothing is ever written
    os.kill(os.getpid(), signal.SIGINT)


if __name__ == "__main__":
    sys.path.pop(0)  # this file's folder
    main()
