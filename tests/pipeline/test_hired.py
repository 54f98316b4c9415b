"""A command that was interrupted ends, whatever its libraries wait for."""

import subprocess
import sys
from pathlib import Path

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
    state = Path(f"/proc/{int(done.stdout)}/stat")
    assert not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z"


def test_what_ends_by_itself_is_not_waited_for():
    done = subprocess.run([sys.executable, "-c", ENDS], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 7, done.stderr
