"""How much two workers gain over one: a sweep over seeds of one scene, timed from the command to its end.

    python benchmarks/workers.py [scenes=ball profile=smoke ...]        (make bench-workers; not a part of make bench)

Every sweep starts on an empty shelf, so that nothing is reused but what its variants share. The first row warms up: it
compiles kernels, and is not counted. The start of Prefect, of MLflow and of the workers is counted, as a person waits
for it.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RUNNERS = ("thread", "process", "dask")


def seconds(words: list[str]) -> float:
    """How long a sweep on an empty shelf takes [s]. Ends the benchmark if it fails."""
    with tempfile.TemporaryDirectory(prefix="physics3d_workers_") as folder:
        started = time.monotonic()
        call = [sys.executable, "-m", "pipeline.sweep", *words, f"output={folder}"]
        done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True)
        if done.returncode:
            sys.exit(done.stdout[-2000:] + done.stderr[-2000:])
        return time.monotonic() - started


def main(words: list[str]) -> None:
    words = words or ["scenes=ball", "profile=smoke"]
    words = [*words, *([] if any(w.startswith("seeds=") for w in words) else ["seeds=0,1"])]
    seconds([*words, "runner=process", "workers=1"])
    print(f"{' '.join(words)}, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(f"{'runner':>8} {'1 worker':>9} {'2 workers':>10} {'gain':>6}")
    for runner in RUNNERS:
        one, two = (seconds([*words, f"runner={runner}", f"workers={n}"]) for n in (1, 2))
        print(f"{runner:>8} {one:>7.1f} s {two:>8.1f} s {one / two:>6.2f}", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(sys.argv[1:])
