"""Physics3D: from photographs to a moving, measured 3D Gaussian model; needs torch and Warp, no Prefect or MLflow.

    from physics3d import Log, World, rollout

What is in `__all__` is the public interface, described in docs/api.md; it is imported where it is first used.
"""

import importlib
from typing import Any

_PLACES = {
    "Log": "log",
    "AbstractArtifact": "artifact",
    "ArtifactError": "artifact",
    "Video": "video",
    "read_mp4": "video",
    "write_mp4": "video",
    "Gaussians": "gaussians.model",
    "read_ply": "gaussians.ply",
    "write_ply": "gaussians.ply",
    "Camera": "gaussians.cameras",
    "look_at": "gaussians.cameras",
    "Photograph": "gaussians.photograph",
    "render": "gaussians.render",
    "rasterize": "gaussians.rasterize",
    "Embedding": "gaussians.embedding",
    "embed": "gaussians.embedding",
    "render_deformed": "gaussians.deform",
    "World": "world",
    "Estimate": "world",
    "Trajectory": "trajectory",
    "rollout": "mpm.rollout",
    "motion_of": "solver",
    "AbstractMaterial": "materials.base",
    "AbstractBoundary": "boundaries.base",
    "AbstractPrior": "priors.base",
    "AbstractSource": "scenes.base",
    "Capture": "scenes.base",
    "Take": "scenes.base",
    "Segmentation": "segmentation",
    "Body": "filling.body",
    "Scores": "metrics.scores",
}
__all__ = list(_PLACES)


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'physics3d' has no attribute {name!r}; public are {', '.join(_PLACES)}")
    return getattr(importlib.import_module(f"physics3d.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
