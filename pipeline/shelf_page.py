"""The page of all runs whose results lie on a shelf, by scene, and the plots of error against run time.

A run is what a step that judges, or else a video that nobody judged, was made from. Which method and profile that was
is in MLflow's record; without one, the material and the numbers still say what was done.
"""

import re
from pathlib import Path
from typing import Any

from pipeline.embed import page, picture
from pipeline.filed import command
from pipeline.fingerprint import ROOT
from pipeline.settings import compose
from pipeline.stage import StageError, peek, read_manifest
from pipeline.told import JUDGES
from pipeline.tracking import labels
from pipeline.words import literal_paths

RESULTS = ROOT / "docs" / "results"
SHOWN = 700  # width of a picture [px]
SHEETS = ("frames", "_frames")  # of previews that show a run
Manifests = dict[str, dict[str, Any]]  # fingerprint -> manifest


def shelf_page(words: list[str]) -> tuple[str, str]:
    """Name and text. Raises StageError if no run has left anything."""
    from physics3d.metrics.scores import UNITS

    config, _ = compose(literal_paths(words))
    output = Path(config["output"]).expanduser().resolve()
    found = runs(output)
    if not found:
        raise StageError(f"no run has left anything in {output / 'artifacts'} yet; {command([])}")
    measured = [cells for run in found for cells in run["rows"].values()]
    metrics = list(dict.fromkeys(m for cells in measured for m, value in cells.items() if value is not None))
    text = page("shelf.html", runs=found, shelf=output / "artifacts", metrics=metrics, units=UNITS, plots=plots())
    return "all_runs", text


def runs(output: Path) -> list[dict[str, Any]]:
    """One entry per run, the newest first."""
    shelf = output / "artifacts"
    told: Manifests = {}
    for path in shelf.glob("[!.]*/[!.]*/manifest.json"):
        try:
            told[path.parent.name] = read_manifest(path.parent)
        except (OSError, ValueError):
            continue  # damaged: the next run of it computes it again
    roots = [key for key, manifest in told.items() if manifest["stage"] in JUDGES]
    below = {key: before(key, told) for key in told if told[key]["stage"] in (*JUDGES, "render")}
    # a video with the estimate of a run that is judged is of that run
    known = {e for key in roots for e in below[key] if told[e]["stage"] in ("learn", "guess")}
    roots += [
        key
        for key, manifest in told.items()
        if manifest["stage"] == "render" and not estimates(below[key], told) & known
    ]
    names = labels(output)
    entries = [_entry(key, below[key], told, shelf, names) for key in roots if not below[key] - told.keys()]
    return sorted(entries, key=lambda run: run["finished"], reverse=True)


def before(key: str, told: Manifests) -> set[str]:
    """A result and all that it was made from; of what is gone, the fingerprint is among them all the same."""
    found, ahead = set(), [key]
    while ahead:
        at = ahead.pop()
        if at not in found:
            found.add(at)
            made_of = told.get(at, {}).get("made_of", {})
            ahead += [k for entry in made_of.get("inputs", ()) for k in re.findall(r"[0-9a-f]{8,}", str(entry))]
    return found


def estimates(keys: set[str], told: Manifests) -> set[str]:
    return {k for k in keys if k in told and told[k]["stage"] in ("learn", "guess")}


def _entry(key: str, below: set[str], told: Manifests, shelf: Path, names: dict[str, dict[str, str]]) -> dict[str, Any]:
    stage = {told[k]["stage"]: k for k in sorted(below, key=lambda k: told[k]["finished"])}
    folder = shelf / told[key]["stage"] / key
    label = names.get(f"artifacts/{told[key]['stage']}/{key}", {})
    source = "learn" if "learn" in stage else "guess"
    estimate = peek(shelf / source / stage[source], arrays=True)
    learned = {name: float(value.mean()) for name, value in estimate["parameters"].items()}
    if (density := estimate.get("density")) is not None:
        learned["density"] = density
    sheet = next((p for p in sorted((folder / "previews").glob("*.png")) if p.stem.endswith(SHEETS)), None)
    world = told[stage[source]]["config"].get("world", {})
    return {
        "scene": label.get("scene") or peek(shelf / "capture" / stage["capture"])["name"],
        "method": label.get("method", "?"),
        "profile": label.get("profile", "?"),
        "said": " ".join(filter(None, (label.get("said", ""), _seed(label.get("seed", "0"))))),
        "material": world.get("material", {}).get("_target_", "?").rpartition(".")[2],
        "seconds": sum(told[k]["seconds"] for k in below),
        "finished": told[key]["finished"],
        "rows": judged(folder) if told[key]["stage"] in JUDGES else {},
        "parameters": learned if source == "learn" else {},
        "picture": picture(sheet, SHOWN) if sheet else None,
        "shows": sheet.stem.replace("_", " ") if sheet else "",
    }


def _seed(seed: str) -> str:
    return "" if seed == "0" else f"seed={seed}"


def judged(folder: Path) -> dict[str, dict[str, float | None]]:
    """Rows of scores, without those in which there is nothing (a reference, where nothing of it was measured)."""
    return {row: cells for row, cells in peek(folder)["values"].items() if any(v is not None for v in cells.values())}


def plots() -> list[dict[str, str]]:
    """The plots of docs/results, each under the title of its page."""
    found = []
    for path in sorted(RESULTS.glob("*.png")):
        text = path.with_suffix(".md")
        if text.is_file():
            title = text.read_text().splitlines()[0].lstrip("# ")
            found.append({"name": path.stem, "title": title, "picture": picture(path)})
    return found
