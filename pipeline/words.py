"""Words of the command line that are not Hydra's: paths, taken as they stand, and what `make` was given as ARGS.

Hydra reads a value as an expression, in which spaces, parentheses, commas, quotes and $ have a meaning. A path may hold
any of them, so the values of `data`, `output` and every entry called path are quoted before Hydra sees them. So are
fingerprints, which may look like numbers.

    python -m pipeline.words <options of Python ...>     runs Python with these and the words of ARGS, through no shell
"""

import os
import re
import shlex
import sys

from pipeline.settings import SettingsError


def literal_paths(words: list[str]) -> list[str]:
    """The words, with the values that are paths quoted for Hydra. Raises SettingsError for a line break in a path."""
    return [_literal(word) for word in words]


def _literal(word: str) -> str:
    key, equals, value = word.partition("=")
    if not equals or not _is_path(key, value):
        return word
    from hydra.core.override_parser.types import Quote, QuotedString

    if set(value) & set("\n\r"):
        raise SettingsError(f"{key}={value!r}: a path with a line break is not supported; rename the file or folder")
    # in what OmegaConf reads, a $ that is followed by a brace begins another entry's name, unless it is escaped
    text = re.sub(r"(\\*)\$\{", r"\1\1\\${", os.path.expanduser(value))
    return f"{key}={QuotedString(text=text, quote=Quote.double).with_quotes()}"


def _is_path(key: str, value: str) -> bool:
    if key in ("data", "output"):
        return True
    named = key.lstrip("+").split(".")[-1].split("_")[-1] == "path" or key.startswith("use.")
    return named and value != "null" and not value.startswith("${")  # nothing, or what another entry says


def main(options: list[str]) -> None:
    try:
        words = shlex.split(os.environ.get("ARGS", ""))
    except ValueError as error:
        sys.exit(f"error: ARGS={os.environ['ARGS']}: {str(error).lower()}; close it, or put a backslash before it")
    os.execv(sys.executable, [sys.executable, *options, *words])


if __name__ == "__main__":
    main(sys.argv[1:])
