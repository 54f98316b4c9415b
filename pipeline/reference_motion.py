"""make reference-motion SCENE=carnation: how a twin moves by finite elements.

    python -m pipeline.reference_motion scene=carnation [words of the configuration] [edge=0.010] [steps=6]

`edge` is the length of the tetrahedra's edges [m], `steps` the time steps to a frame. Writes the file that the twin
reads from then on (`physics3d/scenes/reference_motion.py`), and says its frequencies. Needs `pip install pytetwild
pyvista`. Exit codes: 0 done, 1 it cannot be done, 2 a word means nothing, 130 Ctrl-C.
"""

import importlib.util
import sys
import tempfile
from pathlib import Path

from pipeline.filed import megabytes, one_line
from pipeline.settings import SettingsError, compose
from pipeline.stage import build
from pipeline.words import literal_paths

EDGE, STEPS = 0.010, 6
SAME = 0.05  # of the volume: particles of a stem two of them across are counted to a few per cent


def main(words: list[str]) -> int:
    return one_line(lambda: write(words), lambda text: print(text, file=sys.stderr))


def write(words: list[str]) -> None:
    """Raises SettingsError, and ValueError where the scene is no twin that finite elements are made for."""
    own = dict(w.split("=", 1) for w in words if w.startswith(("edge=", "steps=")))
    try:
        edge, steps = float(own.get("edge", EDGE)), int(own.get("steps", STEPS))
    except ValueError:
        edge, steps = 0.0, 0
    if not (1e-4 <= edge <= 1 and 1 <= steps <= 1000):
        said = " ".join(f"{name}={value}" for name, value in own.items())
        raise SettingsError(f"{said}: take an edge of 1e-4 to 1 m, and a whole number of 1 to 1000 steps")
    settings, _ = compose(literal_paths([w for w in words if not w.startswith(("edge=", "steps="))]))
    from physics3d.log import Log
    from physics3d.scenes import finite_elements, reference_motion
    from physics3d.scenes.carnation import CarnationTwin
    from physics3d.scenes.made import MadeTwin
    from physics3d.scenes.synthetic import particles

    source = build(settings["scene"]["source"], "cpu", "scene.source")
    if not isinstance(source, CarnationTwin | MadeTwin):
        raise ValueError(f"scene.source is a {type(source).__name__}; finite elements are made for twins that are held")
    if any(importlib.util.find_spec(name) is None for name in ("pytetwild", "pyvista")):
        raise ValueError("the mesher is missing; pip install pytetwild pyvista")
    world = source.world if isinstance(source, MadeTwin) else source.world()
    name = source.name if isinstance(source, MadeTwin) else source.motion
    solids = source.solids()
    body = finite_elements.meshed(solids, world, edge)
    place, volume = particles(solids, world.dx / 2, source.seed)
    meshed, whole = float(body.weight.sum()), float(volume[~body.still(place)].sum())
    print(f"mesh      {body.gradient.shape[1]} nodes, {1e6 * meshed:.1f} cm^3", flush=True)
    if abs(meshed / whole - 1) > SAME:
        raise ValueError(
            f"the mesh has {1e6 * meshed:.1f} cm^3 where the body has {1e6 * whole:.1f}; a part of it was lost: take a "
            "smaller edge, or look whether its surfaces are closed"
        )
    found = finite_elements.frequencies(body, world, 4)
    print(f"stuck     {', '.join(f'{f:.4g}' for f in found)} Hz", flush=True)
    place = reference_motion.evenly(place)
    moved = {}
    for role, push in source.pokes().items():
        with tempfile.TemporaryDirectory(prefix="physics3d_") as notes:
            log = Log(Path(notes), name=role)
            films = finite_elements.swing(body, world, push, frames=source.frames, fps=source.fps, steps=steps, log=log)
        position, deformation = finite_elements.carried(body, films, place)
        moved[role] = reference_motion.Moved(place=place, position=position, deformation=deformation)
        print(f"moved     {role}: by up to {1e3 * abs(position - place).max():.1f} mm", flush=True)
    made = f"finite elements: scikit-fem, {body.gradient.shape[1]} nodes of quadratic tetrahedra, {steps} steps a frame"
    path = reference_motion.path_of(name)
    error = reference_motion.save(path, world, source.pokes(), solids, source.fps, moved, made)
    print(f"written   {path}   {megabytes(path.stat().st_size)}, positions to {1e6 * error:.0f} micrometres")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
