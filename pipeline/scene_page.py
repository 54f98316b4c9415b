"""The page of one run of a scene, from what its steps filed."""

import re
from typing import Any

import numpy as np

from pipeline import told
from pipeline.embed import curve, film, page, picture
from pipeline.filed import command, filed
from pipeline.flow import Plan
from pipeline.moving import of_steps
from pipeline.replay import replay
from pipeline.stage import Step, peek

SLICES = ("slices", "space_time")  # what previews of space-time slices are called, at the end
WIDEST = 1400  # of a picture that is shown as wide as the page [px]


def scene_page(words: list[str]) -> tuple[str, str]:
    """Name and text. Raises StageError naming the `make run` that is missing."""
    import yaml

    config, plan, steps = filed(words)
    left = {name: told.told(step) for name, step in steps.items()}
    made = of_steps(config, steps)
    name = made.scene
    text = page(
        "scene.html",
        name=name,
        made_by=command(words),
        note=peek(steps["capture"].folder)["note"],
        finished=max(t.manifest["finished"] for t in left.values()),
        films=films(steps),
        replay=replay(made),
        judged=told.scores(plan),
        takes=takes(plan, left),
        units=_units(),
        slices=_slices(left),
        parameters=told.parameters(plan),
        models=told.models(plan),
        truth_source=peek(steps["capture"].folder).get("truth_source", ""),
        stages=[_stage(n, t) for n, t in left.items()],
        left_out=plan.left_out,
        total=sum(t.seconds for t in left.values()),
        health={k.removeprefix("health/"): curve(v) for k, v in left["simulate"].curves.items() if "health/" in k},
        config=yaml.safe_dump(config, sort_keys=False, allow_unicode=True),
        versions=left["simulate"].manifest["versions"],
        device=left["simulate"].manifest["device"],
    )
    return f"{name}_report", text


def films(steps: dict[str, Step]) -> list[dict[str, Any]]:
    """The recorded clip, where there is one, beside what was simulated, per camera; all begin together."""
    from physics3d.scenes.base import Capture
    from physics3d.video import Video, read_mp4

    capture = Capture.load(steps["capture"].folder)
    take = capture.take("evaluate") or capture.take("learn")
    known_cause = take is not None and take.excitation is not None
    videos = {"learned": "render", "start": "render_initial"} if "learn" in steps else {"simulated": "render"}
    loaded = {n: Video.load(steps[s].folder) for n, s in videos.items() if s in steps}
    found = []
    for i, camera in enumerate(next(iter(loaded.values())).names):
        rows: dict[str, tuple[np.ndarray, float]] = {}
        number = int(camera.removeprefix("camera")) if camera.startswith("camera") else None
        if take is not None and known_cause and number is not None:
            rows["recorded"] = take.videos[number].numpy(), take.fps
        rows |= {n: (video.frames[i].numpy(), video.fps) for n, video in loaded.items()}
        found += [{"name": f"{n}, {camera}", **film(frames, fps)} for n, (frames, fps) in rows.items()]
    if "foretell" in steps:  # its clips begin where it begins to foretell
        for path in sorted(steps["foretell"].folder.glob("*.mp4")):
            frames, fps = read_mp4(path)
            found.append({"name": f"recorded and foretold, {path.stem.replace('_', ' ')}", **film(frames.numpy(), fps)})
    return found


def takes(plan: Plan, left: dict[str, told.Told]) -> list[dict[str, Any]]:
    """Of every take that was foretold: its rows of the table, and its pictures (`physics3d/metrics/take_page.py`)."""
    from physics3d.metrics.take_page import PICTURES

    found: dict[str, dict[str, Any]] = {}
    for table in told.scores(plan):
        for row, cells in table.values.items() if table.step == "foretell" else ():
            take, _, name = row.rpartition(": ")
            found.setdefault(take, {"name": take, "rows": {}, "metrics": table.metrics, "notes": [], "pictures": []})
            found[take]["rows"][name] = cells
        for about, text in table.notes.items():
            for take in found:
                if about == take or about.startswith(f"{take}: "):
                    found[take]["notes"].append(f"{about.removeprefix(f'{take}: ')}: {text}")
    for take, told_of in found.items():
        for key, what in PICTURES.items():
            if f"{take}_{key}" in left["foretell"].previews:
                path, _ = left["foretell"].previews[f"{take}_{key}"]
                told_of["pictures"].append({"name": what, "picture": picture(path, WIDEST)})
    return list(found.values())


def _slices(left: dict[str, told.Told]) -> list[dict[str, Any]]:
    """Space-time slices: of what was judged beside the recording, else of the video. Takes show their own."""
    of = [n for n in told.JUDGES if n in left and n != "foretell"] or ["render"] * ("foretell" not in left)
    return [
        {"name": f"{step}: {key.replace('_', ' ')}", "picture": picture(path)}
        for step in of
        for key, (path, _) in left[step].previews.items()
        if re.sub(r"_\d+$", "", key).endswith(SLICES)
    ]


def _stage(name: str, t: told.Told) -> dict[str, Any]:
    return {
        "name": name,
        "seconds": t.seconds,
        "memory": t.memory / 1e9,
        "lines": t.lines,
        "warnings": [line.partition("warning: ")[2] for line in t.lines if "warning: " in line],
        "numbers": {k: v for k, v in t.numbers.items() if k.count("/") == 0},
        "curves": {k: curve(v) for k, v in t.curves.items() if not k.startswith("health/")},
        "previews": [
            {"name": key.replace("_", " "), "count": count, "picture": picture(path)}
            for key, (path, count) in t.previews.items()
            if name != "foretell"  # of takes, which are shown above
        ],
    }


def _units() -> dict[str, str]:
    from physics3d.metrics.scores import UNITS

    return UNITS
