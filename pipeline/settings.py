"""Words of the command line -> one plain configuration, by Hydra; every mistake is one line that names the remedy."""

import re
from functools import cache
from pathlib import Path
from typing import Any, cast

from physics3d.handbook import fill_in, read
from pipeline.fields import Unknown, declared
from pipeline.fingerprint import ROOT
from pipeline.page import nearest, problem, set_by

INSTALLED = Path(__file__).resolve().parent / "conf"
CONF = INSTALLED if INSTALLED.is_dir() else ROOT / "conf"  # beside the packages in a checkout, inside of one in a wheel
GROUPS = ("scene", "material", "prior", "estimator", "masker", "densification", "solid", "method", "profile")


class SettingsError(ValueError):
    """The command line asks for something that does not exist."""


def choices(group: str) -> list[str]:
    """Names of the files of a configuration group."""
    return sorted(p.stem for p in (CONF / group).glob("*.yaml"))


def compose(words: list[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Overrides such as scene=carnation learn.steps=50 -> (configuration, group -> choice). Raises SettingsError."""
    composed, written, picked = before_checks(words)
    wrong = problem(composed, written)
    if wrong:
        raise SettingsError(wrong)
    return composed, picked


def before_checks(words: list[str]) -> tuple[dict[str, Any], dict[str, Any], dict[str, str]]:
    """Overrides -> (configuration, the same before interpolation, group -> choice), whatever its values are.

    Raises SettingsError where there is no such entry or choice.
    """
    from hydra import compose
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    for word in words:
        _check_word(word)
    groups = [w for w in words if w.split("=")[0] in GROUPS]
    if len(groups) < len(words):  # what the other words may name depends on what the groups bring
        words = [w if w in groups else _known_or_new(w, _known(tuple(groups))) for w in words]
    with _hydra():
        try:
            config = compose("config", words, return_hydra_config=True)
            picked = {g: config.hydra.runtime.choices[g] for g in GROUPS if g in config.hydra.runtime.choices}
            OmegaConf.set_struct(config, False)
            del config["hydra"]
            _of_the_material(config, picked, words)
            _by_the_handbook(config, picked)
            written = cast(dict[str, Any], OmegaConf.to_container(config, resolve=False))
            return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True)), written, picked
        except (HydraException, OmegaConfBaseException) as error:
            raise SettingsError(_told(str(error))) from error


def _told(error: str) -> str:
    """One line of what Hydra says, with the remedy where it has none."""
    if gone := re.search(r"(?:Interpolation key '|Error trying to access )([\w.]+)", error):
        return f"{gone[1]} is not there, but others are taken from it; keep it"
    if odd := re.search(r"(?:Error merging override |Could not override ')([\w.]+)", error):
        key = odd[1]
        return (
            f"{key} cannot become that; set what is in it by {key}.<name>=<value>, what is new by +{key}.<name>=<value>"
        )
    return error.strip().splitlines()[0]


@cache  # runs of a sweep differ in seeds and numbers more often than in groups
def _known(groups: tuple[str, ...]) -> dict[str, Any]:
    """What the groups bring, before interpolation; to be read only."""
    from hydra import compose
    from omegaconf import OmegaConf

    with _hydra():
        return cast(dict[str, Any], OmegaConf.to_container(compose("config", list(groups)), resolve=False))


def _hydra() -> Any:
    """Hydra, begun anew in the folder of configurations, as a context."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    GlobalHydra.instance().clear()
    return initialize_config_dir(str(CONF), version_base="1.3")


def _of_the_material(config: Any, picked: dict[str, str], words: list[str]) -> None:
    """Leave out where a scene lets parameters start that the material chosen for it has not, but others have: those of
    a branch, say, under METHOD=without_viscoelastic. What is on the command line stays, and is refused."""
    from omegaconf import OmegaConf

    if not OmegaConf.is_dict(OmegaConf.select(config, "material.start")):
        return  # and is refused
    starts = lambda kind: set(OmegaConf.load(CONF / "material" / f"{kind}.yaml").start)
    others = set(config.material.start) - starts(picked["material"])
    said = {word.partition("=")[0] for word in words}
    if not others:
        return  # as a rule: the files of all the other materials need not be read
    for name in others & set().union(*map(starts, choices("material"))):
        if f"material.start.{name}" not in said:
            del config.material.start[name]


def _by_the_handbook(config: Any, picked: dict[str, str]) -> None:
    """What `scene.thing` says, put into a composed configuration. Raises SettingsError."""
    from omegaconf import OmegaConf

    if OmegaConf.select(config, "scene.thing") is None:
        return
    usual = OmegaConf.load(CONF / "material" / f"{picked['material']}.yaml")
    if not OmegaConf.is_dict(OmegaConf.select(config, "material.start")):
        return  # and is refused
    there = [key for key in ("scene", "learn") if OmegaConf.is_dict(config.get(key))]
    nodes = {key: OmegaConf.to_container(config[key], resolve=False) for key in there}
    plain: dict[str, Any] = {"learn": None, **nodes, "material": {"start": dict(config.material.start)}}
    try:
        fill_in(plain, dict(usual.start), read(CONF / "handbook.yaml"))
    except ValueError as error:
        raise SettingsError(str(error)) from error
    config.material.start = plain["material"]["start"]
    config.scene.density = plain["scene"]["density"]
    if plain["learn"]:
        config.learn.guess_widths = plain["learn"]["guess_widths"]
        config.learn.beyond.density = plain["learn"]["beyond"]["density"]


def _check_word(word: str) -> None:
    key, equals, value = word.partition("=")
    if not equals and not key.startswith("~"):
        raise SettingsError(f"{word!r} is not of the form key=value, e.g. scene=carnation or learn.steps=50")
    if key.lstrip("+~").partition(".")[0] == "hydra":
        raise SettingsError(f"{word!r}: settings of Hydra change nothing here; leave it out")
    if key in GROUPS and value not in choices(key):
        raise SettingsError(f"no {key} {value!r}; there are {', '.join(choices(key))}")


def _known_or_new(word: str, known: dict[str, Any]) -> str:
    """The word; with + in front if its key is a field of the class there that no file mentions; or as Hydra wants it
    where a name has a dot (material.start.stem.youngs_modulus).

    Raises SettingsError if there is no such key, or the word cannot be read.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        read = OverridesParser.create().parse_override(word)
    except HydraException as error:
        raise SettingsError(f"cannot read {word!r}: {str(error).splitlines()[0]}") from error
    key, _, value = word.partition("=")
    if read.is_sweep_override():
        raise SettingsError(f"{word}: one value is needed; a list is {key}=[...], many runs are made by make sweep")
    if key.startswith("+"):
        return word
    node: Any = known
    done: list[str] = []
    parts = key.removeprefix("~").split(".")
    for i, part in enumerate(parts):
        names = (
            list(node)
            if isinstance(node, dict)
            else [str(i) for i in range(len(node))]
            if isinstance(node, list)
            else []
        )
        if part not in names:
            rest = ".".join(parts[i:])
            if rest in names and not key.startswith("~"):
                return f"{'.'.join(done)}={{{rest}: {value}}}"
            fields = _fields(node)
            if part in fields and i == len(parts) - 1 and not key.startswith("~"):
                return f"+{word}"
            where = f" in {'.'.join(done)}" if done else ""
            own = set_by(".".join([*done, part]), known)
            if node is None:
                raise SettingsError(f"{'.'.join(done)} is null here; give all of it, {'.'.join(done)}=<value>")
            if own != ".".join([*done, part]):
                raise SettingsError(f"{key} is taken from {own}; set {'.'.join([own, *parts[i + 1 :]])}")
            raise SettingsError(f"no {part!r}{where}; {nearest(part, sorted({*names, *fields} - {'_target_'}), done)}")
        node = node[part] if isinstance(node, dict) else node[int(part)]
        done.append(part)
    return word


def _fields(node: Any) -> list[str]:
    """Fields of the class that a mapping names."""
    try:
        return list(declared(node["_target_"]).hints) if isinstance(node, dict) and "_target_" in node else []
    except Unknown:
        return []


def described(path: Path) -> str:
    """The comment at the top of a configuration file, its first line."""
    for line in path.read_text().splitlines():
        if line.startswith("# ") and "@package" not in line:
            return line[2:]
    return ""
