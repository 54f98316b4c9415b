"""How many cores work is spread over."""

import subprocess
import sys

import pytest

CONFINED = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})"
ELSEWHERE = "import os; vars(os).pop('sched_getaffinity', None); os.cpu_count = lambda: 6"  # as on macOS


@pytest.mark.parametrize(("where", "cores"), [(CONFINED, "1"), (ELSEWHERE, "6")])
def test_as_many_as_the_process_may_use(where, cores):
    if where == CONFINED and sys.platform != "linux":
        pytest.skip("only Linux confines a process to a core so")
    script = f"{where}; from physics3d.cores import usable; print(usable())"
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert found.split() == [cores]
