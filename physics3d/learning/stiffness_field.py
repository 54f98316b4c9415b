"""A field of stiffness: one factor on all moduli that varies over the body, where the clip asks for it.

    m(X) = m_0 exp(theta_m) exp(sum_k w_k(X) theta_k),     within m_0/span .. m_0 span

`trilinear`: w_k of a coarse voxel grid around the body. Nodes are so many along its longest side, as far apart along
the others, one where the body is thinner than half of that, and only those with matter near them.

`smooth`: a value per particle, alike where particles are near each other. The logarithm of the factor is a Gaussian
process of covariance exp(-|X - Y|^2/(2 l^2)) between two places; theta are its coefficients in the eigenvectors of the
covariance of up to LANDMARKS particles, from where it goes on to all others (Nystroem; Rasmussen and Williams 2006, ch.
8.1). Eigenvectors of small eigenvalues, by which neighbours would differ, are left out: what is left is as many numbers
as there are independent places.

In both, theta are pulled to 0, that is to one stiffness, by `stay`, as all of theta is.

More numbers always fit better. The field is taken where it explains more than its k numbers cost, by Schwarz' criterion
(1978) with as many independent data as the residuals tell of (`sandwich.py`): n effective places times frames,

    n/2 ln(L_whole/L_field) > k/2 ln n

with L the loss over all views and frames, a mean of squares. Residuals of neighbouring pixels err alike, so that n is
some dozens, not some hundred thousands.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.learning.deformation_field import spread as far_apart
from physics3d.learning.fields import GlobalField, is_elastic
from physics3d.learning.sandwich import Evidence, spread
from physics3d.log import Log

NODE = "node_"
WIDTH = 0.7  # of a node's theta before the clip, a standard deviation: half and twice as stiff are usual
LEAST = 0.02  # of the largest sum of weights, for a node to count; of the largest eigenvalue, for a vector
LANDMARKS = 500  # particles of which the covariance is taken


@dataclass(frozen=True, kw_only=True)
class StiffnessField:
    """Stands in for a GlobalField; theta is that of `whole`, and then one number for each node."""

    whole: GlobalField
    weights: Float[Tensor, "p k"]

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        return self.whole.groups

    @property
    def velocity_scale(self) -> float | None:
        return self.whole.velocity_scale

    @property
    def density(self) -> float | None:
        return self.whole.density

    @property
    def span(self) -> float:
        return self.whole.span

    @property
    def names(self) -> tuple[str, ...]:
        return self.whole.names + tuple(f"{NODE}{i}" for i in range(self.weights.shape[1]))

    def zero(self) -> Float[Tensor, " k"]:
        return torch.zeros(len(self.names), dtype=torch.float64)

    def bound(self, theta: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
        first, nodes = self._split(theta)
        limit = math.log(self.span)
        return torch.cat([self.whole.bound(first), nodes.clamp(-limit, limit)])

    def parameters(self, theta: Float[Tensor, " k"]) -> dict[str, Tensor]:
        """Moduli are one number per particle [p]; those that are learned stay within the span of their start."""
        first, nodes = self._split(theta)
        factor = (self.weights.to(theta) @ nodes).exp()
        values = self.whole.parameters(first)
        return {name: self._bounded(name, v * factor) if is_elastic(name) else v for name, v in values.items()}

    def _bounded(self, name: str, value: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        start = torch.as_tensor(self.whole.start[name]).to(value)
        return torch.minimum(torch.maximum(value, start / self.span), start * self.span)

    def velocity(self, theta: Float[Tensor, " k"]) -> Float[Tensor, " 3"]:
        return self.whole.velocity(self._split(theta)[0])

    def heavier(self, theta: Float[Tensor, " k"]) -> float:
        return self.whole.heavier(self._split(theta)[0])

    def _split(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        count = len(self.whole.names)
        return theta[:count], theta[count:]


def trilinear(X: Float[Tensor, "p 3"], nodes: int) -> Float[Tensor, "p k"]:
    """Weights of the nodes that count; they sum to 1 at every particle. `nodes` along the longest side, two or more."""
    X = X.double()
    low, size = X.amin(0), X.amax(0) - X.amin(0)
    step = float(size.max()) / (nodes - 1)
    count = (size / step - 1e-9).ceil().long()  # cells
    count[size < 0.5 * step + 1e-9 * step] = 0  # too thin to vary across: one node
    middle = 0.5 * (count * step - size)  # the grid is as far beyond the body on either side
    place = (X - low + middle) / step
    hats = [(1 - (place[:, axis, None] - torch.arange(int(count[axis]) + 1)).abs()).clamp_min(0) for axis in range(3)]
    weights = torch.einsum("pi,pj,pk->pijk", *hats).flatten(1)
    held = weights.sum(0)
    weights = weights[:, held > LEAST * held.max()]
    return weights / weights.sum(1, keepdim=True)


def smooth(X: Float[Tensor, "p 3"], length: float) -> Float[Tensor, "p k"]:
    """Weights of the eigenvectors of the covariance of that `length` [m] that count: independent theta of deviation 1
    give a field whose deviation is 1 everywhere, and that is alike within the length."""
    X = X.double()
    chosen, _ = far_apart(X, LANDMARKS)
    covariance = lambda a, b: (-torch.cdist(a, b).square() / (2 * length**2)).exp()
    value, vector = torch.linalg.eigh(covariance(chosen, chosen))
    counts = value > LEAST * value.max()
    weights = covariance(X, chosen) @ (vector[:, counts] / value[counts].sqrt())
    return weights / weights.norm(dim=1, keepdim=True)  # what was left out is shared out


def asked_for(losses: tuple[float, float], field: StiffnessField, evidence: Evidence, log: Log) -> bool:
    """Whether the clip asks for a field, by the losses without and with it and the `evidence` without."""
    told = spread(evidence)
    gain, cost = worth(*losses, nodes=field.weights.shape[1], independent=told.places * told.times)
    log.metric("field/gain", gain)
    log.metric("field/cost", cost)
    log.info(
        f"a field of stiffness of {field.weights.shape[1]} nodes: loss {losses[0]:.4g} -> {losses[1]:.4g}, worth "
        f"{gain:.1f} where its nodes cost {cost:.1f}: {'taken' if gain > cost else 'one stiffness is kept'}"
    )
    return gain > cost


def worth(before: float, after: float, *, nodes: int, independent: float) -> tuple[float, float]:
    """(gain, cost) of a field by the losses without and with it: differences of ln p, in nats."""
    n = max(independent, 2.0)
    return 0.5 * n * math.log(max(before, 1e-300) / max(after, 1e-300)), 0.5 * nodes * math.log(n)


def is_node(name: str) -> bool:
    """Whether a component of theta is that of a node."""
    return name.startswith(NODE)


def picture(X: Float[Tensor, "p 3"], parameters: dict[str, Tensor]) -> Any:
    """The body from two sides, coloured by the first of its moduli that varies."""
    from matplotlib.figure import Figure

    name, value = next((n, v) for n, v in parameters.items() if v.dim() == 1 and is_elastic(n))
    figure = Figure(figsize=(8, 4), layout="constrained")
    panels = figure.subplots(1, 2)
    for panel, across in zip(panels, (0, 1)):
        order = X[:, 1 - across].argsort(descending=across == 0)
        drawn = panel.scatter(X[order, across], X[order, 2], c=value[order].log10(), s=6)
        panel.set(aspect="equal", xlabel=f"{'xy'[across]} [m]", ylabel="z [m]")
    figure.colorbar(drawn, ax=panels, label=f"log10 of {name.replace('_', ' ')} [Pa]")
    return figure
