"""make why SCENE=...: which stages a run would compute, and what has changed since the nearest result; runs nothing.

Every result says what it was made of (`fingerprint.made_of`). The nearest one of a stage is that with the fewest
differences, the newest of several. A difference is an entry of the configuration with its old and new value, a module
of the code, a data file, a version of a library, or an input that is another one than then. Nothing heavy is imported,
unless nobody has yet asked a source which files it reads. Exit codes: 0 said, 1 it cannot be said, 2 the command line
is wrong.
"""

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.filed import one_line
from pipeline.flow import Plan, first, plan
from pipeline.settings import compose
from pipeline.stage import (
    MANIFEST,
    Step,
    Unknown,
    damage,
    half_done,
    peek,
    read_manifest,
    spoilt,
    usual_seconds,
)
from pipeline.tracking import flatten
from pipeline.words import literal_paths

SHOWN = 8  # differences of a stage, at most; how many more there are is said
KINDS = ("config", "code", "data", "libraries")


def main(words: list[str]) -> int:
    return one_line(lambda: say(words), lambda text: print(text, file=sys.stderr), "nothing was changed")


def say(words: list[str]) -> None:
    """Raises SettingsError for words that mean nothing, StageError as a run would."""
    config, _ = compose(literal_paths(words))
    for line in explain(config, Path(config["output"]).expanduser().resolve() / "artifacts"):
        print(line)


def explain(config: dict[str, Any], shelf: Path) -> Iterator[str]:
    """Lines for a person. Raises StageError as a run would."""
    try:
        whole, guessed = _plan(config, shelf, ask=False)
    except Unknown:
        whole, guessed = _plan(config, shelf, ask=True)
    verify, waiting, seconds = config["verify"], 0, 0.0
    for step in whole.steps:
        if not (reason := damage(step, verify)):
            yield f"{step.name:>16} | {'taken as it is' if step.taken else 'filed'}   {step.stage}/{step.fingerprint}"
            continue
        if step.taken:
            raise spoilt(step, reason)
        waiting += 1
        usual = usual_seconds(shelf, step.stage)
        seconds += usual or 0.0
        begun = ", from where it was stopped" if half_done(step) else ""
        yield f"{step.name:>16} | would run{begun}{f' ({usual:.0f} s in other runs here)' if usual is not None else ''}"
        lines = [f"the stored result is damaged ({reason})"] if os.path.lexists(step.folder) else changes(step)
        yield from (f"{'':>16} |   {line}" for line in lines[:SHOWN])
        if len(lines) > SHOWN:
            yield f"{'':>16} |   and {len(lines) - SHOWN} more differences"
    for name, why in whole.left_out.items():
        yield f"{name:>16} | left out: {why}"
    if guessed:
        yield f"{'':>16} | {guessed}"
    if waiting and len(whole.steps) > 1:
        known = f"; those that have run here before took {seconds:.0f} s" if seconds else ""
        yield f"{waiting} of {len(whole.steps)} steps would run{known}"
    elif not waiting:
        yield f"up to date: all {len(whole.steps)} steps were computed before"


def _plan(config: dict[str, Any], shelf: Path, ask: bool) -> tuple[Plan, str]:
    """The plan of a run, and what is not certain about it."""
    capture = first(config, shelf, ask)
    if not damage(capture, config["verify"]):
        return plan(config, capture, ask), ""
    if (near := _nearest(capture)) and not damage(near):
        guess = f"if the capture is again such as in {near.stage}/{near.fingerprint}"
        return plan(config, capture, ask, peek(near.folder)), guess
    return Plan([capture]), "what comes after capture depends on what it finds"


def changes(step: Step) -> list[str]:
    """What differs between what this step would be made of and the nearest result on the shelf."""
    near = _nearest(step)
    if near:
        return differences(near.made_of, step.made_of, [_named(source) for source in step.inputs])
    if any((step.shelf / step.stage).glob("[!.]*")):
        return ["the results that are filed are of other things, or do not say what they were made of"]
    return ["nothing of this stage is filed here"]


def _nearest(step: Step) -> Step | None:
    """The result of this stage and these classes with the fewest differences; None if there is none."""
    found = []
    for path in (step.shelf / step.stage).glob(f"[!.]*/{MANIFEST}"):
        try:
            told = read_manifest(path.parent)
        except (OSError, ValueError):
            continue
        parts: Any = told.get("made_of")
        match parts:
            case {"config": dict(), "code": dict(), "libraries": dict(), "inputs": list(), "data": dict()}:
                if _classes(parts) == _classes(step.made_of):
                    filed = Step(step.name, step.stage, {}, (), step.shelf, path.parent.name, parts)
                    count = len(differences(parts, step.made_of, [_named(source) for source in step.inputs]))
                    found.append((-count, str(told.get("finished")), filed))
    return max(found, key=lambda entry: entry[:2])[2] if found else None


def _classes(parts: dict[str, Any]) -> dict[str, Any]:
    """What a result is of: the stage, and where its scene comes from."""
    return {k: v for k, v in flatten(parts["config"]).items() if k in ("_target_", "source._target_", "source.name")}


def differences(old: dict[str, Any], new: dict[str, Any], inputs: list[Any]) -> list[str]:
    """One line for each entry in which two results are made of different things; `inputs` are the names of the inputs,
    or mappings to names, as `new["inputs"]` has them."""
    lines = []
    for name, then, now in zip(inputs, old["inputs"], new["inputs"], strict=False):
        pairs = [(name, then, now)]
        if isinstance(name, dict) and isinstance(then, dict):
            pairs = [(name[key], then.get(key), now[key]) for key in now]
        lines += [f"input          {one} is another one" for one, was, is_now in pairs if was != is_now]
    for kind in KINDS:
        then, now = flatten(old[kind]), flatten(new[kind])
        for key in sorted(then.keys() | now.keys()):
            if then.get(key, _NOTHING) != now.get(key, _NOTHING):
                lines.append(_LINES[kind](key, then.get(key, _NOTHING), now.get(key, _NOTHING)))
    return lines


_NOTHING = object()  # stands for an entry that is not there, which null is not


def _changed(then: Any, now: Any) -> str:
    return "is new" if then is _NOTHING else "is gone" if now is _NOTHING else "has changed"


def _value(value: Any) -> str:
    return "nothing" if value is _NOTHING else json.dumps(value, default=str)


_LINES = {
    "config": lambda key, then, now: f"configuration  {key}: {_value(then)} -> {_value(now)}",
    "code": lambda key, then, now: f"code           {key} {_changed(then, now)}",
    "data": lambda key, then, now: f"data           {key} {_changed(then, now)}",
    "libraries": lambda key, then, now: f"version        {key}: {_value(then)} -> {_value(now)}",
}


def _named(source: Any) -> Any:
    if source is None:
        return "what was there"
    if isinstance(source, dict):
        return {key: step.name for key, step in source.items()}
    return source.step.name if hasattr(source, "step") else source.name


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
