"""What a hint allows and what not, in words that a person can follow."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import pytest
import torch
from annotated_types import Ge, Le, MinLen, MultipleOf, Unit

from physics3d.checks import (
    Ascending,
    Corners,
    Device,
    Direction,
    Keys,
    LeftTopRightBottom,
    MayBeInfinite,
    NamesOf,
    Share,
    Text,
    at_least_one,
    complaint,
    exactly_one,
    require_fields,
)

Box = Annotated[tuple[Share, Share, Share, Share], LeftTopRightBottom()]
CASES = [  # hint, what it allows, what it does not, the remedy
    (bool, [True, False], [0, 1, "true", None], "take true or false"),
    (int, [0, -3], [1.0, True, "1", math.nan, None, [1]], "take a whole number"),
    (float, [0, -1.5, 1e17], [math.nan, math.inf, -math.inf, 1e18, 10**400, 1e-320, True, "1", None, [1.0], {}],
     "take a number between"),
    (Annotated[int, Ge(2), Le(9), Unit("px")], [2, 9], [1, 10, 2.5], "take a whole number >= 2 and <= 9 [px]"),
    (Annotated[int, MultipleOf(8)], [0, 16], [4, 8.0], "a multiple of 8"),
    (Annotated[float, Ge(0), MayBeInfinite()], [0, math.inf], [-1, -math.inf, math.nan], "or .inf"),
    (Text, ["a", "0"], ["", "  ", 0, None], "take text not empty"),
    (Literal["a", 1], ["a", 1], ["b", True, 1.0, None], "take one of a, 1"),
    (float | None, [None, 1.0], ["a", [], math.nan], "take a number"),
    (tuple[float, float], [(1, 2), [0.5, 2.0]], [(1,), (1, 2, 3), 3.0, None, ("a", 1.0), (1.0, math.nan)], "take a"),
    (Annotated[tuple[Text, ...], MinLen(1)], [["a"], ("a", "b")], [[], "a", [1]], "take"),
    (Annotated[tuple[float, float], Ascending()], [(1, 2), (2, 2)], [(2, 1)], "none below the one before it"),
    (Direction, [(0, 0, 1)], [(0, 0, 0), (0, 0), (0, 0, math.nan)], "take a"),
    (Box, [(0, 0, 1, 1)], [(0.5, 0, 0.2, 1), (0, 0.5, 1, 0.5), (0, 0, 1, 1.1), (0, 0, 1)], "take"),
    (Annotated[dict[str, float], Keys(("x", "y"))], [{"x": 1, "y": 2}], [{"x": 1}, {"x": 1, "y": 2, "z": 3}, 3],
     "x, y"),
    (Device, ["auto", "cpu", "cuda:1"], ["gpu", "cuda:", None, 0], "take auto, cpu, cuda or cuda:<number>"),
]  # fmt: skip


@pytest.mark.parametrize("hint, good, bad, remedy", CASES, ids=lambda value: str(value)[:30])
def test_a_hint_allows_what_it_says(hint, good, bad, remedy):
    for value in good:
        assert complaint(hint, value, "stage.key") is None, value
    for value in bad:
        text = complaint(hint, value, "stage.key")
        assert text is not None, value
        assert text.startswith("stage.key") and "\n" not in text
        assert f"{remedy}" in text or "take" in text
    assert any(remedy in complaint(hint, value, "key") for value in bad)


def test_a_tensor_is_taken_as_the_numbers_it_holds():
    Vector = tuple[float, float, float]
    assert complaint(Vector | torch.Tensor | None, torch.ones(3), "force") is None
    assert complaint(Vector | torch.Tensor | None, torch.ones(4), "force")
    assert complaint(Vector | torch.Tensor | None, torch.tensor([1.0, math.nan, 0.0]), "force").startswith(
        "force.1 is nan"
    )


@dataclass(frozen=True, kw_only=True)
class Thing:
    lower: tuple[float, float] | None = None
    upper: tuple[float, float] | None = None
    dx: float = 0.5
    names: tuple[tuple[str, ...], ...] = ()
    known: tuple[str, ...] = ("a", "b")
    one: float | None = 1.0
    other: float | None = None

    RULES = (
        Corners("lower", "upper", apart="dx"), NamesOf("names", "known"),
        exactly_one("one", "other"), at_least_one("known", "names"),
    )  # fmt: skip


@pytest.mark.parametrize(
    "change, says",
    [
        ({}, None),
        ({"lower": (0, 0), "upper": (1, 0.5)}, None),
        ({"lower": (0, 0)}, "take both corners, or neither"),
        ({"lower": (0, 0), "upper": (1, 0.4)}, "at least dx = 0.5 m below upper"),
        ({"names": (("a",), ("b",))}, None),
        ({"names": (("a",), ("c",))}, "names 'c'; take some of a, b"),
        ({"names": (("a", "a"),)}, "names a twice"),
        ({"one": None}, "exactly one of one, other"),
        ({"other": 0.5}, "exactly one of one, other"),
        ({"one": 1}, None),
        ({"known": ()}, "at least one of known, names"),
    ],
)
def test_what_holds_between_fields(change, says):
    if says is None:
        require_fields(Thing(**change), "thing")
    else:
        with pytest.raises(ValueError, match=f"^thing\\..*{says}"):
            require_fields(Thing(**change), "thing")
