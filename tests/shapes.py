"""The checker that holds arguments, results and fields to their annotations while the tests run, shapes included."""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintPep673Exception

CONF = BeartypeConf(is_pep484_tower=True)  # a whole number will do where a real one is asked for


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, or the class, with its annotations checked in every call."""
    try:
        return beartype(conf=CONF)(function)
    except BeartypeDecorHintPep673Exception:  # a method that returns Self cannot be seen from outside of its class
        return function
