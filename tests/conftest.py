"""Annotations are checked in every test; where real data lies; random numbers that are the same every time."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import config, install_import_hook
from shape_hook import with_checked_shapes

ROOT = Path(__file__).resolve().parent.parent


install_import_hook(with_checked_shapes(), "shapes.checked")  # before any of them is imported


@pytest.fixture
def unchecked() -> Iterator[None]:
    """For tests of what our own code says of a wrong shape."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)


@pytest.fixture
def data() -> Path:
    """The folder of real data sets; the test is skipped where there is none."""
    folder = Path(os.environ.get("PHYSICS3D_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set PHYSICS3D_DATA to the folder that holds plush/, bird/, ...")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
