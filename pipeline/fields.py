"""The fields of a class as its source declares them: hints, defaults and rules, read without importing the module.

Importing a stage costs ten seconds of torch and Warp; a value that cannot be should take one. The reader evaluates no
code but the hints themselves, of names from `physics3d.checks`, `typing` and the built-in types, followed through
imports and aliases of this project; a class of the project becomes a `Class`, what is none of these `Any`.
"""

import ast
import collections.abc
import math
import operator
import typing
from dataclasses import dataclass, field
from functools import cache, reduce
from typing import Any

from pipeline.fingerprint import PACKAGES, ROOT, _file, _tree

BUILTINS = {kind.__name__: kind for kind in (bool, int, float, str, tuple, list, dict)}
OUTSIDE = {"typing": typing, "collections.abc": collections.abc, "math": math}
ARITHMETIC = {ast.Pow: operator.pow, ast.Div: operator.truediv, ast.Mult: operator.mul}
VOCABULARY = ("physics3d.checks", "annotated_types")


class Class(type):
    """Stands for a class of the project in a hint; `path` is its dotted name."""

    path: str


@dataclass(frozen=True)
class Declared:
    """What the source of a dataclass says of itself and what it inherits."""

    name: str
    hints: dict[str, Any] = field(default_factory=dict)
    defaults: dict[str, Any] = field(default_factory=dict)  # of the fields that need not be given; Any: made by code
    rules: tuple[Any, ...] = ()
    ranges: dict[str, Any] = field(default_factory=dict)  # of the parameters of a material
    constants: dict[str, Any] = field(default_factory=dict)  # class variables with a value
    ancestors: frozenset[str] = frozenset()  # dotted names, its own among them


class Unknown(Exception):
    """A name that no module of this project defines."""


@cache
def declared(path: str) -> Declared:
    """The class of a dotted name. Raises Unknown if there is none in this project."""
    module, _, name = path.rpartition(".")
    node = _find(module, name)
    if not isinstance(node, ast.ClassDef):
        raise Unknown(path)
    parents = [declared(base.path) for base in (_value(b, module) for b in node.bases) if isinstance(base, Class)]
    hints = {k: v for parent in parents for k, v in parent.hints.items()}
    defaults = {k: v for parent in parents for k, v in parent.defaults.items()}
    rules = tuple(rule for parent in parents for rule in parent.rules)
    ranges: dict[str, Any] = {}
    constants = {k: v for parent in parents for k, v in parent.constants.items()}
    is_dataclass = any("dataclass" in ast.dump(decorator) for decorator in node.decorator_list)
    for line in node.body:
        if isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Name):
            if line.targets[0].id == "RULES":
                rules += tuple(_value(line.value, module))
            if line.targets[0].id == "RANGES":
                ranges = _value(line.value, module)
        elif isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
            hint = _value(line.annotation, module)
            if typing.get_origin(hint) is typing.ClassVar:
                if line.value is not None:
                    constants[line.target.id] = _value(line.value, module)
                continue
            if not is_dataclass:
                continue
            hints[line.target.id] = hint
            if line.value is not None:
                defaults[line.target.id] = _value(line.value, module)
    ancestors = frozenset({path}.union(*(parent.ancestors for parent in parents)))
    return Declared(name, hints, defaults, rules, ranges, constants, ancestors)


def classes(module: str) -> list[str]:
    """Names of the classes that a module of this project defines."""
    if not _ours(module):
        return []
    return [node.name for node in _tree(_file(module, ROOT)).body if isinstance(node, ast.ClassDef)]


def _ours(module: str) -> bool:
    return module.split(".")[0] in PACKAGES and _file(module, ROOT).is_file()


def _find(module: str, name: str) -> ast.AST | None:
    """The class or the value of the assignment of that name in a module of the project, imported names followed."""
    for node in _tree(_file(module, ROOT)).body if _ours(module) else ():
        if isinstance(node, ast.ClassDef) and node.name == name:
            return node
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == name for t in node.targets):
            return node.value
    return None


def _imported(module: str, name: str) -> str | None:
    """Dotted name behind a name that a module imports."""
    for node in _tree(_file(module, ROOT)).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return f"{node.module}.{alias.name}"
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return alias.name
    return None


@cache
def _named(module: str, name: str) -> Any:
    """What a name means in a module: a hint, or an object to call or subscript; Any if it is not of this world."""
    node = _find(module, name)
    if isinstance(node, ast.ClassDef):
        kind = Class(name, (), {})
        kind.path = f"{module}.{name}"
        return kind
    if node is not None:
        return _value(node, module)
    path = _imported(module, name)
    return BUILTINS.get(name, Any) if path is None else _dotted(path)


def _dotted(path: str) -> Any:
    """A dotted name, whatever module it is in."""
    module, _, name = path.rpartition(".")
    if module in VOCABULARY:
        return getattr(__import__(module, fromlist=[name]), name)
    if module in OUTSIDE:
        return getattr(OUTSIDE[module], name)
    return _named(module, name) if _ours(module) else Any


def _value(node: ast.AST, module: str) -> Any:
    """The hint, number or rule that an expression in a module stands for."""
    match node:
        case ast.Constant(value=str(text)) if not text.isidentifier() and "[" in text:
            return _value(ast.parse(text, mode="eval").body, module)
        case ast.Constant(value=value):
            return value
        case ast.Name(id=name):
            return _named(module, name)
        case ast.Attribute(value=ast.Name(id=owner), attr=name):
            path = _imported(module, owner)
            return _dotted(f"{path}.{name}") if path else Any
        case ast.Tuple(elts=items) | ast.List(elts=items):
            return tuple(_value(item, module) for item in items)
        case ast.Dict(keys=keys, values=values):
            found: dict[str, Any] = {}
            for k, v in zip(keys, values, strict=True):
                found |= _value(v, module) if k is None else {_value(k, module): _value(v, module)}
            return found
        case ast.Subscript(value=of, slice=inside):
            outer = _value(of, module)
            return Any if outer is Any else outer[_value(inside, module)]
        case ast.BinOp(left=left, op=ast.BitOr(), right=right):
            options = [o for o in (_value(left, module), _value(right, module)) if o is not Any]
            if any(isinstance(option, dict) for option in options):
                return {k: v for option in options for k, v in option.items()}
            return reduce(operator.or_, (type(None) if o is None else o for o in options)) if options else Any
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in ARITHMETIC:
            return ARITHMETIC[type(sign)](_value(left, module), _value(right, module))
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_value(operand, module)
        case ast.Call(func=called, args=arguments, keywords=named) if not any(k.arg is None for k in named):
            made = _value(called, module)
            words = {k.arg: _value(k.value, module) for k in named if k.arg}
            return Any if made is Any else made(*(_value(a, module) for a in arguments), **words)
    return Any
