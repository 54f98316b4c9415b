"""The whole motion as one OpenUSD file: Gaussians and particles with time samples, and the material.

    /World                           z up, metres, kilograms, one time code per frame
        /Gaussians                   ParticleField3DGaussianSplat (UsdVol, OpenUSD >= 26.03)
        /Body                        PhysicsDeformableBodyAPI
            /Particles               Points with NewtonPointsDeformableSimAPI: positions, masses, widths, ids
        /Materials/<part>            PhysicsMaterialAPI, NewtonMPMMaterialAPI and every parameter as physics3d:<name>
        /PhysicsScene                gravity; NewtonMPMSceneAPI with the spacing of the grid

The splat's scales are standard deviations as they are (not logarithms), its quaternions w x y z, its harmonics those of
3DGS. Axes and harmonics are turned frame by frame (`moving.py`).

Names of simulation are those of Newton's schemas (newton-usd-schemas 0.6). Newton's MPM knows an elastic solid with E
and nu; ours may have viscous branches and other laws, which stand beside in physics3d:*, SI: whoever simulates with E
and nu alone has the elastic branch alone. tensileYieldRatio = 1 and the yield pressure that Newton has by default make
its solid one that neither flows nor tears. What holds and what pushes the body is not written.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from physics3d.export.moving import Moving
from physics3d.filling.body import Body
from physics3d.log import Log
from physics3d.world import World

NEWTON = {"youngs_modulus": "youngsModulus", "poissons_ratio": "poissonsRatio"}  # our name -> newton:mpm:<name>
SIGMAS = 3.0  # of a Gaussian that count as its extent


def usd_size(moving: Moving, body: Body) -> int:
    """Of the file [byte], at most: equal arrays are stored once."""
    sampled = moving.count * 4 * (3 + 4 + 3 + (3 * moving.harmonics if moving.harmonics > 1 else 0))
    sampled += moving.count * 4 * (moving.interior is not None) + len(body.position) * 4 * 3
    return 20000 + len(moving) * sampled + moving.count * 4 * (1 + 3 * moving.harmonics) + len(body.position) * 40


def write_usd(
    path: Path, moving: Moving, body: Body, world: World, parameters: Mapping[str, Tensor], *, log: Log
) -> None:
    """Write `path` (.usdc or .usda). `parameters`: of the material, as an Estimate has them, SI.

    Raises RuntimeError with the remedy if OpenUSD is not installed, or says that it cannot write.
    """
    try:
        from pxr import Tf, Usd, UsdGeom, UsdPhysics
    except ImportError as error:
        raise RuntimeError("OpenUSD is not installed; run `make setup`, or pip install usd-core") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(moving.trajectory.fps)
        stage.SetFramesPerSecond(moving.trajectory.fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(moving) - 1)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
        _gaussians(stage, moving, log)
        scene = _scene(stage, world)
        materials = _materials(stage, world, parameters)
        _particles(stage, moving, body, world, parameters, scene, materials)
        if not stage.GetRootLayer().Save():
            raise RuntimeError(f"OpenUSD cannot write {path}; is the disk full?")
    except Tf.ErrorException as error:
        raise RuntimeError(f"OpenUSD cannot write {path}: {' '.join(str(error).split())[:300]}") from error


def _gaussians(stage, moving: Moving, log: Log) -> None:
    from pxr import UsdVol, Vt

    splat = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/Gaussians")
    splat.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
    splat.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)
    splat.CreateRadianceSphericalHarmonicsDegreeAttr(int(moving.harmonics**0.5) - 1)
    positions, orientations = splat.CreatePositionsAttr(), splat.CreateOrientationsAttr()
    scales, opacities = splat.CreateScalesAttr(), splat.CreateOpacitiesAttr()
    harmonics, extent = splat.CreateRadianceSphericalHarmonicsCoefficientsAttr(), splat.CreateExtentAttr()
    for i, g in enumerate(log.progress(moving.frames(), "usd", total=len(moving))):
        wide = SIGMAS * g.log_scale.exp().amax(1, keepdim=True)
        corners = torch.stack([(g.mean - wide).amin(0), (g.mean + wide).amax(0)])
        values = {
            positions: _vectors(g.mean),
            orientations: _quaternions(g.quaternion),
            scales: _vectors(g.log_scale.exp()),
            extent: _vectors(corners),
        }
        if moving.harmonics > 1:  # they turn with the body
            values[harmonics] = _vectors(g.sh.flatten(0, 1))
        if moving.interior is not None:
            values[opacities] = Vt.FloatArray.FromNumpy(_numpy(g.opacity))
        for attribute, value in values.items():
            attribute.Set(value, i)
        if i == 0:
            # what does not change, and for readers that know no time
            values |= {harmonics: _vectors(g.sh.flatten(0, 1)), opacities: Vt.FloatArray.FromNumpy(_numpy(g.opacity))}
            for attribute, value in values.items():
                attribute.Set(value)


def _scene(stage, world: World):
    from pxr import Gf, Sdf, UsdPhysics

    scene = UsdPhysics.Scene.Define(stage, "/World/PhysicsScene")
    gravity = np.asarray(world.gravity, np.float64)
    size = float(np.linalg.norm(gravity))
    scene.CreateGravityMagnitudeAttr(size)
    scene.CreateGravityDirectionAttr(Gf.Vec3f(*(gravity / size if size else (0.0, 0.0, -1.0))))
    prim = scene.GetPrim()
    prim.AddAppliedSchema("NewtonMPMSceneAPI")
    prim.CreateAttribute("newton:mpm:voxelSize", Sdf.ValueTypeNames.Float).Set(world.dx)
    return prim


def _materials(stage, world: World, parameters: Mapping[str, Tensor]) -> dict[str, object]:
    """Part -> its material; "" is all of the body, where no parameter names a part."""
    from pxr import Sdf, Tf, UsdGeom, UsdPhysics, UsdShade

    UsdGeom.Scope.Define(stage, "/World/Materials")
    made: dict[str, object] = {}
    for part in dict.fromkeys(name.rpartition(".")[0] for name in parameters):
        material = UsdShade.Material.Define(stage, f"/World/Materials/{Tf.MakeValidIdentifier(part or 'Body')}")
        prim = material.GetPrim()
        physics = UsdPhysics.MaterialAPI.Apply(prim)
        physics.CreateDensityAttr(world.density)
        prim.AddAppliedSchema("NewtonMPMMaterialAPI")
        number = lambda name, value, prim=prim: prim.CreateAttribute(name, Sdf.ValueTypeNames.Float).Set(value)
        number("newton:mpm:tensileYieldRatio", 1.0)
        for name, value in parameters.items():
            of, _, short = name.rpartition(".")
            if of != part:
                continue
            mean = float(value.double().mean())
            number(f"physics3d:{short}", mean)
            if short in NEWTON:
                number(f"newton:mpm:{NEWTON[short]}", mean)
        prim.CreateAttribute("physics3d:model", Sdf.ValueTypeNames.String).Set(type(world.material).__name__)
        made[part] = material
    return made


def _particles(
    stage, moving: Moving, body: Body, world: World, parameters: Mapping[str, Tensor], scene, materials
) -> None:
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    owner = UsdGeom.Xform.Define(stage, "/World/Body").GetPrim()
    owner.AddAppliedSchema("PhysicsDeformableBodyAPI")
    owner.CreateRelationship("physics:simulationOwner").SetTargets([scene.GetPath()])
    points = UsdGeom.Points.Define(stage, "/World/Body/Particles")
    prim = points.GetPrim()
    prim.AddAppliedSchema("NewtonPointsDeformableSimAPI")
    positions, extent = points.CreatePointsAttr(), points.CreateExtentAttr()
    half = body.spacing / 2
    positions.Set(_vectors(moving.trajectory.position[0]))
    for i, x in enumerate(moving.trajectory.position):
        positions.Set(_vectors(x), i)
        extent.Set(_vectors(torch.stack([x.amin(0) - half, x.amax(0) + half])), i)
    count = len(body.position)
    points.CreateIdsAttr(Vt.Int64Array.FromNumpy(np.arange(count)))
    points.CreateWidthsAttr(Vt.FloatArray.FromNumpy(np.full(count, body.spacing, np.float32)))
    floats = lambda name, value: prim.CreateAttribute(name, Sdf.ValueTypeNames.FloatArray).Set(
        Vt.FloatArray.FromNumpy(_numpy(value))
    )
    floats("physics:masses", world.density * body.volume)
    for name, value in parameters.items():
        if value.ndim:  # one number per particle
            floats(f"primvars:physics3d:{name.replace('.', ':')}", value)
    if body.attached is not None:
        floats("primvars:physics3d:attached", body.attached.float())
    binding = UsdShade.MaterialBindingAPI.Apply(prim)
    for part, material in materials.items():
        if part == "":
            binding.Bind(material, materialPurpose="physics")
            continue
        members = torch.nonzero(body.part == body.parts.index(part)).flatten()
        indices = Vt.IntArray.FromNumpy(members.numpy().astype(np.int32))
        subset = binding.CreateMaterialBindSubset(material.GetPrim().GetName(), indices, UsdGeom.Tokens.point)
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material, materialPurpose="physics")


def _numpy(value: Tensor) -> np.ndarray:
    return np.ascontiguousarray(value.detach().cpu().numpy(), np.float32)


def _vectors(value: Tensor):
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(_numpy(value))


def _quaternions(wxyz: Tensor):
    """As unit quaternions; in memory, OpenUSD has the real part last."""
    from pxr import Vt

    return Vt.QuatfArray.FromNumpy(_numpy(torch.nn.functional.normalize(wxyz, dim=1)[:, [1, 2, 3, 0]]))
