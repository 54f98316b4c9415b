"""What a material answers in the tests of a laboratory, and how that changes with its parameters.

All tests are run side by side (`materials/histories.py`), each from rest; the first row of a table is reached by one
more step, as long as the table says.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.laboratory.tables import LabTest
from physics3d.learning.fields import GlobalField
from physics3d.materials.base import AbstractMaterial
from physics3d.materials.histories import (
    NOMINAL,
    SHEAR,
    SHEAR_STRESS,
    STRETCH,
    TRUE,
    Histories,
    Schedule,
    histories,
    sensitivities,
)

PRESCRIBES = {
    ("nominal", "deformation"): STRETCH,
    ("true", "deformation"): STRETCH,
    ("shear", "deformation"): SHEAR,
    ("nominal", "stress"): NOMINAL,
    ("true", "stress"): TRUE,
    ("shear", "stress"): SHEAR_STRESS,
}


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Of one test: as `LabTest.measured`, and its derivative with respect to theta of the field."""

    measured: Float[np.ndarray, " t"]
    slope: Float[np.ndarray, "t p"]
    lost: bool  # no deformation was found that bears the load, or frees the sides


def schedule(tests: list[LabTest]) -> Schedule:
    rows = [1 + len(test.time) for test in tests]
    dt = torch.ones((max(rows), len(tests)), dtype=torch.float64)
    given = torch.ones_like(dt)
    for i, test in enumerate(tests):
        dt[1 : rows[i], i] = torch.from_numpy(np.concatenate([[test.lead], np.diff(test.time)]))
        column = test.deformation if test.control == "deformation" else test.stress
        given[1 : rows[i], i] = torch.from_numpy(column)
    prescribes = torch.tensor([PRESCRIBES[test.kind, test.control] for test in tests])
    return Schedule(prescribes=prescribes, rows=torch.tensor(rows), dt=dt, given=given)


def predict(
    material: AbstractMaterial, field: GlobalField, theta: Float[np.ndarray, " p"], tests: list[LabTest]
) -> list[Prediction]:
    """One per test. Raises ValueError if a parameter is out of range."""

    def coefficients(theta: Tensor) -> Tensor:
        return material.coefficients(field.parameters(theta)).to(torch.float64)[:, 0]

    point = torch.from_numpy(theta)
    c = coefficients(point)
    by_theta = torch.autograd.functional.jacobian(coefficients, point).numpy()
    columns, plan = c.detach()[:, None].expand(-1, len(tests)), schedule(tests)
    done = histories(material, columns, plan)
    by_c = sensitivities(material, columns, plan, done).numpy()
    values = _outputs(done)
    found = []
    for i, test in enumerate(tests):
        rows = slice(1, 1 + len(test.time))
        a, b, g, tau_11, _, tau_12 = values[rows, i].T
        d_a, d_b, d_g, d_11, _, d_12 = by_c[rows, i].transpose(1, 0, 2)
        if test.control == "stress":
            measured, slope = (g, d_g) if test.kind == "shear" else (a - 1, d_a)
        elif test.kind == "shear":
            measured, slope = tau_12, d_12
        elif test.kind == "nominal":
            measured, slope = tau_11 / a, d_11 / a[:, None]
        else:
            J = a * b**2
            measured, slope = tau_11 / J, d_11 / J[:, None] - (2 * tau_11 / (J * b))[:, None] * d_b
        found.append(Prediction(measured=measured, slope=slope @ by_theta, lost=bool(done.lost[i])))
    return found


def _outputs(done: Histories) -> Float[np.ndarray, "t s 6"]:
    tau = done.tau[..., [0, 1, 0], [0, 1, 1]]
    return torch.cat([torch.stack([done.stretch, done.side, done.shear], -1), tau], -1).numpy()
