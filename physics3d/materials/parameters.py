"""Physical parameters of a material: their names, their ranges, and the rows that a Warp function reads."""

from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import PoissonsRatio, Positive, complaint

ELASTIC = {
    "youngs_modulus": Positive,  # E: stiffness against being drawn out, of small strains and slow motion [Pa]
    "poissons_ratio": PoissonsRatio,  # nu: how much it thins when drawn out; 0: not at all, near 0.5: keeps its volume
}
Values = dict[str, Tensor]  # physical name -> scalar or one number per particle, SI

_RENAMED = {"viscosity_time": "relaxation_time"}  # in names of parameters; old configurations and estimates have them


def check_old_names(names: Iterable[str]) -> None:
    """Raise ValueError if one of the names is called otherwise by now."""
    for name in names:
        for old, new in _RENAMED.items():
            if old in name:
                raise ValueError(f"{name} is called {name.replace(old, new)} now; rename it, the value stays [s]")


def check_names(values: Values, parameters: tuple[str, ...]) -> None:
    """Raise ValueError unless `values` has exactly the names in `parameters`."""
    check_old_names(values)
    missing, unknown = set(parameters) - set(values), set(values) - set(parameters)
    if missing or unknown:
        need = ", ".join(parameters)
        raise ValueError(f"material parameters: missing {sorted(missing)}, unknown {sorted(unknown)}; needed: {need}")


def check_range(value: Tensor, allowed: Any, name: str) -> None:
    """Raise ValueError unless every number in `value` is what the hint `allowed` says; NaN never is."""
    value = torch.as_tensor(value).detach()
    for extreme in (value.amin(), value.amax()) if value.numel() else ():
        wrong = complaint(allowed, float(extreme), name)
        if wrong:
            raise ValueError(wrong)


def lame(youngs_modulus: Tensor, poissons_ratio: Tensor) -> tuple[Tensor, Tensor]:
    """(mu, lam) [Pa] of Young's modulus [Pa] and Poisson's ratio."""
    mu = youngs_modulus / (2 * (1 + poissons_ratio))
    lam = youngs_modulus * poissons_ratio / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio))
    return mu, lam


def rows(*values: Tensor) -> Float[Tensor, "k n"]:
    """Stack scalars and per-particle values as rows of one matrix."""
    return torch.stack(torch.broadcast_tensors(*(torch.atleast_1d(torch.as_tensor(value)) for value in values)))
