"""The public interface: all of it is there, described as it is, and needs none of what only runs or loads things."""

import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import physics3d

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "api.md").read_text()
WITHOUT = """
import importlib, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in BLOCKED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

BLOCKED = sys.argv[1].split()
sys.meta_path.insert(0, Missing())
import physics3d
assert not {"torch", "warp", "numpy"} & set(sys.modules), "importing the package costs nothing"
for name in physics3d.__all__:
    getattr(physics3d, name)
for module in sys.argv[2:]:
    importlib.import_module(module)
print("imported", len(sys.argv) - 2)
"""
# what the extras of pyproject.toml bring: the library computes without
EXTRAS = "prefect mlflow hydra omegaconf fastapi diffusers transformers torchvision sam2 pycolmap viser pxr pygltflib "
EXTRAS += "prefect_dask dask distributed"


def signature(name: str) -> str:
    """As the page writes it: names of the arguments, those by name only behind a star."""
    of = getattr(physics3d, name)
    if inspect.isclass(of) and issubclass(of, Exception):
        return name
    words, only_by_name = [], False
    for p in inspect.signature(of).parameters.values():
        if p.kind == p.KEYWORD_ONLY and not only_by_name:
            words.append("*")
            only_by_name = True
        words.append(p.name)
    return f"{name}({', '.join(words)})" if words else name


def test_the_library_works_without_what_only_runs_it_or_loads_weights():
    files = [p.relative_to(ROOT) for folder in ("physics3d", "stages") for p in (ROOT / folder).rglob("*.py")]
    modules = sorted(".".join(p.with_suffix("").parts).removesuffix(".__init__") for p in files)
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", WITHOUT, EXTRAS, *modules], env=env, capture_output=True, text=True)
    assert done.stdout.endswith(f"imported {len(modules)}\n"), done.stderr


@pytest.mark.parametrize("name", physics3d.__all__)
def test_a_public_name_is_described_where_it_is_and_on_the_page_as_it_is(name):
    of = getattr(physics3d, name)
    text = inspect.getdoc(of) or ""
    assert len(text.split()) >= 4 and not text.startswith(f"{name}("), f"{name} needs a docstring of its own"
    rows = [row for row in PAGE.splitlines() if row.startswith(f"| `{signature(name)}` | `{of.__module__}` | ")]
    assert len(rows) == 1, f"docs/api.md needs a row: | `{signature(name)}` | `{of.__module__}` | what it is |"


def test_the_page_names_nothing_that_is_not_public():
    assert sorted(re.findall(r"^\| `(\w+)", PAGE, re.M)) == sorted(physics3d.__all__)
    with pytest.raises(AttributeError, match="public are Log"):
        physics3d.Rollout  # noqa: B018
    assert set(physics3d.__all__) <= set(dir(physics3d))
