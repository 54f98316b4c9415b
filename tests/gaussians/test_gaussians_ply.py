"""A model survives the trip through a .ply, and a damaged file says what is wrong with it."""

import numpy as np
import pytest
import torch

from physics3d.gaussians.model import FIELDS, Gaussians
from physics3d.gaussians.ply import read_ply, write_ply


def some_gaussians(n: int = 7, k: int = 9) -> Gaussians:
    g = torch.Generator().manual_seed(0)
    normal = lambda *shape: torch.randn(*shape, generator=g)
    return Gaussians(
        mean=normal(n, 3), log_scale=normal(n, 3), quaternion=normal(n, 4), opacity_logit=normal(n), sh=normal(n, k, 3)
    )


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_round_trip_is_exact(tmp_path, k):
    before = some_gaussians(k=k)
    write_ply(tmp_path / "model.ply", before)
    after = read_ply(tmp_path / "model.ply")
    for name in FIELDS:  # float32 in, float32 out: bit for bit
        torch.testing.assert_close(getattr(after, name), getattr(before, name), rtol=0, atol=0)


def test_higher_harmonics_are_stored_channel_by_channel(tmp_path):
    """3DGS writes all coefficients of red, then of green, then of blue."""
    from plyfile import PlyData

    model = some_gaussians(k=4)
    write_ply(tmp_path / "model.ply", model)
    vertex = PlyData.read(str(tmp_path / "model.ply"))["vertex"]
    assert vertex["f_rest_1"][2] == model.sh[2, 2, 0] and vertex["f_rest_3"][2] == model.sh[2, 1, 1]


def damaged(path, change) -> None:
    from plyfile import PlyData, PlyElement

    write_ply(path, some_gaussians())
    PlyData([PlyElement.describe(change(PlyData.read(str(path))["vertex"].data.copy()), "vertex")]).write(str(path))


def test_nan_is_named_with_file_property_and_count(tmp_path):
    def change(vertex):
        vertex["scale_1"][:3] = np.nan
        return vertex

    damaged(tmp_path / "broken.ply", change)
    with pytest.raises(ValueError, match=r"broken\.ply: property scale_1 holds 3 non-finite numbers of 7"):
        read_ply(tmp_path / "broken.ply")


def test_missing_properties_are_named(tmp_path):
    from numpy.lib.recfunctions import drop_fields

    damaged(tmp_path / "short.ply", lambda vertex: drop_fields(vertex, ["opacity", "rot_2"]))
    with pytest.raises(ValueError, match=r"short\.ply lacks 2 properties.*opacity, rot_2"):
        read_ply(tmp_path / "short.ply")


@pytest.mark.parametrize("content", [b"", b"not a ply at all", b"ply\nformat binary_little_endian 1.0\nend_header\n"])
def test_what_is_no_model_is_refused(tmp_path, content):
    (tmp_path / "no.ply").write_bytes(content)
    with pytest.raises(ValueError, match=r"no\.ply"):
        read_ply(tmp_path / "no.ply")


def test_a_file_cut_short_is_refused(tmp_path):
    write_ply(tmp_path / "cut.ply", some_gaussians())
    whole = (tmp_path / "cut.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[:-20])
    with pytest.raises(ValueError, match=r"cut\.ply"):
        read_ply(tmp_path / "cut.ply")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"no file .*absent\.ply"):
        read_ply(tmp_path / "absent.ply")
