"""Every format, read back by a reader that is not ours, holds the numbers of the frame."""

import gzip
import math

import numpy as np
import pytest
import torch
from moving_bodies import FPS, FRAMES, PARAMETERS, SPACING, WORLD, moving
from scipy.spatial.transform import Rotation

from physics3d.export.gltf import glb_size, write_glb
from physics3d.export.ply import ply_size, write_ply_sequence
from physics3d.export.spz import spz_size, write_spz
from physics3d.export.usd import usd_size, write_usd
from physics3d.log import Log

HARMONICS = [1, 4, 16]
# float32 is stored; positions, logarithms and opacities are of order ten
NEAR = {"rtol": 2e-6, "atol": 2e-6}


def same_turn(a: np.ndarray, b: np.ndarray) -> None:
    """Quaternions w x y z of the same rotations; which of both signs is free."""
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    np.testing.assert_allclose(np.abs((a * b).sum(1)), 1, atol=1e-6)


@pytest.mark.parametrize("k", HARMONICS)
def test_ply_holds_every_frame(tmp_path, k):
    from plyfile import PlyData

    made, _ = moving(k, opening=True)
    write_ply_sequence(tmp_path / "out", made, log=Log(None))
    files = sorted((tmp_path / "out").iterdir())
    assert [f.name for f in files] == [f"frame{i:04d}.ply" for i in range(FRAMES)]  # and nothing else: SuperSplat
    # said before, on the safe side, and no more than a header too much
    written = sum(f.stat().st_size for f in files)
    assert written <= ply_size(made) <= written + FRAMES * 2000
    for file, g in zip(files, made.frames()):
        vertex = PlyData.read(str(file))["vertex"].data
        column = lambda *names, vertex=vertex: np.stack([vertex[name] for name in names], 1)
        assert len(vertex) == made.count
        np.testing.assert_allclose(column("x", "y", "z"), g.mean, **NEAR)
        np.testing.assert_allclose(column("scale_0", "scale_1", "scale_2"), g.log_scale, **NEAR)
        np.testing.assert_allclose(vertex["opacity"], g.opacity_logit, **NEAR)
        same_turn(column("rot_0", "rot_1", "rot_2", "rot_3"), g.quaternion.numpy())
        np.testing.assert_allclose(column("f_dc_0", "f_dc_1", "f_dc_2"), g.sh[:, 0], **NEAR)
        for c in range(3 if k > 1 else 0):  # channel by channel, as the authors' code has it
            rest = column(*(f"f_rest_{c * (k - 1) + j}" for j in range(k - 1)))
            np.testing.assert_allclose(rest, g.sh[:, 1:, c], **NEAR)


@pytest.mark.parametrize("k", HARMONICS)
def test_usd_holds_every_frame_and_the_material(tmp_path, k):
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade, UsdVol

    made, body = moving(k, opening=True)
    field = torch.linspace(1e4, 3e4, len(body.position))
    parameters = {"youngs_modulus": field, "poissons_ratio": torch.tensor(PARAMETERS["poissons_ratio"])}
    path = tmp_path / "out" / "thing.usdc"
    write_usd(path, made, body, WORLD, parameters, log=Log(None))
    size = path.stat().st_size
    assert size <= usd_size(made, body) <= 1.5 * size + 30000

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, FRAMES - 1, FPS)
    assert stage.GetDefaultPrim().GetPath() == "/World"
    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/Gaussians"))
    assert splat and splat.GetRadianceSphericalHarmonicsDegreeAttr().Get() == math.isqrt(k) - 1
    for i, g in enumerate(made.frames()):
        read = lambda attribute, i=i: np.array(attribute.Get(i))
        np.testing.assert_allclose(read(splat.GetPositionsAttr()), g.mean, **NEAR)
        np.testing.assert_allclose(read(splat.GetScalesAttr()), g.log_scale.exp(), **NEAR)
        np.testing.assert_allclose(read(splat.GetOpacitiesAttr()), g.opacity, **NEAR)
        wxyz = [(q.GetReal(), *q.GetImaginary()) for q in splat.GetOrientationsAttr().Get(i)]
        same_turn(np.array(wxyz), g.quaternion.numpy())
        sh = read(splat.GetRadianceSphericalHarmonicsCoefficientsAttr()).reshape(made.count, k, 3)  # by particle
        np.testing.assert_allclose(sh, g.sh, **NEAR)
        lower, upper = read(splat.GetExtentAttr())
        assert (lower <= g.mean.numpy().min(0)).all() and (upper >= g.mean.numpy().max(0)).all()

    points = UsdGeom.Points(stage.GetPrimAtPath("/World/Body/Particles"))
    for i, x in enumerate(made.trajectory.position):
        np.testing.assert_allclose(np.array(points.GetPointsAttr().Get(i)), x, **NEAR)
    np.testing.assert_allclose(np.array(points.GetPointsAttr().Get()), made.trajectory.position[0], **NEAR)
    prim = points.GetPrim()
    masses = np.array(prim.GetAttribute("physics:masses").Get())
    assert masses.sum() == pytest.approx(WORLD.density * float(body.volume.sum()), rel=1e-5)
    assert np.array(points.GetWidthsAttr().Get()).tolist() == pytest.approx([SPACING] * len(body.position))
    own = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("physics3d:youngs_modulus").Get())
    np.testing.assert_allclose(own, field)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
    assert UsdPhysics.MaterialAPI(material.GetPrim()).GetDensityAttr().Get() == WORLD.density
    value = lambda name: material.GetPrim().GetAttribute(name).Get()
    assert value("newton:mpm:youngsModulus") == pytest.approx(2e4)
    assert value("newton:mpm:poissonsRatio") == pytest.approx(0.3)
    assert value("physics3d:youngs_modulus") == pytest.approx(2e4) and value("physics3d:model") == "Viscoelastic"
    scene = UsdPhysics.Scene(stage.GetPrimAtPath("/World/PhysicsScene"))
    assert scene.GetGravityMagnitudeAttr().Get() == np.linalg.norm(WORLD.gravity)


def test_usd_gives_every_part_its_material(tmp_path):
    from dataclasses import replace

    from pxr import Usd, UsdGeom, UsdShade

    made, body = moving(1)
    part = (body.position[:, 2] > 0).int()
    body = replace(body, part=part, parts=("stem", "the head"))
    parameters = {f"{p}.youngs_modulus": torch.tensor(e) for p, e in (("stem", 2e5), ("the head", 1e4))}
    write_usd(tmp_path / "a.usda", made, body, WORLD, parameters, log=Log(None))
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    binding = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/World/Body/Particles"))
    found = {}
    for subset in binding.GetMaterialBindSubsets():
        material, _ = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial("physics")
        modulus = material.GetPrim().GetAttribute("newton:mpm:youngsModulus").Get()
        found[round(modulus)] = set(UsdGeom.Subset(subset).GetIndicesAttr().Get())
    assert found == {200000: set(np.flatnonzero(part == 0)), 10000: set(np.flatnonzero(part == 1))}


@pytest.mark.parametrize("k", HARMONICS)
def test_glb_holds_a_frame_with_y_up(tmp_path, k):
    from pygltflib import GLTF2

    made, _ = moving(k)
    g = made.frame(FRAMES - 1)
    path = tmp_path / "out" / "thing.glb"
    write_glb(path, g)
    assert path.stat().st_size <= glb_size(made.count, k) <= path.stat().st_size + 8000
    read = GLTF2().load(str(path))
    assert read.extensionsUsed == ["KHR_gaussian_splatting"]
    (primitive,) = read.meshes[0].primitives
    assert primitive.mode == 0 and read.nodes[read.scenes[read.scene].nodes[0]].mesh == 0
    assert primitive.extensions["KHR_gaussian_splatting"] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    blob = read.binary_blob()

    def values(name: str) -> np.ndarray:
        accessor = read.accessors[getattr(primitive.attributes, name)]
        view = read.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        assert accessor.componentType == 5126 and accessor.count == len(g)
        return np.frombuffer(blob, "<f4", accessor.count * width, view.byteOffset).reshape(-1, width)

    own = "KHR_gaussian_splatting:"
    y_up = Rotation.from_euler("x", -90, degrees=True)  # z goes to y, as every viewer of glTF has it
    np.testing.assert_allclose(values("POSITION"), y_up.apply(g.mean.numpy()), **NEAR)
    bounds = read.accessors[primitive.attributes.POSITION]
    np.testing.assert_allclose([bounds.min, bounds.max], [values("POSITION").min(0), values("POSITION").max(0)])
    np.testing.assert_allclose(values(f"{own}OPACITY")[:, 0], g.opacity, **NEAR)
    np.testing.assert_allclose(values("COLOR_0")[:, 3], g.opacity, **NEAR)
    np.testing.assert_allclose(values(f"{own}SCALE"), g.log_scale.exp(), **NEAR)
    xyzw = values(f"{own}ROTATION")
    np.testing.assert_allclose(np.linalg.norm(xyzw, axis=1), 1, atol=1e-6)
    expected = (y_up * Rotation.from_quat(g.quaternion.numpy()[:, [1, 2, 3, 0]])).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(xyzw).as_matrix(), expected, atol=1e-5)
    # the specification's formulas, written out here (degrees 0 and 1), seen along a direction in the file's axes
    sh = np.stack([values(f"{own}SH_DEGREE_{math.isqrt(j)}_COEF_{j - math.isqrt(j) ** 2}") for j in range(k)], 1)
    x, y, z = d = np.array([0.36, 0.48, 0.8])

    def colour(c, x, y, z):
        low = 0.2820947917738781 * c[:, 0]
        return low + (0.4886025119029199 * (-y * c[:, 1] + z * c[:, 2] - x * c[:, 3]) if k > 1 else 0)

    before = colour(g.sh.numpy(), *y_up.inv().apply(d))
    np.testing.assert_allclose(colour(sh, x, y, z), before, atol=1e-5)
    # a turn keeps the length of each degree's coefficients
    for degree in range(math.isqrt(k)):
        band = slice(degree**2, (degree + 1) ** 2)
        length = lambda c, band=band: (c[:, band] ** 2).sum(1)
        np.testing.assert_allclose(length(sh), length(g.sh.numpy()), rtol=1e-5, atol=1e-5)


def unpacked(path) -> dict[str, np.ndarray]:
    """An .spz of version 3, by the formulas of the reference reader (nianticlabs/spz, load-spz.cc: unpackGaussian,
    unpackQuaternionSmallestThree, inverse of the colour scale), written out here."""
    raw = gzip.decompress(path.read_bytes())
    magic, version, count = np.frombuffer(raw, "<u4", 3)
    degree, fraction, flags, reserved = raw[12:16]
    assert (magic, version, flags, reserved) == (0x5053474E, 3, 0, 0)
    rest = {0: 0, 1: 3, 2: 8, 3: 15}[degree]
    at, column = 16, {}
    for name, width in (("mean", 9), ("opacity", 1), ("dc", 3), ("scale", 3), ("turn", 4), ("rest", 3 * rest)):
        column[name] = np.frombuffer(raw, np.uint8, count * width, at).reshape(count, width)
        at += count * width
    assert at == len(raw)
    low, middle, high = (column["mean"].reshape(count, 3, 3)[:, :, k].astype(int) for k in range(3))
    fixed = low + 256 * middle + 65536 * high
    mean = np.where(fixed >= 2**23, fixed - 2**24, fixed) / 2**fraction
    quaternion = np.zeros((count, 4))  # x y z w
    for i, word in enumerate(column["turn"].copy().view("<u4")[:, 0].tolist()):
        largest, left = word >> 30, 1.0
        for axis in reversed(range(4)):
            if axis != largest:
                sign = -1 if word >> 9 & 1 else 1
                quaternion[i, axis] = sign * 0.5**0.5 * (word & 511) / 511
                left -= quaternion[i, axis] ** 2
                word >>= 10
        quaternion[i, largest] = max(left, 0) ** 0.5
    dc = (column["dc"] / 255 - 0.5) / 0.15
    sh = np.concatenate([dc[:, None], (column["rest"].reshape(count, rest, 3) - 128.0) / 128], 1)
    opacity, log_scale = column["opacity"][:, 0] / 255, column["scale"] / 16 - 10
    return {"mean": mean, "opacity": opacity, "log_scale": log_scale, "xyzw": quaternion, "sh": sh}


@pytest.mark.parametrize("k", HARMONICS)
def test_spz_holds_a_frame_with_y_up(tmp_path, k):
    made, _ = moving(k)
    g = made.frame(FRAMES - 1)
    path = tmp_path / "out" / "thing.spz"
    write_spz(path, g)
    assert path.stat().st_size <= spz_size(made.count, k)
    read = unpacked(path)
    y_up = Rotation.from_euler("x", -90, degrees=True)
    # half a step of what is stored, and float32's rounding on the way: 20 bits of fraction, bytes, 9 bits of 1/sqrt(2)
    np.testing.assert_allclose(read["mean"], y_up.apply(g.mean.numpy()), atol=2**-21 + 1e-6)
    np.testing.assert_allclose(read["opacity"], g.opacity, atol=0.5 / 255 + 1e-6)
    inside = g.log_scale.clamp(-10, 255 / 16 - 10)
    np.testing.assert_allclose(read["log_scale"], inside, atol=0.5 / 16 + 1e-6)
    same = y_up * Rotation.from_quat(g.quaternion.numpy()[:, [1, 2, 3, 0]])
    # three components, each half a step off, and the fourth that follows from them: at most four of these steps
    assert (Rotation.from_quat(read["xyzw"]) * same.inv()).magnitude().max() < 8 * 0.5 * 0.5**0.5 / 511
    # degree 0 does not turn; of degree 1, whose harmonics are ~ (-y, z, -x), (x, y, z) -> (x, z, -y) makes this
    np.testing.assert_allclose(
        read["sh"][:, 0], g.sh[:, 0].clamp(-0.5 / 0.15, 0.5 / 0.15), atol=0.5 / 255 / 0.15 + 1e-6
    )
    assert read["sh"].shape[1] == k
    if k > 1:
        along_y, along_z, along_x = (g.sh[:, j].clamp(-1, 127 / 128) for j in (1, 2, 3))
        for j, expected in ((1, -along_z), (2, along_y), (3, along_x)):
            np.testing.assert_allclose(read["sh"][:, j], expected, atol=1.5 / 128)


def test_spz_refuses_what_lies_too_far_for_its_numbers(tmp_path):
    from dataclasses import replace

    g = moving(1)[0].frame(0)
    for far, fits in ((1e6, True), (5e6, False)):
        mean = g.mean.clone()
        mean[0, 0] = far
        if fits:
            write_spz(tmp_path / "far.spz", replace(g, mean=mean))
            assert unpacked(tmp_path / "far.spz")["mean"][0, 0] == pytest.approx(far, abs=0.5)
            continue
        with pytest.raises(ValueError, match="take FORMAT=ply"):
            write_spz(tmp_path / "too_far.spz", replace(g, mean=mean))
