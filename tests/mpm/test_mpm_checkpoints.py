"""Fewer checkpoints cost time, never a bit of the gradient."""

import dataclasses

import pytest
import torch
from mpm_bodies import block, soft_world, tensors

from physics3d.log import Log
from physics3d.mpm.checkpoints import Checkpoints
from physics3d.mpm.rollout import rollout


@pytest.mark.parametrize("most", [1, 2, 3, 5, 8, None])
@pytest.mark.parametrize("n", [1, 7, 40])
def test_every_state_comes_back_within_the_bound(most, n):
    """State k is the number k; a replay adds one."""
    store, state, replays, largest = Checkpoints(most), torch.zeros(1), [], 0
    for k in range(n):
        store.offer(k, torch.tensor([float(k)]))
        largest = max(largest, len(store.kept))

    def replay(k: int) -> None:
        assert float(state) == k
        replays.append(k)
        state.add_(1)

    for k in reversed(range(n)):
        store.recall(k, state, replay)
        assert float(state) == k
        largest = max(largest, len(store.kept))
    assert most is None or largest <= most
    if most is None or most >= n:
        assert not replays
    elif most**2 >= n:
        assert len(replays) <= 2 * n


@pytest.mark.parametrize("states", [0, 2])
def test_gradient_is_the_same_bit_by_bit_with_few_checkpoints(states):
    world = soft_world(dt=0.02 / 75, precision="float32")
    position, volume = block((2, 2, 2), 0.1)
    generator = torch.Generator().manual_seed(0)
    velocity = 0.3 * torch.randn(len(position), 3, generator=generator)

    def gradients(limit: int | None) -> list[torch.Tensor]:
        bounded = dataclasses.replace(world, checkpoint_bytes=limit)
        inputs = {name: value.requires_grad_() for name, value in tensors(world.start).items()}
        inputs["velocity"] = velocity.clone().requires_grad_()
        parameters = {name: inputs[name] for name in world.start}
        motion = rollout(
            bounded, parameters, position, volume, velocity=inputs["velocity"], frames=4, frame_dt=0.02, threads=1,
            log=Log(None),
        )  # fmt: skip
        return list(torch.autograd.grad(motion.position.square().sum(), list(inputs.values())))

    state_bytes = 4 * 33 * len(position)
    for a, b in zip(gradients(None), gradients(states * state_bytes)):
        assert torch.equal(a, b)
