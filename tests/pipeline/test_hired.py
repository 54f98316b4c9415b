"""A command that was interrupted ends, whatever its libraries wait for."""

import subprocess
import sys
import time
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[2]
HANGS = """
import subprocess, sys, threading, time
from pipeline.hired import end_within

child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(3600)"])
print(child.pid, flush=True)
threading._register_atexit(lambda: time.sleep(3600))  # as Prefect's services wait for their server
end_within(130, 0.5)
"""
ENDS = """
from pipeline.hired import end_within

end_within(130, 3600)
raise SystemExit(7)
"""


def test_what_hangs_at_its_end_is_ended_with_what_it_started():
    """An hour of waiting is cut short, or this does not return; the child is gone, as a server would have to be."""
    done = subprocess.run([sys.executable, "-c", HANGS], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 130, done.stderr
    # `run` has returned, so that nobody holds the pipe any more: the child has ended or is about to
    pid = int(done.stdout)
    left = lambda: psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    for _ in range(1200):  # two minutes, of the hour that it would be there
        if not left():
            break
        time.sleep(0.1)
    assert not left()


def test_what_ends_by_itself_is_not_waited_for():
    done = subprocess.run([sys.executable, "-c", ENDS], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 7, done.stderr
