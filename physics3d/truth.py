"""What is true of a parameter, where a scene knows it; of a part too, where the truth is one material for all."""

from collections.abc import Mapping


def truth_of(name: str, truth: Mapping[str, float]) -> float | None:
    """`stem.youngs_modulus` is the `youngs_modulus` of the body, unless the truth names the stem; None: unknown."""
    return truth.get(name, truth.get(name.rpartition(".")[2]))
