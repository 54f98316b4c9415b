"""What changes a fingerprint, and what must not."""

import json
import os
from pathlib import Path

import pytest

from pipeline import fingerprint as module
from pipeline.fingerprint import _imports, _reached, _tree, _tree_digest, code, fingerprint, libraries

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


def digest(root: Path) -> dict[str, str]:
    for remembered in (code, libraries, _reached, _imports, _tree, _tree_digest):
        remembered.cache_clear()
    return code(("stages.fill.Fill",), root)


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

    def key(path: Path, known: Path | None = None) -> str:
        return fingerprint({"path": str(path)}, [], known)

    assert key(one, known) == key(two, known) == key(one)
    assert key(one / "transforms.json") == key(two / "transforms.json")
    (one / "images" / ".hidden").write_text("x")
    (one / "images" / "again").symlink_to(one)  # a link that leads back
    assert key(one, known) == key(two, known)
    (one / "images" / "0.png").write_bytes(b"abd")
    assert key(one, known) != key(two, known)
    (one / "transforms.json").write_text("[]")
    assert key(one / "transforms.json") != key(two / "transforms.json")


@pytest.mark.parametrize("damage", ["null", "[]", "{", "[" * 100000, '{"x": 1}', b"\xff"])
def test_damaged_digests_only_cost_time(tmp_path, damage):
    data, known = tmp_path / "model.ply", tmp_path / "digests.json"
    data.write_bytes(b"abc")
    right = fingerprint({"path": str(data)}, [], known)
    known.write_bytes(damage if isinstance(damage, bytes) else damage.encode())
    assert fingerprint({"path": str(data)}, [], known) == right
    for entry in (None, [], [1, 2], [3, data.stat().st_mtime_ns, 7]):
        known.write_text(json.dumps({str(data): entry}))
        assert fingerprint({"path": str(data)}, [], known) == right


def test_data_that_cannot_be_read_is_named(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")  # reading it would wait for ever
    with pytest.raises(ValueError, match=r"cannot read .*pipe\.ply"):
        fingerprint({"path": str(tmp_path / "pipe.ply")}, [])


def test_content_of_weights_matters(tmp_path, monkeypatch):
    """A folder or file by what it holds, a repository of the hub by the commit that its cache holds."""
    weights = tmp_path / "weights.pt"
    weights.write_bytes(b"abc")
    for entry in ("model", "weights"):
        config = {"_target_": "stages.learn.Learn", "prior": {"_target_": "physics3d.priors.base.X", entry: ""}}

        def key(value: object, config=config, entry=entry) -> str:
            return fingerprint(config | {"prior": config["prior"] | {entry: str(value)}}, [])

        before = key(weights)
        weights.write_bytes(b"abd")
        assert key(weights) != before
        weights.write_bytes(b"abc")
        assert key(weights) == before
        monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / entry))
        reference = tmp_path / entry / "models--someone--model" / "refs" / "main"
        reference.parent.mkdir(parents=True)
        keys = set()
        for commit in ("a" * 40, "b" * 40):
            reference.write_text(commit)
            keys.add(key("someone/model"))
        assert len(keys | {key("someone/other")}) == 3


def test_versions_of_the_libraries_that_compute_matter(tree, monkeypatch):
    """To the minor version, and only of those that the code reached imports."""
    (tree / "physics3d/filling.py").write_text("def fill():\n    import scipy.spatial\n    import rich\n")
    monkeypatch.setattr(module, "ROOT", tree)

    def found(**versions: str) -> dict[str, str]:
        digest(tree)  # forgets what was remembered
        monkeypatch.setattr(module, "installed", lambda name: versions.get(name, "1.0.0"))
        return libraries(("stages.fill.Fill",), tree)

    assert found() == {"scipy": "1.0"} == found(scipy="1.0.9", torch="9.9", rich="2")
    assert found(scipy="1.1.0") != found()
    assert libraries(("stages.reconstruct.Reconstruct",)).keys() >= {"torch", "warp", "numpy"}  # of the real code


def test_missing_data_says_how_to_name_it(tmp_path):
    with pytest.raises(ValueError, match=r"no such file or folder: .*nowhere; .*DATA="):
        fingerprint({"source": {"path": str(tmp_path / "nowhere")}}, [])
