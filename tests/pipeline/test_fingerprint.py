"""What changes a fingerprint, and what must not."""

import os
from pathlib import Path

import pytest

from pipeline.fingerprint import _imports, _tree, _tree_digest, code_digest, content_digest, fingerprint

STAGE = '''"""A stage."""
from dataclasses import dataclass

@dataclass
class Fill:
    """Fills."""
    def __call__(self):
        from physics3d import filling  # late
        return filling.fill()
'''
FILES = {
    "stages/__init__.py": "",
    "stages/fill.py": STAGE,
    "stages/learn.py": "x = 1\n",
    "physics3d/__init__.py": "",
    "physics3d/filling.py": "from physics3d.mpm import grid\ndef fill():\n    return grid.n\n",
    "physics3d/mpm/__init__.py": "",
    "physics3d/mpm/grid.py": "from .deep import m\nn = 1\n",
    "physics3d/mpm/deep.py": "m = 1\n",
    "physics3d/unused.py": "y = 1\n",
    "physics3d/log.py": "z = 1\n",
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def digest(root: Path) -> str:
    for remembered in (code_digest, _imports, _tree, _tree_digest):
        remembered.cache_clear()
    return code_digest(("stages.fill.Fill",), root)


@pytest.mark.parametrize(
    "change",
    [
        lambda root: (root / "stages/fill.py").write_text("# a comment\n\n" + STAGE.replace("Fills.", "Fills well.")),
        lambda root: (root / "stages/fill.py").write_text(STAGE.replace("  # late", "")),
        lambda root: (root / "stages/learn.py").write_text("x = 2\n"),
        lambda root: (root / "physics3d/unused.py").write_text("y = 2\n"),
        lambda root: (root / "physics3d/log.py").write_text("z = 2\n"),
    ],
    ids=["comments and docstrings", "comment at a line's end", "another stage", "a module not reached", "the log"],
)
def test_what_does_not_matter_keeps_the_code_digest(tree, change):
    before = digest(tree)
    change(tree)
    assert digest(tree) == before


@pytest.mark.parametrize(
    "name", ["stages/fill.py", "physics3d/filling.py", "physics3d/mpm/deep.py", "physics3d/mpm/__init__.py"]
)
def test_code_that_is_reached_changes_the_code_digest(tree, name):
    """Also through imports inside functions, relative imports and packages."""
    before = digest(tree)
    with (tree / name).open("a") as text:
        text.write("\nnew = 1\n")
    assert digest(tree) != before


def test_configuration_matters_but_the_device_does_not():
    config = {"_target_": "stages.fill.Fill", "spacing": 0.01, "device": "cpu", "inner": [{"device": "cpu", "a": 1}]}
    same = config | {"device": "cuda", "inner": [{"device": "cuda", "a": 1}]}
    assert fingerprint(config, ["x"]) == fingerprint(same, ["x"])
    assert fingerprint(config, ["x"]) != fingerprint(config | {"spacing": 0.02}, ["x"])
    assert fingerprint(config, ["x"]) != fingerprint(config, ["y"])


def test_data_matters_by_content_not_by_place_or_time(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        (folder / "images").mkdir(parents=True)
        (folder / "images" / "0.png").write_bytes(b"abc")
        (folder / "transforms.json").write_text("{}")
    os.utime(two / "images" / "0.png", (0, 0))
    known = tmp_path / "digests.json"
    assert content_digest(one, known) == content_digest(two, known) == content_digest(one)
    assert content_digest(one / "transforms.json") == content_digest(one)  # the file names images beside it
    (one / "images" / ".hidden").write_text("x")
    assert content_digest(one, known) == content_digest(two, known)
    (one / "images" / "0.png").write_bytes(b"abd")
    assert content_digest(one, known) != content_digest(two, known)


def test_missing_data_says_how_to_name_it(tmp_path):
    with pytest.raises(ValueError, match=r"no such file or folder: .*nowhere; .*DATA="):
        fingerprint({"source": {"path": str(tmp_path / "nowhere")}}, [])
