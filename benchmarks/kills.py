"""Kill a whole run in each of its stages, and long stages at random moments throughout, and count what that cost.

    make bench-kills [ARGS="scene=ball profile=smoke ..."]   ->   docs/results/kills.md      (not a part of make bench)

First a run that nobody kills. What its long stages filed is taken away, and they are computed again by runs that are
killed with SIGKILL at random moments, until one gets to its end: that has to leave the same bytes. The work lost is
what a stage did since its last checkpoint, or since it began; what is done again is that, and whatever comes before a
run is where it was. Then, in another folder, a run is killed as soon as a stage has begun to write, and started again,
until it is through. It fails if more than half a minute is lost, if a result differs, is lost or computed twice, if
something half-done passes for finished, if a Prefect server outlives its run, or if MLflow shows a run as running whose
process is gone.
"""

import csv
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import textwrap
import time
from contextlib import nullcontext
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from machine import machine

from physics3d.log import CHECKPOINT, LINES
from pipeline.stage import MANIFEST, read_manifest

STAGES = ("capture", "reconstruct", "segment", "fill", "learn", "simulate", "render", "foretell", "evaluate")
MOST = 30.0  # of work may be lost [s]
LONG = ("reconstruct", "learn")  # stages that are killed throughout
KILLS = 5  # in each of them, or more
RESULTS = ROOT / "docs" / "results"
WHAT = """
Stages that take long were killed with SIGKILL at random moments throughout until a run got to their end. All of them
then left the bytes of the run that nobody killed. At most half a minute of work may be lost; what is done again is
that, and what comes before a run is where it was. Not counted is the start of the program, ten seconds or more.
"""
COLUMNS = ("run", "stage", "seconds", "kills", "most_lost", "again")


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


def attempt(stage: str, words: list[str], output: Path, after: float) -> float | None:
    """Seconds of work that are lost where a run is killed that has been at work in a stage for `after` seconds, or has
    a folder there, if that is 0; None if it got to the end of the stage, and its own."""
    lines, shelf = output / "lines.txt", output / "artifacts" / stage
    told = lines.stat().st_size if lines.exists() else 0
    process = start(words, output)
    begun, kept, last = None, None, 0.0
    while begun is None or time.monotonic() < begun + after:
        ended = process.poll() is not None
        if any(shelf.glob("[!.]*")):
            if process.wait():
                sys.exit(lines.read_text()[-2000:])
            return None
        if ended:
            sys.exit(f"{stage} was not begun:\n{lines.read_text()[-2000:]}")
        said = lines.read_bytes()[told:] if lines.exists() else b""
        if begun is None and any(shelf.glob(".*")) and (not after or f"{stage} |".encode() in said):
            begun = last = time.monotonic()
        for path in shelf.glob(f".*/{CHECKPOINT}"):
            if (now := path.stat().st_ino) != kept and begun:  # it is never changed, only replaced
                kept, last = now, time.monotonic()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    lost = time.monotonic() - last
    assert lost < MOST, f"{lost:.0f} s of work in {stage} are lost"
    if finished(output).keys() & set(shelf.iterdir()):  # in the last moment
        return None
    return lost


def killed_throughout(stage: str, words: list[str], output: Path) -> dict[str, str]:
    """A row of the table: what a stage filed is computed again, under kills."""
    (filed,) = (output / "artifacts" / stage).glob("[!.]*")
    aside = output / f"{stage}, not killed"
    shutil.copytree(filed, aside)
    seconds, rng = read_manifest(aside)["seconds"], random.Random(0)
    longest = max(2 * seconds / KILLS, min(seconds, 10.0))  # a run that is killed again at once gets nowhere
    losses: list[float] = []
    took = 0.0
    turns = 0
    while len(losses) < KILLS:
        shutil.rmtree(filed)
        turns += 1
        while (lost := attempt(stage, words, output, after := rng.uniform(0.5, longest))) is not None:
            losses.append(lost)
            print(f"{stage:>12} {after:>6.1f} s {lost:>6.1f} s", flush=True)
        took += read_manifest(filed)["seconds"]
        before, now = files(aside), files(filed)
        different = [name for name in before | now if before.get(name) != now.get(name)]
        assert not different, f"{stage}: {different} are not those of the run that nobody killed"
    again = max(took + sum(losses) - turns * seconds, 0.0) / len(losses)
    numbers = dict(seconds=seconds, kills=len(losses), most_lost=max(losses), again=again)
    said = " ".join(word for word in words if not word.startswith(("data=", "output=")))  # those are of one machine
    return dict(run=said, stage=stage) | {name: f"{value:.3g}" for name, value in numbers.items()}


def files(folder: Path) -> dict[str, bytes]:
    """What is filed, but for two with times in them."""
    found = [path for path in folder.rglob("*") if path.is_file() and path.name not in (LINES, MANIFEST)]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def killed_in_each(stages: list[str], words: list[str], output: Path) -> None:
    """Kills as soon as a stage has a folder, and a run that gets through."""
    seen: dict[Path, float] = {}
    for stage in stages:
        lost = attempt(stage, words, output, 0.0)
        assert lost is not None, f"{stage} was over before it could be killed"
        now = finished(output)
        assert seen.items() <= now.items(), f"lost, or computed twice: {[*dict(seen.items() - now.items())]}"
        seen = now
        print(f"{stage:>12} {'begun':>8} {lost:>6.1f} s", flush=True)
    through(words, output)
    assert seen.items() <= finished(output).items(), "lost, or computed twice"


def through(words: list[str], output: Path) -> None:
    """A run to its end, and that it leaves nothing unfinished, no process and no open record."""
    code = start(words, output).wait()
    assert code == 0, (output / "lines.txt").read_text()[-2000:]
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


def page(found: list[dict[str, str]]) -> None:
    """The table of all runs so far, the same run taken out, and its page."""
    table = RESULTS / "kills.csv"
    with table.open(newline="") if table.is_file() else nullcontext(()) as before:
        rows = [row for row in csv.DictReader(before) if row["run"] != found[0]["run"]] + found
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    lines = ["# Kills", "", "Made by `make bench-kills`, a run at a time: ARGS are those of the column.", ""]
    lines += [f"Machine: {machine('cpu')}, load {os.getloadavg()[0]:.0f} at the end of the last of them.", ""]
    lines += [*textwrap.wrap(WHAT.strip(), 160), ""]
    lines += [
        "| run | stage | seconds | kills | most that was lost [s] | done again [s per kill] |",
        "|---|---|---|---|---|---|",
    ]
    lines += [f"| `{row['run']}` | " + " | ".join(row[name] for name in COLUMNS[1:]) + " |" for row in rows]
    (RESULTS / "kills.md").write_text("\n".join(lines) + "\n")


def main(words: list[str]) -> None:
    words = words or ["scene=carnation", "profile=smoke"]
    with tempfile.TemporaryDirectory(prefix="physics3d_kills_") as folder:
        straight, broken = Path(folder) / "straight", Path(folder) / "broken"
        straight.mkdir()
        broken.mkdir()
        through(words, straight)
        stages = [stage for stage in STAGES if any((straight / "artifacts" / stage).glob("[!.]*"))]
        print(f"{'killed in':>12} {'after':>8} {'lost':>8}", flush=True)
        page([killed_throughout(stage, words, straight) for stage in LONG if stage in stages])
        killed_in_each(stages, words, broken)
    print("no result lost, none computed twice, the same bytes")


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(sys.argv[1:])
