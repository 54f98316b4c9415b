"""A twin written to disk as a person would hand it over: photographs and clips of a thing, as files, and nothing else.

<folder>/thing/IMG_0001.jpg ...      photographs, without cameras
<folder>/thing/clips/poke_1.mp4 ...  the thing moving, from a camera on a stand; what pushed it is not said
<folder>/truth.yaml                  what the person does not know: outside of the folder that is read
"""

import shutil
import tempfile
from pathlib import Path

from physics3d.scenes.base import Capture
from physics3d.video import write_mp4

JPEG_QUALITY = 95


def hand_over(capture: Capture, folder: Path, *, density: float) -> Path:
    """Write the capture, of `density` [kg/m^3] -> the folder to read. Raises ValueError if `folder` exists already."""
    import yaml
    from PIL import Image

    if folder.exists():
        raise ValueError(f"{folder} exists already; remove it, or say OUT=<another folder>")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".twin_", dir=folder.parent) as work:  # renamed when it is complete
        thing = Path(work) / "made" / "thing"
        thing.mkdir(parents=True)
        names = [f"IMG_{i + 1:04d}.jpg" for i in range(len(capture.images))]
        for name, image in zip(names, capture.images):
            Image.fromarray(image.numpy()).save(thing / name, quality=JPEG_QUALITY)
        clips = [f"poke_{i + 1}.mp4" for i in range(len(capture.takes))]
        for name, take in zip(clips, capture.takes):
            write_mp4(thing / "clips" / name, take.videos[0], take.fps)
        truth = {
            "units": "SI, z up; cameras are world to camera, x right, y down, z forward",
            "material": {"density": density, **capture.truth},
            "photographs": {name: _camera(camera) for name, camera in zip(names, capture.cameras)},
            "clips": {
                name: {
                    "fps": take.fps,
                    "camera": _camera(take.cameras[0]),
                    "excitation": [f"{boundary!r}" for boundary in take.excitation or ()],
                }
                for name, take in zip(clips, capture.takes)
            },
        }
        (Path(work) / "made" / "truth.yaml").write_text(yaml.safe_dump(truth, sort_keys=False, width=120))
        shutil.move(Path(work) / "made", folder)
    return folder / "thing"


def _camera(camera) -> dict:
    lens = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    return lens | {"world_to_camera": [[float(x) for x in row] for row in camera.world_to_camera]}
