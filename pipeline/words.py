"""Words of the command line that are not Hydra's: paths, taken as they stand, and what `make` was given as ARGS.

Hydra reads a value as an expression, in which spaces, parentheses, commas, quotes and $ have a meaning. A path may hold
any of them, and so may the name of a photograph, a pattern of names or a sentence: the values of `data`, `output` and
of the entries below are quoted before Hydra sees them. So are fingerprints, which may look like numbers.

    python -m pipeline.words <options of Python ...>     runs Python with these and the words of ARGS, through no shell
"""

import os
import re
import shlex
import sys

from pipeline.settings import SettingsError

FOLDERS = ("data", "output")
FILES = ("path", "clip", "weights")  # last words of entries that name a file or a folder
TEXTS = ("images", "only", "pattern", "prompt")  # ... that hold any text
PATH, VIEW, TEXT = "path", "view", "text"  # a view is the name of a photograph, or its number
NO_NAME = re.compile(r"[-+.\d]*|(?i:nan|[-+]?inf|true|false)|[\[{].*")


def literal_paths(words: list[str]) -> list[str]:
    """The words, with the values that are paths or texts quoted for Hydra. Raises SettingsError for a line break in
    one."""
    return [_literal(word) for word in words]


def _literal(word: str) -> str:
    key, equals, value = word.partition("=")
    kind = _kind(key)
    # nothing, or what another entry says; of a photograph its number, or what can be no name
    is_plain = value == "null" or value.startswith("${") or (kind == VIEW and NO_NAME.fullmatch(value))
    if not equals or not kind or (is_plain and key not in FOLDERS):
        return word
    from hydra.core.override_parser.types import Quote, QuotedString

    if set(value) & set("\n\r"):
        raise SettingsError(f"{key}={value!r}: a line break is not supported; do without it, or rename what it names")
    # in what OmegaConf reads, a $ that is followed by a brace begins another entry's name, unless it is escaped
    text = re.sub(r"(\\*)\$\{", r"\1\1\\${", os.path.expanduser(value) if kind == PATH else value)
    return f"{key}={QuotedString(text=text, quote=Quote.double).with_quotes()}"


def _kind(key: str) -> str:
    """What an entry holds that is to be taken as it stands; empty for any other."""
    last = key.lstrip("+").split(".")[-1]
    if key in FOLDERS or last in FILES or last.endswith("_path"):
        return PATH
    return VIEW if last == VIEW else TEXT if last in TEXTS or key.startswith("use.") else ""


def main(options: list[str]) -> None:
    try:
        words = shlex.split(os.environ.get("ARGS", ""))
    except ValueError as error:
        sys.exit(f"error: ARGS={os.environ['ARGS']}: {str(error).lower()}; close it, or put a backslash before it")
    os.execv(sys.executable, [sys.executable, *options, *words])


if __name__ == "__main__":
    main(sys.argv[1:])
