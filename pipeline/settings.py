"""Words of the command line -> one plain configuration, by Hydra; every mistake is one line that names the remedy."""

import difflib
import re
from pathlib import Path
from typing import Any, cast

from pipeline.fingerprint import ROOT

CONF = ROOT / "conf"
GROUPS = ("scene", "material", "prior", "method", "profile")


class SettingsError(ValueError):
    """The command line asks for something that does not exist."""


def choices(group: str) -> list[str]:
    """Names of the files of a configuration group."""
    return sorted(p.stem for p in (CONF / group).glob("*.yaml"))


def compose(words: list[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Overrides such as scene=carnation learn.steps=50 -> (configuration, group -> choice). Raises SettingsError."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    for word in words:
        _check_word(word)
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        groups = [w for w in words if w.split("=")[0] in GROUPS]
        base = compose("config", groups)
        known = cast(dict[str, Any], OmegaConf.to_container(base, resolve=False))
        values = [w for w in words if w not in groups]
        for word in values:
            _check_value(word, known)
        try:
            config = compose("config", words, return_hydra_config=True)
            picked = {g: config.hydra.runtime.choices[g] for g in GROUPS if g in config.hydra.runtime.choices}
            OmegaConf.set_struct(config, False)
            del config["hydra"]
            return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True)), picked
        except (HydraException, OmegaConfBaseException) as error:
            raise SettingsError(str(error).strip().splitlines()[0]) from error


def _check_word(word: str) -> None:
    key, equals, value = word.partition("=")
    if not equals and not key.startswith("~"):
        raise SettingsError(f"{word!r} is not of the form key=value, e.g. scene=carnation or learn.steps=50")
    if key in GROUPS and value not in choices(key):
        raise SettingsError(f"no {key} {value!r}; there are {', '.join(choices(key))}")


def _check_value(word: str, known: dict[str, Any]) -> None:
    """Is there such a key, and does the value have the kind of the one it replaces?"""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    key, _, _ = word.partition("=")
    if key.startswith(("+", "~")):
        return
    node: Any = known
    done: list[str] = []
    for part in re.split(r"\.", key):
        names = (
            list(node)
            if isinstance(node, dict)
            else [str(i) for i in range(len(node))]
            if isinstance(node, list)
            else []
        )
        if part not in names:
            where = f" in {'.'.join(done)}" if done else ""
            close = difflib.get_close_matches(part, names, 1)
            hint = (
                f"did you mean {'.'.join([*done, close[0]])}?" if close else f"there are {', '.join(names) or 'none'}"
            )
            raise SettingsError(f"no {part!r}{where}; {hint}")
        node = node[part] if isinstance(node, dict) else node[int(part)]
        done.append(part)
    try:
        value = OverridesParser.create().parse_override(word).value()
    except HydraException as error:
        raise SettingsError(f"cannot read {word!r}: {str(error).splitlines()[0]}") from error
    number = isinstance(node, int | float) and not isinstance(node, bool)
    if number and (isinstance(value, bool) or not isinstance(value, int | float | None)) and "${" not in word:
        raise SettingsError(f"{key} must be a number such as {node}, not {value}")
    if isinstance(node, bool) and not isinstance(value, bool | None):
        raise SettingsError(f"{key} must be true or false, not {value}")


def described(path: Path) -> str:
    """The comment at the top of a configuration file, its first line."""
    for line in path.read_text().splitlines():
        if line.startswith("# ") and "@package" not in line:
            return line[2:]
    return ""
