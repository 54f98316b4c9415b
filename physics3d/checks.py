"""What values a field may take: said once, beside the field, and read by all who take values from a person.

    frames: Annotated[int, Ge(2)]                # a whole number from 2 on
    dx: Length                                   # an alias from below
    kind: Literal["sticky", "slip", "separate"]
    RULES = (Corners("lower", "upper"),)         # what has to hold between the fields of a class

A hint is a Python type, with limits in `Annotated` (those of the package annotated_types, and a few of ours). A whole
number is no float, a truth value no number, and every number is finite and below 1e18, so that its square is finite in
single precision as well, unless its limits say otherwise. `require_fields` holds an object to the hints of its class;
the command line reads the same hints from the source, without importing anything heavy.
"""

import builtins
import itertools
import math
import re
import types
import typing
from collections import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from annotated_types import BaseMetadata, Ge, Gt, Le, Lt, MinLen, MultipleOf, Unit

LARGEST = 1e18  # of any number: its square is finite in float32
SMALLEST = 1e-18  # of any number that is not 0: its square is not 0 in float32
MANY = 10**9  # of anything that is counted
Elsewhere = Callable[[Any, Any, str], str | None]  # complaint about a value whose hint is a class of the project


@dataclass(frozen=True)
class MayBeInfinite(BaseMetadata):
    """A time without an end."""


@dataclass(frozen=True)
class Like(BaseMetadata):
    """Text of this pattern."""

    pattern: str
    words: str  # what the pattern says, for a person


@dataclass(frozen=True)
class NotZero(BaseMetadata):
    """A vector with a direction."""


@dataclass(frozen=True)
class Ascending(BaseMetadata):
    """Numbers of which each is at least the one before it."""


@dataclass(frozen=True)
class LeftTopRightBottom(BaseMetadata):
    """A box in an image: left < right, top < bottom."""


@dataclass(frozen=True)
class Keys(BaseMetadata):
    """A mapping with exactly these names."""

    names: tuple[str, ...]


Count = Annotated[int, Ge(1), Le(MANY)]
Whole = Annotated[int, Ge(0), Le(MANY)]
Seed = Annotated[int, Ge(0), Lt(2**32)]
Frames = Annotated[int, Ge(2), Le(100_000)]
Pixels = Annotated[int, Ge(1), Le(16384), Unit("px")]
Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Share = Annotated[float, Ge(0), Le(1)]
Factor = Annotated[float, Gt(0), Le(1)]
Length = Annotated[float, Gt(0), Le(10_000), Unit("m")]
Time = Annotated[float, Ge(0), Unit("s")]
Duration = Annotated[float, Gt(0), Unit("s")]
Lasting = Annotated[float, Gt(0), Unit("s"), MayBeInfinite()]
Rate = Annotated[float, Gt(0), Le(100_000), Unit("1/s")]
Colour = tuple[Share, Share, Share]
Direction = Annotated[tuple[float, float, float], NotZero()]
Text = Annotated[str, MinLen(1)]
Name = Annotated[str, Like(r"(?!\.{1,2}$|\s*$)[^/\\\x00-\x1f]+", "a name that a file can have")]
Device = Annotated[str, Like(r"auto|cpu|cuda(:\d+)?", "auto, cpu, cuda or cuda:<number>")]
Every = Literal[0] | Annotated[int, Ge(2), Le(MANY)]  # of every so many one; 0: none
PoissonsRatio = Annotated[float, Gt(-1), Lt(0.5)]


@dataclass(frozen=True)
class Corners:
    """Both corners of a box or neither, ordered along every axis and, if so, a multiple of `apart` from each other."""

    lower: str
    upper: str
    apart: str | None = None  # field with the least extent

    def __call__(self, values: Mapping[str, Any], where: str) -> str | None:
        low, high = _listed(values[self.lower]), _listed(values[self.upper])
        if (low is None) != (high is None):
            low, high = ("null" if corner is None else corner for corner in (low, high))
            return f"{where}.{self.lower} is {low} and {self.upper} {high}; take both corners, or neither"
        least = 0 if self.apart is None else values[self.apart]
        if low is None or all(b - a >= least and b > a for a, b in zip(low, high, strict=True)):
            return None
        margin = "below" if self.apart is None else f"at least {self.apart} = {least:g} m below"
        return (
            f"{where}.{self.lower} is {tuple(low)}; take a corner {margin} {self.upper} = {tuple(high)} on every axis"
        )


@dataclass(frozen=True)
class Given:
    """So many of the fields are given (are neither null, false nor empty)."""

    names: tuple[str, ...]
    least: int
    most: int

    def __call__(self, values: Mapping[str, Any], where: str) -> str | None:
        given = [name for name in self.names if _given(values[name])]
        if self.least <= len(given) <= self.most:
            return None
        how = "exactly one" if self.most == 1 else "at least one"
        what = f"{where}.{self.names[0]} is {values[self.names[0]]}"
        return f"{what}, given are {', '.join(given) or 'none'}; take {how} of {', '.join(self.names)}"


def exactly_one(*names: str) -> Given:
    return Given(names, 1, 1)


def at_least_one(*names: str) -> Given:
    return Given(names, 1, len(names))


@dataclass(frozen=True)
class NamesOf:
    """The names in a field, at any depth, stand in another one (dots lead into it), and each but once."""

    field: str
    other: str

    def __call__(self, values: Mapping[str, Any], where: str) -> str | None:
        known = _flat(_into(values, self.other))
        names = list(_flat(values[self.field]))
        for name in names:
            if name not in known:
                return f"{where}.{self.field} names {name!r}; take some of {', '.join(known) or 'none'}"
        twice = sorted({name for name in names if names.count(name) > 1})
        return f"{where}.{self.field} names {', '.join(twice)} twice; take each once" if twice else None


def require_fields(of: Any, where: str) -> None:
    """Raise ValueError naming the first field of a dataclass object that its hints do not allow, value and remedy."""
    kind = type(of)
    values = {field.name: getattr(of, field.name) for field in fields(of)}
    for name, value in values.items():
        _raise(complaint(_hints(kind)[name], value, f"{where}.{name}"))  # type: ignore[arg-type]
    for rule in getattr(kind, "RULES", ()):
        _raise(rule(values, where))


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def complaint(hint: Any, value: Any, name: str, elsewhere: Elsewhere = lambda hint, value, name: None) -> str | None:
    """What is wrong with a value, in one line with the remedy, or None. Tensors and arrays are taken as lists.

    Hints that are classes of the project, or are not known here, are left to `elsewhere`.
    """
    bare, limits = _apart(hint)
    value = _listed(value)
    inside = None
    match bare in SIMPLE or get_origin(bare):
        case True:
            good = _same_kind(bare, value)
        case _ if bare is Any:
            good = True
        case typing.Union | types.UnionType:
            options = [option for option in get_args(bare) if not hasattr(option, "tolist")]  # arrays are lists here
            found = [complaint(option, value, name, elsewhere) for option in options]
            good = None in found
            alike = [text for option, text in zip(options, found) if _may_mean(_apart(option)[0], value)]
            inside = alike[0] if len(alike) == 1 and not good else None
        case typing.Literal:
            good = any(value == choice and type(value) is type(choice) for choice in get_args(bare))
        case builtins.tuple:
            hints = get_args(bare)
            good = _same_kind(bare, value) and (hints[-1] is ... or len(hints) == len(value))
            if good:
                each = itertools.repeat(hints[0]) if hints[-1] is ... else hints
                inside = _first(complaint(h, v, f"{name}.{i}", elsewhere) for i, (h, v) in enumerate(zip(each, value)))
        case builtins.dict | abc.Mapping:
            good = _same_kind(bare, value)
            if good:
                each = get_args(bare)[1]
                inside = _first(complaint(each, v, f"{name}.{k}", elsewhere) for k, v in value.items())
        case _ if bare is type(None):
            good = value is None
        case _:
            return elsewhere(bare, value, name)
    if inside is None and not (good and _within(value, limits, number=bare in (int, float))):
        small = f", not nearer to 0 than {SMALLEST:g}" if good and _vanishes(value) else ""
        return f"{name} is {'null' if value is None else repr(value)}; take {describe(hint)}{small}"
    return inside


SIMPLE = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


def _may_mean(bare: Any, value: Any) -> bool:
    """Whether a value is of that kind, or a mapping that has to become an object of that class."""
    is_class = isinstance(bare, type) and bare not in (*SIMPLE, type(None))
    return _same_kind(bare, value) or (is_class and isinstance(value, dict) and "_target_" in value)


def describe(hint: Any) -> str:
    """What a hint allows, for a person."""
    bare, limits = _apart(hint)
    of = {type(limit): limit for limit in limits}
    if Like in of:
        return of[Like].words
    if LeftTopRightBottom in of:
        return "left < right and top < bottom, as fractions of width and height in 0..1"
    if Keys in of:
        return f"{', '.join(of[Keys].names)}, each {describe(get_args(bare)[1])}"
    match get_origin(bare):
        case typing.Union | types.UnionType:
            return ", or ".join(describe(option) for option in get_args(bare) if not hasattr(option, "tolist"))
        case typing.Literal:
            return "one of " + ", ".join(map(str, get_args(bare)))
        case builtins.tuple:
            items = get_args(bare)
            length = "" if items[-1] is ... else f" of {len(items)}"
            ends = " that is not empty" * (MinLen in of) + " that are not all 0" * (NotZero in of)
            return f"a list{length}{ends}, each {describe(items[0])}" + ", none below the one before it" * (
                Ascending in of
            )
        case builtins.dict | abc.Mapping:
            return f"names, each with {describe(get_args(bare)[1])}"
    if bare in (None, type(None)):
        return "null"
    if bare not in SIMPLE:
        return f"the _target_ of a {getattr(bare, '__name__', bare)} with its fields"
    bounds = [f"{sign} {_bound(of[kind])}" for kind, sign in SIGNS.items() if kind in of]
    bounds += [f"a multiple of {of[MultipleOf].multiple_of}"] if MultipleOf in of else []
    bounds += ["not empty"] if MinLen in of else []
    if bare is float and not {Lt, Le} & set(of):
        bounds += [f"< {LARGEST:g}" if bounds else f"between -{LARGEST:g} and {LARGEST:g}"]
    unit = f" [{of[Unit].unit}]" if Unit in of else ""
    endless = ", or .inf" if MayBeInfinite in of else ""
    return f"{SIMPLE[bare]} {' and '.join(bounds)}".rstrip() + endless + unit


SIGNS: dict[type, str] = {Gt: ">", Ge: ">=", Lt: "<", Le: "<="}


def _bound(limit: Any) -> str:
    bound = next(getattr(limit, name) for name in ("gt", "ge", "lt", "le") if hasattr(limit, name))
    return f"{bound:g}" if isinstance(bound, float) else str(bound)


def _within(value: Any, limits: Sequence[Any], *, number: bool) -> bool:
    if number and not abs(value) < LARGEST and not (value == math.inf and MayBeInfinite() in limits):
        return False
    if number and _vanishes(value):
        return False
    return all(HOLDS[type(limit)](value, limit) for limit in limits if type(limit) in HOLDS)


def _vanishes(value: Any) -> bool:
    return isinstance(value, float) and 0 < abs(value) < SMALLEST


HOLDS: dict[type, Callable[[Any, Any], bool]] = {
    Gt: lambda value, limit: value > limit.gt,
    Ge: lambda value, limit: value >= limit.ge,
    Lt: lambda value, limit: value < limit.lt,
    Le: lambda value, limit: value <= limit.le,
    MultipleOf: lambda value, limit: value % limit.multiple_of == 0,
    MinLen: lambda value, limit: len(value.strip() if isinstance(value, str) else value) >= limit.min_length,
    Like: lambda value, limit: re.fullmatch(limit.pattern, value) is not None,
    NotZero: lambda value, limit: any(value),
    Ascending: lambda value, limit: all(a <= b for a, b in itertools.pairwise(value)),
    LeftTopRightBottom: lambda value, limit: value[0] < value[2] and value[1] < value[3],
    Keys: lambda value, limit: set(value) == set(limit.names),
}


def _apart(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """The bare type of an annotated one, and its limits."""
    if get_origin(hint) is Annotated:
        bare, *limits = get_args(hint)
        return bare, tuple(limits)
    return hint, ()


def _same_kind(hint: Any, value: Any) -> bool:
    """Whether the value is of the kind that the hint asks for, whatever its limits."""
    if hint in (int, float):
        return not isinstance(value, bool) and isinstance(value, int if hint is int else int | float)
    if get_origin(hint) is Literal:
        return type(value) in map(type, get_args(hint))
    if get_origin(hint) is tuple:
        return isinstance(value, list | tuple)
    if get_origin(hint) in (dict, Mapping):
        return isinstance(value, Mapping)
    return isinstance(value, hint) if isinstance(hint, type) else False


def _listed(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


def _given(value: Any) -> bool:
    value = _listed(value)
    return value is not None and value is not False and value != 0 and value not in ((), [], "")


def _into(values: Any, path: str) -> Any:
    for name in path.split("."):
        values = values[name] if isinstance(values, Mapping) else getattr(values, name)
    return values


def _flat(names: Any) -> list[str]:
    if isinstance(names, str):
        return [names]
    return [name for item in names for name in _flat(item)]


def _first(found: Any) -> str | None:
    return next((text for text in found if text), None)


def _raise(text: str | None) -> None:
    if text:
        raise ValueError(text)
