"""A page about the last run of a scene: stages with times, parameters, scores and pictures, as they were filed.

    make bench-pages ARGS="scene=carnation"   ->   docs/results/carnation.md and its pictures

Nothing is computed here; run the scene first (`make run SCENE=carnation`).
"""

import sys
from pathlib import Path

from machine import machine

from pipeline.flow import up_to_date
from pipeline.settings import compose
from pipeline.stage import manifest
from pipeline.told import models

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
PICTURES = {
    "capture": ("views.png", "take_learn.png"),
    "reconstruct": ("photograph_and_render_*.png",),
    "segment": ("masks.png", "moving.png"),
    "fill": ("slices.png",),
    "learn": ("parameters.png", "reference_above_learned.png"),
    "simulate": ("motion.png",),
    "render": ("*_frames.png", "*_space_time.png"),
    "evaluate": ("frames*.png", "bars.png"),
}

# these show the recording itself: of data that others own they stay at home
PHOTOGRAPHS = {
    *(("capture", p) for p in PICTURES["capture"]),
    *(("reconstruct", p) for p in PICTURES["reconstruct"]),
    ("segment", "masks.png"),
    ("learn", "reference_above_learned.png"),
    ("evaluate", "frames*.png"),
}
# of data without a licence only what is plotted is shown
PLOTS = {("fill", "slices.png"), ("learn", "parameters.png"), ("simulate", "motion.png"), ("evaluate", "bars.png")}
UNLICENSED = ("lego",)


def main(words: list[str]) -> None:
    config, picked = compose(words or ["scene=carnation"])
    plan = up_to_date(config, Path(config["output"]).resolve() / "artifacts", verify=False)
    if plan is None:
        raise SystemExit(
            f"error: this run is not complete; make run SCENE={picked['scene']} first, with the same values"
        )
    name = picked["scene"] if picked["method"] == "physics3d" else f"{picked['scene']}_{picked['method']}"
    steps = {step.name: step for step in plan.steps}
    told = {name: manifest(step) for name, step in steps.items()}
    said = [word for word in words if not word.startswith(("data=", "output=", "device="))]  # those of one machine
    made = f'make bench-pages ARGS="{" ".join(said)}"'
    lines = [f"# {name}, profile {picked['profile']}", "", f"Made by `{made}` after `make run`.", ""]
    lines += [f"Machine: {machine(config['device'])}; seed {config['seed']}.", ""]
    lines += ["| stage | seconds | peak memory of the process |", "|---|---|---|"]
    lines += [f"| {n} | {t['seconds']:.1f} | {t['peak_rss_bytes'] / 1e9:.1f} GB |" for n, t in told.items()]
    lines += [f"| {n} | left out: {why} | |" for n, why in plan.left_out.items()]
    lines += [f"| all | {sum(t['seconds'] for t in told.values()):.1f} | |", ""]
    scores = steps["evaluate"].folder / "scores.md" if "evaluate" in steps else None
    if scores is not None:
        lines += [scores.read_text(), ""]
    lines += [*(f"- {sentence}" for sentence in models(plan)), ""]
    real = "path" in config["scene"]["source"]
    for stage, patterns in PICTURES.items():
        if stage not in steps:
            continue
        previews = steps[stage].folder / "previews"
        for pattern in patterns:
            if real and (stage, pattern) in PHOTOGRAPHS:
                continue
            if picked["scene"] in UNLICENSED and (stage, pattern) not in PLOTS:
                continue
            picture = max(previews.glob(pattern), default=None)  # the last step of a series
            if picture is None:
                continue
            target = RESULTS / f"{name}_{stage}_{picture.stem}.jpg"
            keep(picture, target)
            lines += [f"{stage}: {picture.stem.replace('_', ' ')}", "", f"![{picture.stem}]({target.name})", ""]
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{name}.md").write_text("\n".join(lines))
    print(RESULTS / f"{name}.md")


def keep(picture: Path, target: Path) -> None:
    """A copy, small enough for a repository."""
    from PIL import Image

    target.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(picture) as image:
        image.thumbnail((1280, 1280))
        image.convert("RGB").save(target, quality=82)


if __name__ == "__main__":
    main(sys.argv[1:])
