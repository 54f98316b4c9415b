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


class Lines:
    """A log that keeps its warnings."""

    def __init__(self):
        self.said = ""

    def warn(self, text: str) -> None:
        self.said += text + "\n"


def retyped(vertex: np.ndarray, dtype: str, **columns) -> np.ndarray:
    """The vertices with another type of number, and some columns replaced."""
    result = np.empty(len(vertex), [(name, dtype) for name in vertex.dtype.names])
    for name in vertex.dtype.names:
        result[name] = columns.get(name, vertex[name])
    return result


def test_doubles_far_from_the_origin_keep_their_shape_and_the_shift_is_said(tmp_path):
    """A model of a metre in map coordinates: float32 has steps of 0.5 m there."""
    model = some_gaussians()
    far = np.array([5.0e5, 5.4e6, 300.0])
    mean = model.mean.double().numpy() + far
    damaged(tmp_path / "map.ply", lambda v: retyped(v, "f8", **dict(zip("xyz", mean.T))))
    log = Lines()
    after = read_ply(tmp_path / "map.ply", log=log)
    moved = after.mean.double().numpy() - model.mean.double().numpy()
    # one shift for all, to the seven digits of a few metres
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-6)
    assert np.abs(after.mean).max() < 10
    shift = np.array(eval(log.said.split("shifted by ")[1].split("]")[0] + "]"))
    np.testing.assert_allclose(mean + shift, after.mean, atol=1e-6)
    torch.testing.assert_close(after.log_scale, model.log_scale)
    # what was rounded before it was stored is lost, and said
    damaged(tmp_path / "lost.ply", lambda v: retyped(v, "f4", **dict(zip("xyz", mean.T))))
    read_ply(tmp_path / "lost.ply", log=log)
    assert "rounded to steps of 0.5" in log.said


def test_opaque_and_flat_gaussians_are_read(tmp_path):
    def change(vertex):
        vertex["opacity"][:3] = np.inf, -np.inf, 2.0
        vertex["scale_1"][4] = -np.inf
        return vertex

    damaged(tmp_path / "a.ply", change)
    log = Lines()
    model, plain = read_ply(tmp_path / "a.ply", log=log), some_gaussians()
    # as much as float32 can tell from 1 and 0
    assert model.opacity[0] > 1 - 1e-6 and model.opacity[1] < 1e-6 and model.opacity_logit[2] == 2.0
    wide = torch.exp(plain.log_scale[4, [0, 2]].amax())
    assert 0 < torch.exp(model.log_scale[4, 1]) < 2e-3 * wide
    torch.testing.assert_close(model.log_scale[:4], plain.log_scale[:4])
    assert "2 Gaussians are exactly" in log.said and "1 Gaussians are flat" in log.said


def test_a_model_of_discs_has_no_third_scale(tmp_path):
    from numpy.lib.recfunctions import drop_fields

    damaged(tmp_path / "discs.ply", lambda vertex: drop_fields(vertex, ["scale_2"]))
    model, plain = read_ply(tmp_path / "discs.ply"), some_gaussians()
    torch.testing.assert_close(model.log_scale[:, :2], plain.log_scale[:, :2])
    assert (model.log_scale[:, 2] < plain.log_scale[:, :2].amax(1) - 6).all()


def test_what_has_no_size_or_infinite_size_is_named(tmp_path):
    def change(value, names):
        def apply(vertex):
            for name in names:
                vertex[name][2] = value
            return vertex

        return apply

    damaged(tmp_path / "none.ply", change(-np.inf, ["scale_0", "scale_1", "scale_2"]))
    with pytest.raises(ValueError, match=r"none\.ply: 1 Gaussians of 7 have no size"):
        read_ply(tmp_path / "none.ply")
    damaged(tmp_path / "huge.ply", change(np.inf, ["scale_0"]))
    with pytest.raises(ValueError, match=r"huge\.ply: property scale_0 holds 1 non-finite"):
        read_ply(tmp_path / "huge.ply")
    damaged(tmp_path / "nan.ply", change(np.nan, ["opacity"]))
    with pytest.raises(ValueError, match=r"nan\.ply: property opacity holds 1 non-finite"):
        read_ply(tmp_path / "nan.ply")


IMPOSSIBLE = {  # property -> its numbers, and what is said
    "no rotation": (dict.fromkeys(("rot_0", "rot_1", "rot_2", "rot_3"), 0.0), "7 Gaussians of 7 have no rotation"),
    "no number": ({"scale_1": 300.0}, "have scale up to 300"),
    "invisible": ({"opacity": -np.inf}, "nothing would be seen"),
    "faint": ({"opacity": -9.0}, "nothing would be seen"),
    "bytes": ({"opacity": np.arange(7) * 30.0}, "opacity is 0 to 180, neither"),
    "beyond float32": ({"x": 1e300}, "property x holds 7 non-finite"),
    "beyond float32 in colour": ({"f_dc_1": -1e39}, "property f_dc_1 holds 7 non-finite"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_what_no_model_can_hold_is_named(name, tmp_path):
    columns, message = IMPOSSIBLE[name]
    damaged(tmp_path / "a.ply", lambda vertex: retyped(vertex, "f8", **columns))
    with pytest.raises(ValueError, match=rf"a\.ply: .*{message}") as caught:
        read_ply(tmp_path / "a.ply")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("unit", [1e-2, 1.0, 30.0])
def test_opacity_and_scale_that_were_stored_as_they_are_are_told_apart(tmp_path, unit, rng):
    """A lattice of Gaussians half as wide as their distance; the unit decides the sign of ln."""
    n = 64
    mean = unit * np.stack(np.unravel_index(np.arange(n), (4, 4, 4)), -1)
    size = unit * rng.uniform(0.3, 0.6, (n, 3))
    opacity = rng.uniform(0.05, 0.99, n)
    other = torch.randn(n, 4, generator=torch.Generator().manual_seed(0))
    model = Gaussians(
        mean=torch.from_numpy(mean).float(),
        log_scale=torch.from_numpy(np.log(size)).float(),
        quaternion=other,
        opacity_logit=torch.from_numpy(np.log(opacity / (1 - opacity))).float(),
        sh=other[:, None, :3],
    )
    write_ply(tmp_path / "right.ply", model)
    from plyfile import PlyData, PlyElement

    vertex = PlyData.read(str(tmp_path / "right.ply"))["vertex"].data
    stored = retyped(vertex, "f4", opacity=opacity, **{f"scale_{i}": size[:, i] for i in range(3)})
    PlyData([PlyElement.describe(stored, "vertex")]).write(str(tmp_path / "as_is.ply"))
    log = Lines()
    right = read_ply(tmp_path / "right.ply", log=log)
    assert log.said == ""
    read = read_ply(tmp_path / "as_is.ply", log=log)
    assert "not as a logit" in log.said and "not taken as a logarithm" in log.said
    # float32 of numbers of order one, and 1 - opacity of 0.01
    torch.testing.assert_close(read.log_scale, right.log_scale, atol=1e-5, rtol=0)
    torch.testing.assert_close(read.opacity, right.opacity, atol=1e-6, rtol=0)
