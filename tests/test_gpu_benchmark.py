"""`make bench-gpu` on the CPU, small: it runs without what it says it does not need, and writes no lies."""

import subprocess
import sys
from pathlib import Path

import gpu
import pytest

ROOT = Path(__file__).resolve().parent.parent
NOT_NEEDED = ("prefect", "open3d", "mlflow", "imageio_ffmpeg", "hydra", "omegaconf", "torchmetrics", "yaml", "pytest")
SCRIPT = f"""
import socket, sys
from importlib.abc import MetaPathFinder
from pathlib import Path

class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {NOT_NEEDED}:
            raise ModuleNotFoundError(f"{{name}} is blocked", name=name)

def no_network(*_):
    raise OSError("there is no network")

sys.meta_path.insert(0, Absent())
socket.socket.connect = no_network
import gpu
rows = list(gpu.measured("cpu", 0, gpu.SIZES["tiny"], ""))
assert not gpu.disagreements(rows), gpu.disagreements(rows)
gpu.write(rows, "a machine", 0, 1.0, Path(sys.argv[1]))
"""


def test_all_of_it_runs_without_what_it_does_not_need(tmp_path):
    """What it says of time is not looked at: the bodies are so small that it means nothing."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path)], cwd=ROOT / "benchmarks", capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gpu.csv", "gpu.md", "gpu.png"]
    page = (tmp_path / "gpu.md").read_text()
    for what in (
        "| grid, viscoelastic, one branch | device against CPU |",
        "| grid, implicit | device against CPU |",
        "| without a grid | device against CPU |",
        "| renderer | device against CPU |",
        "particle-substeps per second",
        "share of the bandwidth",
        "| fixed corotated | as a graph |",
        "| memory | forward + adjoint |",
        "| carnation | reconstruct |",
        "| carnation | a step of learning by the grid |",
    ):
        assert what in page, what


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        # faster with its adjoint than without
        (dict(kind="forward + adjoint", value=4.0), "does more"),
        # and a device that computes something else
        (dict(kind="device against CPU", unit="relative difference", value=0.1, spread=1e-8), "differs from the CPU"),
    ],
)
def test_rows_that_cannot_be_true_fail_the_command_and_leave_no_page(wrong, said, tmp_path, capsys):
    rows = [gpu.row("fixed corotated", "forward", 1000, 5.0, gpu.PER_SUBSTEP)]
    rows.append(rows[0] | wrong)
    with pytest.raises(SystemExit, match=said):
        gpu.finish(rows, "a machine", 0, 1.0, tmp_path)
    assert not list(tmp_path.iterdir())
