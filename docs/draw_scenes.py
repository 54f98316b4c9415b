"""Draw docs/scenes/*.jpg: each scene that is composed of shapes at rest, and where its poke has taken it farthest.

make scenes

The motion is that of a grid twice as coarse as the pipeline's, which is quick and enough for a picture.
"""

from dataclasses import replace
from pathlib import Path

from pipeline.settings import choices, compose
from pipeline.stage import build

FOLDER = Path(__file__).resolve().parent / "scenes"
WIDTH, HEIGHT = 256, 192  # of one of the two pictures [px]
SECONDS, FPS = 0.5, 30.0


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name in choices("scene"):
        config, _ = compose([f"scene={name}"])
        source = config["capture"]["source"]
        if source["_target_"] == "physics3d.scenes.made.MadeTwin":
            draw(build(source, "cpu"), config["scene"]["dx"], FOLDER / f"{name}.jpg")


def draw(twin, dx: float, file: Path) -> None:
    """One row of two pictures; `dx` is the pipeline's cell [m]."""
    import torch
    from PIL import Image

    from physics3d.log import Log

    # the turns of a coil would touch on a coarser grid
    coiled = any(getattr(shape, "coil", 0) for shape in twin.moving.values())
    quick = replace(
        twin,
        world=replace(twin.world, dx=dx if coiled else 2 * dx),
        evaluate=(),
        views=1,
        held_out_every=0,
        width=WIDTH,
        height=HEIGHT,
        frames=1 + round(SECONDS * FPS),
        fps=FPS,
    )
    (video,) = quick(log=Log(None)).take("learn").videos
    change = (video.int() - video[:1].int()).abs().flatten(1).sum(1)
    pair = torch.cat([video[0], video[int(change.argmax())]], 1)
    Image.fromarray(pair.numpy()).save(file, quality=82, optimize=True)
    print(f"{file.relative_to(FOLDER.parent.parent)}   {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
