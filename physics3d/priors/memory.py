"""How much memory a video model takes, found before any of its weights are loaded: by a rehearsal without numbers.

The networks are built from the configuration beside the weights on torch's meta device, where tensors have a shape and
no content, and the steps of distillation are taken: encode and pull back, estimate. Every tensor that an operation
makes is counted from its birth to its end.

    always + network + max(A_encode, A_network)              all of the model stays on the device
    always + max(A_encode, network + A_network)              offload: the network comes for its estimates only

A is the largest sum of living activations, `network` and `always` (the VAE) are parameters times bytes of their
precision. What the libraries of a GPU take beside tensors (its context, scratch space of convolutions, fragments) is
not in it: allow for a gigabyte. A CPU copies what a convolution in three dimensions takes 27 times, which is not in it
either. Attention is counted as computed by blocks, without its square matrix.
"""

import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

GB = 1e9


@dataclass(frozen=True, kw_only=True)
class Memory:
    """What a prior takes where it runs."""

    device: str
    needed: int  # on that device, at the fullest moment [byte]
    beside: int = 0  # in the machine's memory beside a GPU, at the fullest moment [byte]
    remedy: str  # what makes it less

    def require(self) -> str:
        """In words, for the log. Raises ValueError if the device, or the machine, has less than that in all."""
        there = size(self.device)
        told = f"about {self.needed / GB:.2g} GB of {there / GB:.3g} GB on {self.device}"
        if self.needed > there:
            raise ValueError(f"the prior takes {told}; {self.remedy}")
        if not self.beside or self.device == "cpu":
            return told
        machine = size("cpu")
        told += f", and {self.beside / GB:.2g} GB of {machine / GB:.3g} GB in the machine"
        if self.beside > machine:
            raise ValueError(f"the prior takes {told}; take a machine with more, or a smaller model")
        return told


def together(
    device: str, *, offload: bool, always: int, network: int, way_back: int, forth: int, beside: int = 0
) -> Memory:
    """The sums above from their terms [byte]: A_encode is `way_back`, A_network `forth`; `beside` is what else the
    machine holds before."""
    on_cpu = device == "cpu"
    apart = offload and not on_cpu
    needed = always + (max(way_back, network + forth) if apart else network + max(way_back, forth))
    return Memory(
        device=device,
        needed=max(needed, beside) if on_cpu else needed,
        beside=max(beside, network if apart else 0),
        remedy="lower prior.height, prior.width or learn.frames"
        + ("" if apart or on_cpu else ", or take prior.offload=true"),
    )


def size(device: str) -> int:
    """Memory of a device [byte]. Raises ValueError if there is no such device."""
    if device == "cpu":
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if not torch.cuda.is_available():
        raise ValueError(f"prior.device is {device}, and there is no GPU here; take prior.device=cpu")
    return torch.cuda.get_device_properties(device).total_memory


def parameter_bytes(module: nn.Module) -> int:
    return sum(p.numel() * p.element_size() for p in module.parameters())


@contextmanager
def lent(module: nn.Module, device: str, *, back: bool) -> Iterator[nn.Module]:
    """The module on the device; afterwards `back` in the machine's memory, if so. It is there already if not."""
    if not back:
        yield module
        return
    try:
        yield module.to(device)
    finally:
        module.to("cpu")


def encoding(prior: Any, frames: int) -> int:
    """Largest activations while a video of the prior's own size becomes a code, and the code pulls at the video [byte].

    `prior` is one of the diffusion models, with its networks on the meta device; so in `estimating`.
    """
    with blockwise(), Living() as living:
        video = torch.zeros(frames, prior.height, prior.width, 3, device="meta", requires_grad=True)
        prior.encode(video).sum().backward()
        return living.most


def estimating(prior: Any, code: tuple[int, ...]) -> int:
    """Largest activations of one estimate of a code of that shape, and of what the prior is told before [byte]."""
    with torch.no_grad(), blockwise(), Living() as living:
        condition = prior.condition(torch.zeros(prior.height, prior.width, 3, device="meta"), ())
        prior.x0_hat(torch.zeros(code, device="meta"), prior.level(0.5), condition)
        return living.most


class Living(TorchDispatchMode):
    """Counts the bytes of all tensors made under it, for as long as they live."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.most = 0
        self.known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(made):
            if isinstance(tensor, Tensor):
                self.count(tensor.untyped_storage())
        return made

    def count(self, storage: torch.UntypedStorage) -> None:
        key = storage._cdata
        if key in self.known:  # a view, or written in place
            return
        self.known.add(key)
        self.now += storage.nbytes()
        self.most = max(self.most, self.now)
        weakref.finalize(storage, self.gone, key, storage.nbytes()).atexit = False

    def gone(self, key: int, bytes: int) -> None:
        self.known.discard(key)
        self.now -= bytes


@contextmanager
def blockwise() -> Iterator[None]:
    """On the meta device, attention without its square matrix, as GPUs compute it; torch would make one."""
    usual = nn.functional.scaled_dot_product_attention

    def attention(query: Tensor, key: Tensor, value: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        if query.device.type != "meta":
            return usual(query, key, value, *args, **kwargs)
        return query[..., :1] * value[..., :1, :]  # of the right shape, and with a way back

    nn.functional.scaled_dot_product_attention = attention
    try:
        yield
    finally:
        nn.functional.scaled_dot_product_attention = usual
