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
FRAMES, FPS = 7, 20.0


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
    from physics3d.mpm.rollout import rollout
    from physics3d.scenes.room import DAYLIGHT, room, witness
    from physics3d.scenes.studio import Studio
    from physics3d.scenes.synthetic import Carrier

    # the turns of a coil would touch on a coarser grid
    coiled = any(getattr(shape, "coil", 0) for shape in twin.moving.values())
    world = replace(twin.world, dx=dx if coiled else 2 * dx)
    position, volume = replace(twin, world=world).matter()
    trajectory = rollout(
        world,
        world.estimate().parameters,
        torch.from_numpy(position),
        torch.from_numpy(volume),
        excitation=twin.learn,
        frames=FRAMES,
        frame_dt=1 / FPS,
        log=Log(None),
    )
    farthest = int((trajectory.position - trajectory.position[0]).norm(dim=2).mean(1).argmax())
    studio = Studio([*twin.meshes(), *room()], DAYLIGHT, openness_rays=16, seed=0)
    camera = witness(WIDTH, HEIGHT, target=twin.target, distance=twin.distance, opening=twin.opening)
    carrier = Carrier(studio.rest(), studio.anchors(), position, world.dx)
    moved = carrier(trajectory.position[farthest].numpy(), trajectory.deformation[farthest].numpy())
    pair = [pose.photograph(camera)[0] for pose in (studio.pose(), studio.pose(moved))]
    Image.fromarray(torch.cat(pair, 1).numpy()).save(file, quality=82, optimize=True)
    print(f"{file.relative_to(FOLDER.parent.parent)}   {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
