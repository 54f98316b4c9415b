"""A motion without physics, fitted to a clip: the peer that says what a simulator adds.

    x(t) = X + sum_k w_k(X) q_k(t),     F(t) = I + sum_k q_k(t) dw_k/dX
    w_k = g_k / sum_l g_l,              g_k = exp(-|X - c_k|^2 / (2 r^2))

Nodes c_k are spread over the body, r is their mean distance; the q_k(t) are free numbers, one set per frame, found by
Adam so that the pictures look like the recorded ones, with a pull towards motions that are smooth from frame to frame
and from node to node. It is what DreamGaussian4D (Ren et al. 2023) does with a HexPlane in the place of the nodes. Such
a field knows the clip that it was fitted to. Of another force it knows nothing, and can only play the same again.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.filling.body import Body
from physics3d.learning.chain import Draw
from physics3d.log import Log
from physics3d.priors.base import AbstractPrior
from physics3d.trajectory import Trajectory

SMOOTH_IN_TIME = 0.02  # of second differences, in units of the nodes' distance, against the picture's loss
SMOOTH_IN_SPACE = 0.02


def fit_field(
    clips: dict[int, Float[Tensor, "t h w 3"]],
    draw: Draw,
    body: Body,
    *,
    prior: AbstractPrior,
    fps: float,
    nodes: int = 48,
    steps: int = 150,
    frames_per_step: int = 4,
    learning_rate: float = 0.05,
    seed: int = 0,
    log: Log,
) -> Trajectory:
    """The motion of the body's particles at the frames of the clips, by number of the camera (`chain.filmed`).

    Pictures are compared in the prior's code; `fps` is the rate of the frames [1/s], `learning_rate` is of the q_k, in
    units of the nodes' distance.
    """
    first = next(iter(clips.values()))
    X = body.position.to(first.device)
    centre, reach = spread(X, nodes)
    w, slope = shape_functions(X, centre, reach)
    t = len(first)
    q = torch.zeros(
        t - 1, len(centre), 3, device=X.device, requires_grad=True
    )  # in units of the reach; frame 0 is rest
    adam = torch.optim.Adam([q], lr=learning_rate)
    generator = torch.Generator().manual_seed(seed)
    near = torch.cdist(centre, centre).argsort(1)[:, 1:5]
    views, moved = list(clips), unit(first, prior)
    for step in (bar := log.progress(range(steps), "deformation field")):
        view = views[int(torch.randint(len(views), (), generator=generator))]
        frames = 1 + torch.randperm(t - 1, generator=generator)[: min(frames_per_step, t - 1)].sort().values
        whole = torch.cat([torch.zeros_like(q[:1]), q])
        position, deformation = X + reach * w @ whole[frames], _gradient(whole[frames], slope, reach)
        adam.zero_grad()
        drawn = draw(position, deformation, view)
        picture = (prior.encode(drawn) - prior.encode(clips[view][frames])).square().sum() / drawn.numel()
        in_time = (whole[2:] - 2 * whole[1:-1] + whole[:-2]).square().mean()
        in_space = (whole[:, :, None] - whole[:, near]).square().mean()
        loss = picture + moved * (SMOOTH_IN_TIME * in_time + SMOOTH_IN_SPACE * in_space)
        loss.backward()
        adam.step()
        log.metric("picture", float(picture.detach()), step)
        bar.set_postfix(picture=f"{float(picture.detach()):.2e}")
    with torch.no_grad():
        whole = torch.cat([torch.zeros_like(q[:1]), q])
        position, deformation = X + reach * w @ whole, _gradient(whole, slope, reach)
        velocity = torch.gradient(position, spacing=1 / fps, dim=0)[0]
    return Trajectory(
        rest_position=body.position,
        position=position.cpu(),
        velocity=velocity.cpu(),
        deformation=deformation.cpu(),
        fps=fps,
        health={},
        substeps=0,
        substep_dt=1 / fps,
    )


def spread(X: Float[Tensor, "p 3"], count: int) -> tuple[Float[Tensor, "k 3"], float]:
    """So many of the points, each the furthest from those before it, and their mean distance to the next one."""
    chosen = [0]
    distance = (X - X[0]).norm(dim=1)
    while len(chosen) < min(count, len(X)):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (X - X[chosen[-1]]).norm(dim=1))
    centre = X[chosen]
    apart = torch.cdist(centre, centre) + torch.diag(torch.full((len(centre),), torch.inf)).to(centre)
    return centre, float(apart.amin(1).mean())


def shape_functions(
    X: Float[Tensor, "p 3"], centre: Float[Tensor, "k 3"], reach: float
) -> tuple[Float[Tensor, "p k"], Float[Tensor, "p k 3"]]:
    """w and dw/dX [1/m]."""
    away = X[:, None] - centre
    w = torch.softmax(-away.square().sum(-1) / (2 * reach**2), 1)  # g_k over their sum
    own = -away / reach**2
    return w, w[..., None] * (own - torch.einsum("pk,pki->pi", w, own)[:, None])


def unit(clip: Float[Tensor, "t h w 3"], prior: AbstractPrior) -> float:
    """The picture's loss of the body at rest, over all frames of one view."""
    code = prior.encode(clip) - prior.encode(clip[:1].expand_as(clip))
    return float(code.square().sum()) / clip.numel()


def _gradient(q: Float[Tensor, "t k 3"], slope: Float[Tensor, "p k 3"], reach: float) -> Float[Tensor, "t p 3 3"]:
    return torch.eye(3).to(q) + reach * torch.einsum("tki,pkj->tpij", q, slope)
