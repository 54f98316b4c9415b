"""A body ready for the fit of its free motion: stiffness by zones, and mass, in the basis of the modal solver."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from physics3d.filling.body import Body
from physics3d.learning.free_motion import Material, Reduced
from physics3d.log import Log
from physics3d.modes import vibration
from physics3d.modes.model import Model
from physics3d.modes.rollout import Solver
from physics3d.modes.stress import Points
from physics3d.world import Estimate, World

MODES = 16  # that the basis is made of
BRANCH = ("branch_shear_modulus", "branch_bulk_modulus", "shear_relaxation_time", "bulk_relaxation_time")


def reduced(world: World, body: Body, *, zones: int, scale: float, log: Log) -> tuple[Reduced, Model]:
    """`zones` of equal length by the distance from what holds the body, along it; one where nothing does. `scale`: of
    the camera [px/m]. Raises ValueError for a material that a free motion does not determine here."""
    needs = "learning from a motion of unknown cause needs material=viscoelastic with the elastic branch and one more"
    start = world.estimate().parameters
    if "youngs_modulus" not in start or not set(BRANCH) <= set(start) or f"{BRANCH[0]}_2" in start:
        raise ValueError(f"world.material is {type(world.material).__name__} with {sorted(start)}; {needs}")
    solver = Solver.of(
        world,
        body.position,
        body.volume,
        excitation=body.held,
        matter=body.matter,
        modes=MODES,
        swings_widely=False,
        log=log,
    )
    model = solver.model
    points = Points(world.material, solver.coefficients(start).numpy(), model.weight)
    still = np.zeros((len(model.weight), 3, 3))
    tangent = points.tangent(still, vibration.RELAXED)
    zone = zones_of(body, zones)
    K = np.stack(
        [
            vibration.stiffness(model.gradient, tangent * (zone[model.owner] == i)[:, None, None])
            for i in range(zone.max() + 1)
        ]
    )
    stuck = vibration.stiffness(model.gradient, points.tangent(still, vibration.STUCK))
    free = ~model.conditions.held
    S = model.values[free]
    share = (model.particle_mass[free] / model.particle_mass[free].sum())[:, None]
    return Reduced(
        zones=K,
        rest=model.stiffness - stuck,
        mass=np.kron(model.mass, np.eye(3)),
        weight=np.kron(S.T @ (share * S), np.eye(3)),
        scale=scale,
        zone=zone,
    ), model


def zones_of(body: Body, count: int) -> Int[np.ndarray, " p"]:
    """Zone of every particle: its distance from what is attached, along the body, in `count` equal parts."""
    from scipy.spatial import cKDTree

    position = body.position.double().numpy()
    if body.attached is None or not bool(body.attached.any()) or count < 2:
        return np.zeros(len(position), int)
    i, j = cKDTree(position).query_pairs(1.75 * body.spacing, output_type="ndarray").T
    length = np.linalg.norm(position[i] - position[j], axis=1)
    graph = sparse.coo_matrix((length, (i, j)), shape=(len(position),) * 2).tocsr()
    roots = np.flatnonzero(body.attached.numpy())
    far = sparse.csgraph.dijkstra(graph, directed=False, indices=roots, min_only=True)
    far[~np.isfinite(far)] = far[np.isfinite(far)].max()
    return np.minimum((count * far / max(float(far.max()), 1e-12)).astype(int), count - 1)


def estimate(world: World, material: Material, zone: Int[np.ndarray, " p"]) -> Estimate:
    """The material in the world's parameters: a field over the particles where zones differ."""
    start = world.estimate()
    values: dict[str, Tensor] = dict(start.parameters)
    factor = np.exp(material.stiffness + material.zones)
    by_particle = torch.from_numpy(factor)[torch.from_numpy(zone)]
    E = values["youngs_modulus"] * (by_particle if np.ptp(factor) > 0 else by_particle[0])
    nu, ratio = values["poissons_ratio"], float(np.exp(material.ratio))
    tau = torch.tensor(float(np.exp(material.time)), dtype=torch.float64)
    values |= {
        "youngs_modulus": E,
        "branch_shear_modulus": ratio * E / (2 * (1 + nu)),
        "branch_bulk_modulus": ratio * E / (3 * (1 - 2 * nu)),
        "shear_relaxation_time": tau,
        "bulk_relaxation_time": tau,
    }
    return replace(start, parameters=values)


def material_of(world: World, found: Estimate, zone: Int[np.ndarray, " p"]) -> Material:
    """The other way about: what a filed estimate says, by zones."""
    start, values = world.estimate().parameters, found.parameters
    relative = (values["youngs_modulus"].double() / start["youngs_modulus"]).expand(len(zone)).log().numpy()
    zones: Float[np.ndarray, " z"] = np.array([relative[zone == i].mean() for i in range(zone.max() + 1)])
    E, nu = values["youngs_modulus"].double().mean(), values["poissons_ratio"]
    ratio = values["branch_shear_modulus"].double().mean() / (E / (2 * (1 + nu)))
    mean = float(zones.mean())
    return Material(
        stiffness=mean,
        zones=zones - mean,
        ratio=float(ratio.log()),
        time=float(values["shear_relaxation_time"].double().mean().log()),
    )
