"""Workers that end with the process that hired them: one that is killed outright can tell nobody, and its workers would
compute on beside the run that goes on in its place."""

import multiprocessing
import os
import threading


def end_with_hirer() -> None:
    """In a process that another one has spawned: from now on, end when that ends. Elsewhere, or once more, nothing."""
    hirer, name = multiprocessing.parent_process(), "end with hirer"
    if hirer is None or any(thread.name == name for thread in threading.enumerate()):
        return

    def wait() -> None:
        hirer.join()
        os._exit(1)  # what is under way is in checkpoints

    threading.Thread(target=wait, name=name, daemon=True).start()
