"""Kill a whole run in each of its eight stages, one run after the other, then let it finish, and count what that cost.

    python benchmarks/kills.py [scene=carnation profile=smoke ...]        (make bench-kills; not a part of make bench)

A run is killed with SIGKILL as soon as a stage has begun to write, in those that keep checkpoints once more in their
midst, and started again. The work lost is what a stage did since its last checkpoint, or since it began. It fails if
that is more than half a minute, if a result that was finished is lost or computed twice, if something half-done passes
for finished, if a Prefect server outlives its run, or if MLflow shows a run as running whose process is gone.
"""

import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from physics3d.log import CHECKPOINT
from pipeline.stage import read_manifest

STAGES = ("capture", "reconstruct", "segment", "fill", "learn", "simulate", "render", "evaluate")
MIDST = {"reconstruct": 4.0, "learn": 15.0}  # of stages that keep checkpoints, after they said their first line [s]
MOST = 30.0  # of work may be lost [s]


def start(words: list[str], output: Path) -> subprocess.Popen:
    call = [sys.executable, "-m", "pipeline", *words, f"output={output}"]
    with (output / "lines.txt").open("a") as lines:
        return subprocess.Popen(call, cwd=ROOT, stdout=lines, stderr=lines)


def finished(output: Path) -> dict[Path, float]:
    """Results by folder, with the time they were filed; each is looked at as a whole."""
    found = {}
    for folder in (output / "artifacts").glob("[!.]*/[!.]*"):
        for name, (size, _) in read_manifest(folder)["files"].items():
            assert (folder / name).stat().st_size == size, f"{folder / name} is not whole"
        found[folder] = (folder / "manifest.json").stat().st_mtime
    return found


def servers(output: Path) -> int:
    """Processes of Prefect that have their home below the output folder."""
    count = 0
    for entry in Path("/proc").glob("[0-9]*/environ"):
        try:
            home = f"PREFECT_HOME={output / '.prefect'}".encode() in entry.read_bytes()
            count += home and b"uvicorn" in entry.with_name("cmdline").read_bytes()
        except OSError:  # not ours, or just ended
            continue
    return count


def killed_in(stage: str, words: list[str], output: Path, after: float) -> tuple[float, float]:
    """(seconds that a run took until it was killed in a stage, `after` so many at work in it, seconds of work lost)."""
    started = time.monotonic()
    lines = output / "lines.txt"
    told = lines.stat().st_size if lines.exists() else 0
    process = start(words, output)
    begun, kept, last = None, None, 0.0
    while begun is None or time.monotonic() < begun + after:
        if process.poll() is not None or any((output / "artifacts" / stage).glob("[!.]*")):
            sys.exit(f"{stage} is over, or was not begun:\n{lines.read_text()[-2000:]}")
        said = lines.read_text()[told:] if lines.exists() else ""
        if begun is None and any((output / "artifacts" / stage).glob(".*")) and (not after or f"{stage} |" in said):
            begun = last = time.monotonic()
        for path in (output / "artifacts" / stage).glob(f".*/{CHECKPOINT}"):
            if (now := path.stat().st_ino) != kept and begun:  # it is never changed, only replaced
                kept, last = now, time.monotonic()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    return time.monotonic() - started, time.monotonic() - last


def main(words: list[str]) -> None:
    words = words or ["scene=carnation", "profile=smoke"]
    with tempfile.TemporaryDirectory(prefix="physics3d_kills_") as folder:
        output, seen = Path(folder), {}
        print(f"{'killed in':>12} {'after':>8} {'finished':>9} {'lost':>8}")
        kills = [(stage, after) for stage in STAGES for after in sorted({0.0, MIDST.get(stage, 0.0)})]
        for stage, after in kills:
            seconds, lost = killed_in(stage, words, output, after)
            assert lost < MOST, f"{lost:.0f} s of work in {stage} are lost"
            now = finished(output)
            assert seen.items() <= now.items(), f"lost, or computed twice: {[*dict(seen.items() - now.items())]}"
            assert not list((output / "artifacts" / stage).glob("[!.]*")), f"{stage} passes for finished"
            seen = now
            print(f"{stage:>12} {seconds:>6.1f} s {len(now):>9} {lost:>6.1f} s", flush=True)
        process = start(words, output)
        code, now = process.wait(), finished(output)
        assert code == 0, (output / "lines.txt").read_text()[-2000:]
        assert seen.items() <= now.items(), "lost, or computed twice"
        assert not list((output / "artifacts").glob("[!.]*/.*")), "something unfinished was left"
        deadline = time.monotonic() + 30
        while servers(output) and time.monotonic() < deadline:
            time.sleep(0.2)
        assert servers(output) == 0, "a Prefect server outlived its run"
        with sqlite3.connect(output / "mlflow.db") as record:
            states = dict(record.execute("select status, count(*) from runs group by status").fetchall())
        assert "RUNNING" not in states, states
        again = subprocess.run([sys.executable, "-m", "pipeline", *words, f"output={output}"], cwd=ROOT, stdout=-1)
        assert b"up to date" in again.stdout
        print(
            f"{'nothing':>12} {'':>8} {len(now):>9}\n{len(kills)} kills: no result lost, none computed twice; {states}"
        )


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(sys.argv[1:])
