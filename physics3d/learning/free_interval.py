"""How far the material of a motion of unknown cause can be trusted: `interval.py`, with the amplitudes taken out.

The flow that a material makes at its best amplitudes x (`free_motion.py`) is u = J(x) Phi x. What a parameter changes
and no amplitude can make good is

    P_i = (1 - Phi (Phi^T w Phi + ridge)^-1 Phi^T w) d(Phi x)/d theta_i

the efficient direction of variable projection (Kaufman 1975). J P are the derivatives of the data, and what is left of
the flow its residuals. theta is the stiffness, ln r and ln tau, and the zones if they were taken. A free motion knows
no force, so density and length go into it as stiffness does.

What large swings do to frequency and damping, k and g (`large_swing.py`), the same clip had to tell: they are in theta
as well, for what they are wrong by stiffness, r and tau make good. And a branch is told from a spring by how much
stiffer fast motion is than slow motion, which the body that was found has wrong by as much as in `interval.py`.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from physics3d.learning.free_motion import LIKELY, WIDTH, FreeMotion, Material, Reduced, start, swinging
from physics3d.learning.identify import WIDTH as LARGE_WIDTH
from physics3d.learning.interval import Beyond, Posterior, log_normal, posterior, told
from physics3d.learning.large_swing import SMALL, LargeSwing
from physics3d.learning.mirror import time_by_modulus
from physics3d.learning.sandwich import Evidence, blocks, correlation_length
from physics3d.learning.seen_modes import Observed, Sight
from physics3d.log import Log
from physics3d.world import Estimate, Interval

STEP = 0.02  # of theta, in differences to both sides


def free_posterior(
    body: Reduced,
    material: Material,
    clip: Observed,
    *,
    sight: Sight,
    flow: Float[np.ndarray, "t n 2"],
    weight: Float[np.ndarray, "t n"],
    reference: float | None,
    large: LargeSwing = SMALL,
    width: float,
    beyond: Beyond,
    log: Log,
) -> Posterior:
    """Of theta - what was likely. `flow` [px] and its `weight` at the pixels of the sight, in the frames of `clip`.
    `large`: as the clip tells it, or SMALL, which is known. `beyond`: for a body without a grid (`Beyond.of`)."""
    zones = len(material.zones) if np.ptp(material.zones) > 0 else 0
    law = [] if large is SMALL else [large.slower, large.sooner]
    theta = np.concatenate([[material.stiffness, material.ratio, material.time], material.zones[:zones], law])
    likely = np.concatenate([[0.0, math.log(LIKELY["ratio"]), math.log(LIKELY["time"])], np.zeros(zones + len(law))])
    before = np.array(
        [width, WIDTH["ratio"], WIDTH["time"]]
        + [WIDTH["zone"]] * zones
        + [LARGE_WIDTH["slowing"], LARGE_WIDTH["loss"]][: len(law)]
    )

    def course(values: np.ndarray) -> tuple[FreeMotion, Float[np.ndarray, "t m"]]:
        """(the best motion with these numbers, what the flow shows of it)."""
        one = Material.of(np.concatenate([values[:3], values[3 : 3 + zones] if zones else material.zones]))
        swings = replace(large, slower=values[-2], sooner=values[-1]) if law else large
        motion, _ = start(body, one, clip, reference=reference, large=swings)
        q = np.stack([motion.at(i / clip.fps) for i in range(len(clip.gram))])
        return motion, (q if reference is None else q - motion.at(reference))

    motion, here = course(theta)
    sides = [[course(theta + side * STEP * e)[1] for side in (1, -1)] for e in np.eye(len(theta))]
    change = np.stack([(up - down) / (2 * STEP) for up, down in sides], -1)
    swing = swinging(body, material, clip, reference=reference, large=large)
    basis = np.einsum("mk,akt->tmak", swing.shape, swing.functions).reshape(*here.shape, -1)
    weighed = np.einsum("tmn,tnx->tmx", clip.gram, change)
    amplitude = np.linalg.solve(
        swing.normal + np.diag(swing.ridge), np.einsum("tma,tmx->ax", basis, weighed, optimize=True)
    )
    efficient = change - basis @ amplitude
    residual = np.einsum("ncm,tm->tnc", sight.jacobian, here, optimize=True) - flow
    slope = np.einsum("ncm,tmx->tncx", sight.jacobian, efficient, optimize=True)
    scores = np.einsum("tn,tnc,tncx->tnx", weight, residual, slope, optimize=True)
    shares = np.einsum("tn,tncx->tnx", weight, slope**2, optimize=True)
    picture = np.zeros((2 * len(flow), *sight.thing.shape))
    picture[:, *sight.pixel.T] = (residual * np.sqrt(weight)[..., None]).transpose(0, 2, 1).reshape(len(picture), -1)
    block, count = blocks(sight.pixel[:, 0], sight.pixel[:, 1], correlation_length(picture))
    summed = lambda values: np.stack([np.bincount(block, v, count) for v in values])
    each = lambda values: np.stack([summed(values[..., i]) for i in range(len(theta))], -1)
    stiff, none = np.eye(len(theta))[0], np.zeros(len(theta))
    branch = _of_branch(motion, material, len(theta))
    evidence = Evidence(
        JJ=np.einsum("tn,tncx,tncy->xy", weight, slope, slope, optimize=True), score=each(scores), share=each(shares)
    )
    return posterior(
        theta - likely,
        told(evidence, before=before, log=log),
        before=before,
        beyond=beyond.covariance(stiff, none, none, branch),
    )


def _of_branch(motion: FreeMotion, material: Material, count: int) -> Float[np.ndarray, " k"]:
    """`interval.of_branches` for r and tau: of the mode that is seen most, among `count` numbers."""
    change = np.zeros(count)
    change[1] = 1 + math.exp(-material.ratio)  # 1/share of the branch in fast motion
    omega = 2 * math.pi * float(motion.frequency[np.argmax(motion.loudness)])
    change[2] = change[1] * time_by_modulus(omega * math.exp(material.time))
    return change


def free_intervals(found: Estimate, material: Material, after: Posterior) -> dict[str, Interval]:
    """Of the mean stiffness, of the branch, which goes with it, and of the relaxation time."""
    theta = np.array(
        [material.stiffness, material.ratio - math.log(LIKELY["ratio"]), material.time - math.log(LIKELY["time"])]
    )
    sums = {
        "youngs_modulus": (1, 0, 0),
        "branch_shear_modulus": (1, 1, 0),
        "branch_bulk_modulus": (1, 1, 0),
        "shear_relaxation_time": (0, 0, 1),
        "bulk_relaxation_time": (0, 0, 1),
    }
    told = {}
    for name, parts in sums.items():
        e = np.array(parts, float)
        learned = float(torch.as_tensor(found.parameters[name]).double().log().mean().exp())
        told[name] = log_normal(
            middle=learned * math.exp(e @ (after.mean[:3] - theta)),
            deviation=math.sqrt(e @ after.covariance[:3, :3] @ e),
            before=float(np.linalg.norm(e * after.before[:3])),
        ).holding(learned)
    return told
