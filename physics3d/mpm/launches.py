"""Launches of kernels, packed once and repeated. Arguments go by their name in the kernel, never by their place.

What a kernel asks for and nobody gives, and what is given and no argument of it, is an error where the launch is made;
so is an adjoint of something that it does not have.
"""

import inspect
from collections.abc import Mapping
from functools import cache
from typing import Any

import torch
import warp as wp

Arguments = Mapping[str, Any]  # name in the kernel -> array or number


def record(
    kernel: wp.Kernel,
    count: int,
    own: Arguments,
    *,
    shared: Arguments,
    adjoints: Arguments | None = None,
    device: torch.device,
) -> wp.Launch:
    """A launch over `count` threads, of the adjoint of the kernel if there are `adjoints`: arrays for some arguments.

    `own` are arguments of this kernel; those that it does not name there are looked up in `shared`, which may hold
    more. Raises TypeError naming kernel and argument."""
    names = _names(kernel)
    for given in (own, adjoints or {}):
        unknown = [name for name in given if name not in names]
        if unknown:
            raise TypeError(f"{kernel.key} has no argument {', '.join(unknown)}; it takes {', '.join(names)}")
    missing = [name for name in names if name not in own and name not in shared]
    if missing:
        raise TypeError(f"{kernel.key} misses {', '.join(missing)}")
    return wp.launch(
        kernel,
        count,
        inputs=[own[name] if name in own else shared[name] for name in names],
        adj_inputs=[] if adjoints is None else [adjoints.get(name) for name in names],
        adjoint=adjoints is not None,
        device=str(device),
        record_cmd=True,
    )


def launch_over(launch: wp.Launch, first: int, count: int) -> None:
    """Launch over the `count` threads from `first` on."""
    if launch.bounds.size != count:  # type: ignore[attr-defined]  # a structure of C
        launch.set_dim(count)
    launch.set_param_by_name("first", first)
    launch.launch()


@cache
def _names(kernel: wp.Kernel) -> tuple[str, ...]:
    return tuple(inspect.signature(kernel.func).parameters)
