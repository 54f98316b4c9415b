"""Processes that end when they should. Workers end with the process that hired them: one that is killed outright can
tell nobody, and its workers would compute on beside the run that goes on in its place. A command that was interrupted
ends though a library waits for a server that is gone."""

import contextlib
import multiprocessing
import os
import sys
import threading

LINGER = 20.0  # libraries have to tell their servers the last things, after an interrupt [s]


def end_with_hirer() -> None:
    """In a process that another one has spawned: from now on, end when that ends. Elsewhere, or once more, nothing."""
    hirer, name = multiprocessing.parent_process(), "end with hirer"
    if hirer is None or any(thread.name == name for thread in threading.enumerate()):
        return

    def wait() -> None:
        hirer.join()
        os._exit(1)  # what is under way is in checkpoints

    threading.Thread(target=wait, name=name, daemon=True).start()


def end_within(code: int, seconds: float = LINGER) -> None:
    """Let this process end by itself in that time [s]; then end it with this exit code, and what it has started.

    Prefect waits at the end until its server has taken all events, however long: half an hour was seen after SIGTERM.
    """

    def end() -> None:
        import psutil

        for child in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error):
                child.kill()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
