"""The library is useful alone: its modules need none of what orchestrates, downloads, or is for single stages."""

import ast
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("physics3d", "stages", "pipeline")
# what `pip install` of the library alone might not bring
BLOCKED = (
    "prefect",
    "mlflow",
    "hydra",
    "omegaconf",
    "diffusers",
    "transformers",
    "sam2",
    "open3d",
    "pycolmap",
    "gsplat",
    "fastapi",
    "torchvision",
    "viser",
    "pxr",
    "dask",
    "distributed",
    "prefect_dask",
)
SCRIPT = f"""
import importlib, pkgutil, sys
from importlib.abc import MetaPathFinder

class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {BLOCKED}:
            raise ModuleNotFoundError(f"{{name}} is blocked", name=name)

sys.meta_path.insert(0, Absent())
import physics3d, stages
assert not {{"torch", "warp", "numpy"}} & set(sys.modules), "importing the package alone costs nothing"
for name in physics3d.__all__:
    getattr(physics3d, name)

for package in (physics3d, stages):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        try:
            importlib.import_module(module.name)
            print(module.name)
        except ModuleNotFoundError as error:
            print(module.name, "needs", error.name, file=sys.stderr)
"""


def test_every_module_can_be_imported_without_what_it_does_not_compute_with():
    done = subprocess.run([sys.executable, "-c", SCRIPT], cwd=ROOT, capture_output=True, text=True)
    assert not done.stderr and not done.returncode, done.stderr
    known = {p.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".") for p in ROOT.glob("physics3d/**/*.py")}
    known |= {p.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".") for p in ROOT.glob("stages/*.py")}
    modules = {name for name in known if not name.endswith("__init__")}
    assert modules <= set(done.stdout.split()), modules - set(done.stdout.split())


TERMINATE = """
import os, signal
signal.signal(signal.SIGTERM, signal.default_int_handler)
import cv2, imageio_ffmpeg, torch, warp
from physics3d.open3d_import import open3d
from physics3d.scenes.sfm import _pycolmap
warp.init(), open3d(), _pycolmap()
try:
    os.kill(os.getpid(), signal.SIGTERM)
    signal.pause()
except KeyboardInterrupt:
    print("interrupted")
"""


def test_no_library_takes_the_signal_that_ends_a_run():
    """COLMAP's handler would print a stack of C++."""
    pytest.importorskip("pycolmap")
    done = subprocess.run([sys.executable, "-c", TERMINATE], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.endswith("interrupted\n") and not done.returncode, done.stderr


USUAL = """
import sys
from pipeline.flow import built
from pipeline.settings import compose
built(compose(["device=cpu"])[0], "cpu")
print(*sys.modules)
"""


def test_a_video_model_that_is_not_asked_is_not_imported():
    """Every stage of the default run is built; of all priors its own alone is there, and no library of such models."""
    priors = {path.stem: declared["_target_"] for path, declared in configurations("prior")}
    done = subprocess.run([sys.executable, "-c", USUAL], cwd=ROOT, capture_output=True, text=True)
    assert not done.returncode, done.stderr
    there = set(done.stdout.split())
    modules = {name: target.rpartition(".")[0] for name, target in priors.items()}
    assert {name for name, module in modules.items() if module in there} == {"exemplar"}
    assert not {"diffusers", "transformers", "huggingface_hub"} & there


def configurations(group: str) -> list[tuple[Path, dict]]:
    return [(path, yaml.safe_load(path.read_text())) for path in sorted((ROOT / "conf" / group).glob("*.yaml"))]


def imported_at_the_top(path: Path) -> set[str]:
    """Packages that importing the file imports, by the first part of their names."""
    body = ast.parse(path.read_text()).body
    names = [alias.name for node in body if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module or "" for node in body if isinstance(node, ast.ImportFrom)]
    return {name.split(".")[0] for name in names}


def test_importing_the_project_needs_no_more_than_its_dependencies():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = ["".join(c if c.isalnum() or c in "-_." else " " for c in d).split()[0] for d in project["dependencies"]]
    declared = {name.lower() for name in names}
    installs = packages_distributions()
    files = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    used = set().union(*map(imported_at_the_top, files)) - set(PACKAGES)
    missing = {name for name in used if name in installs and not declared & {known.lower() for known in installs[name]}}
    assert not missing, f"imported, but no dependency in pyproject.toml: {sorted(missing)}"
