"""Can the classes that a composed configuration names take what it gives them? Answered in a second, without torch.

Every `_target_` is held to the hints and rules of its class (`physics3d/checks.py`, read by `fields.py`), and stages to
each other where what one is given decides what another may be. What is wrong is one line with key, value and remedy;
the key is the one to set: world.dx of a scene is scene.dx.
"""

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Annotated, Any

from physics3d.checks import Count, Device, Frames, Like, Name, Pixels, Seed, Text, complaint
from pipeline.fields import Class, Declared, Unknown, classes, declared

STAGES = ("capture", "guess", "reconstruct", "segment", "fill", "learn", "simulate", "render", "foretell", "evaluate")
STEPS = (*STAGES, "simulate_initial", "render_initial")  # of a run: the initial material goes through two stages again
MAY_BE_NULL = ("segment", "learn", "foretell", "evaluate")  # stages that a method may do without
Key = Annotated[str, Like("[0-9a-f]{1,16}", "the fingerprint of a result, or the beginning of one, in quotes")]
PLAIN = {  # entries that belong to no class
    "data": Text,
    "output": Text,
    "device": Device,
    "seed": Seed,
    "verify": bool,
    "twin": {"views": Count, "width": Pixels, "height": Pixels, "frames": Frames},
    "scene": {"name": Name},
    "use": {name: Key | None for name in STEPS},
}
USED_BY_STAGES = {  # entries that stages take over; those of a class are checked there
    "": ("world", "material", "prior", "estimator", "masker", "densification", "solid", *STAGES),
    "scene": [
        "source",
        "camera_distance",
        "thing",
        "prompts",
        "density",
        "dx",
        "spacing",
        "sheet_thickness",
        "gravity",
        "boundaries",
        "excitation",
    ],
    "material": ("model", "start", "learn", "ties"),
}


def problem(config: dict[str, Any], written: dict[str, Any]) -> str | None:
    """The first thing that is wrong with a configuration, or None. `written`: the same before interpolation."""
    text = next(_problems(config), None)
    return text and re.sub(r"^[\w.]+", lambda key: set_by(key[0], written), text)


def set_by(key: str, written: Any) -> str:
    """The key that a person sets to change `key`: interpolations such as ${scene.dx} are followed."""
    node, rest = written, key.split(".")
    for i, part in enumerate(rest):
        if isinstance(node, str) and (link := re.fullmatch(r"\$\{([\w.]+)\}", node)):
            return set_by(".".join([link[1], *rest[i:]]), written)
        try:
            node = node[int(part)] if isinstance(node, list) else node[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return key
    link = re.fullmatch(r"\$\{([\w.]+)\}", node) if isinstance(node, str) else None
    return set_by(link[1], written) if link else key


def _problems(config: dict[str, Any]) -> Iterator[str]:
    yield from _plain("", PLAIN, config)
    for name in STAGES:
        if config.get(name) is not None:
            yield from filter(None, [_object(_any_stage, config[name], name)])
        elif name not in MAY_BE_NULL:
            yield f"{name} is null; only {', '.join(MAY_BE_NULL)} may be, keep the others"
        elif name not in config:
            yield f"{name} is missing; {name}=null leaves it out"
    yield from _between(config)


def _plain(where: str, known: Mapping[str, Any], values: Any) -> Iterator[str]:
    """Entries of no class: none missing, none unknown, each as its hint says."""
    others = USED_BY_STAGES.get(where, ())
    for name in values:
        if name not in known and name not in others:
            yield f"{_join(where, name)}: there is no such entry; {nearest(name, [*known, *others])}"
    for name, hint in known.items():
        key = _join(where, name)
        if name not in values:
            yield f"{key} is missing; give it"
        elif isinstance(hint, dict):
            yield from _plain(name, hint, values[name]) if isinstance(values[name], dict) else [f"{key} is no mapping"]
        else:
            yield from filter(None, [complaint(hint, values[name], key)])
    if not where and isinstance(values.get("material"), dict):
        yield from _plain("material", {}, values["material"])


class _any_stage(metaclass=Class):
    path = ""


def _object(hint: Any, value: Any, name: str) -> str | None:
    """What is wrong with a mapping that has to become an object of the class `hint`."""
    if not isinstance(hint, Class):
        return None
    if not isinstance(value, dict) or not isinstance(value.get("_target_"), str):
        return f"{name} is {value!r}; take a mapping with the _target_ of a {hint.__name__} and its fields"
    target = value["_target_"]
    try:
        kind = declared(target)
    except Unknown:
        module, _, wanted = target.rpartition(".")
        there = classes(module)
        return f"{name}._target_ is {target}; {nearest(wanted, there) if there else 'there is no such module'}"
    if hint.path and hint.path not in kind.ancestors:
        return f"{name}._target_ is {target}; take a class that is a {hint.__name__}"
    given = {k: v for k, v in value.items() if k != "_target_"}
    for key in given:
        if key not in kind.hints:
            return f"{name}.{key}: {kind.name} has no such field; {nearest(key, list(kind.hints))}"
    for key, of in kind.hints.items():
        if key not in given and key not in kind.defaults:
            return f"{name}.{key} is missing; {kind.name} needs it"
        if key in given and (text := complaint(of, given[key], f"{name}.{key}", _object)):
            return text
    values = kind.defaults | given
    return next(filter(None, (check(values, name) for check in (*kind.rules, partial(_parameters, kind)))), None)


def _parameters(kind: Declared, values: dict[str, Any], name: str) -> str | None:
    """The start values of a world are parameters of its material, each in its range."""
    if not {"material", "start"} <= set(kind.hints):
        return None
    ranges = parameter_ranges(values["material"])
    for parameter, value in values["start"].items():
        allowed = ranges.get(re.sub(r"_[23]$", "", parameter))  # of a further branch likewise
        if allowed is None:
            return f"{name}.start.{parameter}: the material has no such parameter; {nearest(parameter, list(ranges))}"
        if text := complaint(allowed, value, f"{name}.start.{parameter}"):
            return text
    return None


def parameter_ranges(material: dict[str, Any]) -> dict[str, Any]:
    """Parameter -> what values it may take, of a configured material, its solid and its parts."""
    found = dict(declared(material["_target_"]).ranges)
    if isinstance(material.get("solid"), dict):
        found |= parameter_ranges(material["solid"])
    for part, of in material.get("materials", {}).items():
        found |= {f"{part}.{k}": v for k, v in parameter_ranges(of).items()}
    return found


def _between(config: dict[str, Any]) -> Iterator[str]:
    """What two stages are told has to go together."""
    world, spacing = config["simulate"]["world"], config["fill"]["spacing"]
    if spacing > world["dx"]:
        yield (f"fill.spacing is {spacing:g}; take at most a cell, world.dx = {world['dx']:g} m, better half of it")
    parts = {prompt.get("part", "body") for prompt in (config["segment"] or {}).get("prompts", ())}
    materials = world["material"].get("materials")
    if materials is not None and parts != set(materials):
        yield (
            f"segment.prompts names the parts {sorted(parts)}; take those that the material has, {sorted(materials)}, "
            "or another material"
        )
    source, learn = config["capture"]["source"], config["learn"]
    with suppress(Unknown):
        known = declared(source["_target_"])
        filmed = (known.defaults | source).get("frames") if {"frames", "fps"} <= set(known.hints) else None  # a twin
        if learn and filmed and (learn["frames"] or 0) > filmed:
            yield f"learn.frames is {learn['frames']}; take at most the {filmed} of a take (scene.source.frames)"
    force, excitation = config["simulate"].get("force"), config["simulate"].get("excitation", ())
    if force and any(force.values()) and not any(push.get("force") for push in excitation):
        yield (
            f"simulate.force is {force}, but no impulse in scene.excitation has a force that it could replace; take "
            "simulate.force=null and say there what pushes"
        )


def nearest(name: str, known: list[str], inside: Sequence[str] = ()) -> str:
    """What a misspelt name may have been, among those that are known inside of the entries `inside`."""
    close = difflib.get_close_matches(name, known, 1)
    return f"did you mean {_join(*inside, close[0])}?" if close else f"there are {', '.join(known) or 'none'}"


def _join(*parts: str) -> str:
    return ".".join(part for part in parts if part)
