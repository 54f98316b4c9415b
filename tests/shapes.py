"""The checker that holds arguments, results and fields to the shapes in their annotations while the tests run.

Other types are left to mypy, and values to the code itself, whose own words the tests want to read.
"""

from collections.abc import Callable
from typing import Any, get_args

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray

CONF = BeartypeConf(is_pep484_tower=True)  # a whole number will do where a real one is asked for


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` with the annotations checked that have a shape in them."""
    shaped = {name: hint for name, hint in function.__annotations__.items() if has_shape(hint)}
    if not shaped:
        return function
    function.__annotations__ = shaped
    return beartype(conf=CONF)(function)


def has_shape(hint: Any) -> bool:
    """Is it an array of some shape, or made of such: `Float[Tensor, "n 3"] | None`?"""
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(map(has_shape, get_args(hint)))
