"""Write docs/configuration.md: every entry of conf/, what it may be, its unit, and what it is.

make configuration

Nothing heavy is imported. What an entry may be is the hint of the field that takes it, in the words of the messages
that refuse it (`physics3d/checks.py`). What it is, is the comment behind it; where there is none, that of the same
entry in conf/config.yaml, of the field in the source of its class, of what takes it over (`world.dx: ${scene.dx}`), or,
of names that mean the same everywhere, a line of `COMMON` below. An entry that nobody explains is an error.
"""

import ast
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from physics3d.checks import describe
from pipeline.fields import Declared, classes, declared
from pipeline.fingerprint import ROOT, _file
from pipeline.page import PLAIN, STAGES, parameter_ranges
from pipeline.settings import GROUPS, described

Key = tuple[str, ...]
COMMON = {
    "name": "what the scene is called, in results and on pages",
    "path": "the file or folder that is read",
    "seed": "of everything that is drawn at random",
    "device": "where it is computed; auto: on a GPU if there is one",
    "width": "of a picture [px]",
    "height": "of a picture [px]",
    "fps": "frames in a second [1/s]",
    "frames": "of the motion",
    "density": "mass over volume at rest [kg/m^3]",
    "hole_upper": "the opposite corner of that [m]",
    "lower": "the corner of the box with the smallest coordinates [m]",
    "upper": "the opposite corner [m]",
    "start": "when it begins",
    "duration": "for how long",
    "velocity": "of the motion [m/s]",
    "point": "a point on it [m]",
    "axis": "the direction of the axis",
    "kind": "sticky: nothing moves on it; slip: only along it; separate: what moves away from it may",
    "interval": "between one layer and the next",
    "layers": "how many slices",
    "box": "left, top, right, bottom of a box in the picture, as fractions of its width and height",
    "views": "how many photographs are made",
    "points": "how many surface points are handed on, as structure from motion would",
    "held_out_every": "every so many photographs are kept for evaluation; 0: none",
    "solid": "the model that the branches are put beside, with its fields",
    "materials": "part -> the model of that part, with its fields",
    "branches": "how many Maxwell branches act beside the elastic one",
    "elastic": "whether there is an elastic branch, which holds the shape",
    "spring": "what is stretched in a branch; the stress of neo_hookean does not fall in large shear",
    "flow": "what the dash-pot of a branch follows",
}
LIMITS = (
    r" and <= 1000000000\b| and < 1e\+18| between -1e\+18 and 1e\+18| < 1e\+18"  # of every number: said once, above
)
NEEDED = "needed"  # in the place of a default
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same, ten times as fast where libyaml is there
PARTS = tuple(group for group in GROUPS if group not in ("scene", "material", "method", "profile"))
TITLES = ("entry", "default", "unit", "may be", "what it is")
TOP = """# Configuration: every entry

Made by `make configuration` from `conf/` and from the hints of the classes that it names; do not edit it by hand.

    make run SCENE=carnation ARGS="learn.steps=50 masker=sam2"     # entries and choices on the command line
    .venv/bin/python -m pipeline scene=carnation --config          # everything as composed, without running
    .venv/bin/python -m pipeline --help                            # the choices, one line each

- **Order.** `conf/config.yaml` comes first; then the chosen material, prior, masker and so on, the scene, the profile
  and the method, each on top of what is before it; the command line is last. `SCENE=`, `PROFILE=` and `METHOD=` of make
  are `scene=`, `profile=` and `method=`.
- **Keys** are written with dots: `learn.steps=50`; an element of a list by its number: `scene.prompts.0.view=12`. There
  are no blanks in a list: `scene.gravity=[0,0,-9.81]`. Any field of a class that is named by `_target_` can be set,
  whether a file shows it or not.
- **Values.** Numbers are finite and below 1e18, counts below 1e9, in SI units unless another stands in the table.
  `null` means that nothing is given, `.inf` a time without end. What cannot be is refused in a second, in one line that
  names entry, value and remedy.
- **Taken over.** `${scene.dx}` is the value of the entry of that name, which is the one to set.
"""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of a configuration file."""

    key: Key
    value: str  # as it is written
    comment: str


class NoWords(ValueError):
    """Entries that nobody explains."""


# ---- reading


def entries(path: Path) -> Iterator[Entry]:
    """What a file says, in its order: scalars, lists of scalars, mappings on one line that are no class's, and of a
    mapping of names to objects (shapes, materials of parts) the names."""
    text = path.read_text()
    comments = _comments(text)

    def walk(node: yaml.Node, key: Key) -> Iterator[Entry]:
        for name, value in node.value:
            inner = (*key, name.value)
            if name.value in ("_target_", "defaults"):
                continue
            comment = comments.get(name.start_mark.line, "")
            items = value.value if isinstance(value, yaml.SequenceNode) else []
            if any(isinstance(item, yaml.MappingNode) for item in items):
                if comment:
                    yield Entry(key=inner, value="", comment=comment)
                for i, item in enumerate(items):
                    yield from walk(item, (*inner, str(i)))
            elif isinstance(value, yaml.MappingNode) and _named_classes(value):
                names = ", ".join(part.value for part, _ in value.value)
                yield Entry(key=inner, value=names, comment=comment)
            elif isinstance(value, yaml.MappingNode) and not (value.flow_style and _target(value) is None):
                if comment:
                    yield Entry(key=inner, value="", comment=comment)
                yield from walk(value, inner)
            else:
                written = text[value.start_mark.index : value.end_mark.index]
                yield Entry(key=inner, value=" ".join(written.split()), comment=comment)

    node = yaml.compose(text, Loader=LOADER)
    if isinstance(node, yaml.MappingNode):
        yield from walk(node, ())


def _named_classes(node: yaml.MappingNode) -> bool:
    """Whether it is names, each with an object of a class (shapes, materials of parts), and nothing else."""
    of_a_class = [isinstance(value, yaml.MappingNode) and _target(value) is not None for _, value in node.value]
    return bool(of_a_class) and all(of_a_class)


def _comments(text: str) -> dict[int, str]:
    """Line -> what stands behind its last token, after the #."""
    ends: dict[int, int] = {}
    for token in yaml.scan(text, Loader=LOADER):
        ends[token.end_mark.line] = max(token.end_mark.column, ends.get(token.end_mark.line, 0))
    rest = ((n, line[ends.get(n, len(line)) :].strip()) for n, line in enumerate(text.splitlines()))
    return {n: comment[1:].strip() for n, comment in rest if comment.startswith("#")}


def _target(node: yaml.Node) -> str | None:
    return next((value.value for name, value in node.value if name.value == "_target_"), None)


@cache
def kinds(path: Path) -> dict[Key, str]:
    """Key -> the class that its mapping names; of what the file builds upon, too."""
    plain = yaml.load(path.read_text(), Loader=LOADER) or {}
    found = {}
    for below in plain.get("defaults", []):
        if isinstance(below, str) and below != "_self_":
            found |= kinds(path.with_name(f"{below}.yaml"))

    def walk(tree: Any, key: Key) -> None:
        if isinstance(tree, dict):
            if "_target_" in tree:
                found[key] = tree["_target_"]
            for name, value in tree.items():
                walk(value, (*key, name))
        elif isinstance(tree, list):
            for i, value in enumerate(tree):
                walk(value, (*key, str(i)))

    walk(plain, ())
    return found


@cache
def remarks(module: str) -> dict[str, str]:
    """`Class.field`, or the name of a material's parameter -> the comment behind it, or on the line before it."""
    lines = _file(module, ROOT).read_text().splitlines()
    found = {}

    def note(node: ast.AST) -> str:
        behind = lines[node.end_lineno - 1].encode()[node.end_col_offset :].decode().lstrip(" ,")
        before = lines[node.lineno - 2].strip()
        return next((text[1:].strip() for text in (behind, before) if text.startswith("#")), "")

    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.ClassDef):
            for line in node.body:
                if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                    found[f"{node.name}.{line.target.id}"] = note(line)
        elif isinstance(node, ast.Dict):
            for name, value in zip(node.keys, node.values, strict=True):
                if isinstance(name, ast.Constant) and isinstance(name.value, str):
                    found.setdefault(name.value, note(value))
    return found


def remark(kind: str, field: str) -> str:
    """The comment of a field of a class or of what it inherits."""
    for path in (kind, *sorted(declared(kind).ancestors)):
        module, _, name = path.rpartition(".")
        if text := remarks(module).get(f"{name}.{field}"):
            return text
    return ""


def usual(field: str) -> str:
    """What a name means wherever it stands: one of `COMMON`, or a parameter of the usual materials."""
    known = [remarks(f"physics3d.materials.{module}").get(field, "") for module in ("parameters", "viscoelastic")]
    return COMMON.get(field) or next(filter(None, known), "")


def parameter(model: dict[str, Any], name: str) -> str:
    """The comment of a parameter of a material."""
    part, _, bare = re.sub(r"_[23]$", "", name).rpartition(".")
    if part:
        return parameter(model["materials"][part], bare)
    inside = [model["solid"]["_target_"]] if "solid" in model else []
    modules = [path.rpartition(".")[0] for path in (model["_target_"], *inside)]
    return next((text for module in modules if (text := remarks(module).get(bare))), "") or usual(bare)


# ---- words


def split(comment: str, default: str = "") -> tuple[str, str]:
    """A comment -> (words, unit): the unit stands in brackets in it; what begins with | goes on from the default."""
    unit = re.search(r"\s*\[([^\[\],]{1,24})\]", comment)
    words = comment.replace(unit[0], "", 1) if unit else comment
    if words.startswith("|"):
        words = f"{default} {words}"
    return words.replace(" | ", ", or ").strip(" ;"), unit[1] if unit else ""


def allowed(hint: Any) -> tuple[str, str]:
    """(what a value may be, its unit) by a hint."""
    if hint is Any:
        return "", ""
    if isinstance(hint, dict):  # entries of no class: one hint for each
        each = {name: allowed(of)[0] for name, of in hint.items()}
        if len(set(each.values())) == 1:
            return f"each {next(iter(each.values()))}", ""
        return "; ".join(f"{name}: {text}" for name, text in each.items()), ""
    text = re.sub(LIMITS, "", describe(hint))
    text = re.sub(r"the _target_ of a (\w+) with its fields", r"a class of the kind `\1`", text)
    unit = re.search(r" \[([^\]]+)\]", text)
    return re.sub(r" \[[^\]]+\]", "", text), unit[1] if unit else ""


def cell(text: str) -> str:
    """Text in a table of Markdown: no column of its own, and no HTML."""
    return re.sub(r"<(?=\w)", "&lt;", text.replace("|", "\\|"))


def code(text: str) -> str:
    return f"`{text}`" if text else ""


class Page:
    """The page of a folder of configurations; `unexplained` gathers what has no words."""

    def __init__(self, conf: Path):
        self.conf, self.unexplained = conf, []
        self.main = conf / "config.yaml"
        self.plain = {entry.key: entry for entry in entries(self.main)}
        self.takers: dict[str, Key] = {}  # `scene.dx` -> the entry of the page that takes it over
        for key, entry in self.plain.items():
            if link := re.fullmatch(r"\$\{([\w.]+)\}", entry.value):
                self.takers.setdefault(link[1], key)

    def of_a_part(self, key: Key) -> tuple[str, Any]:
        """(comment, hint) of `prior.blur` and the like, by the first choice that has such an entry."""
        for path in self.files(key[0]) if key[0] in PARTS else []:
            for entry in entries(path):
                if entry.key == key[1:]:
                    return entry.comment, self.hint(entry.key, kinds(path))
        return "", Any

    def hint(self, key: Key, known: dict[Key, str]) -> Any:
        """What an entry may be; `known`: the classes of its file and of config.yaml."""
        if kind := known.get(key[:-1]):
            return declared(kind).hints.get(key[-1], Any)
        if key and key[0] in PARTS:
            return self.of_a_part(key)[1]
        if taker := self.takers.get(".".join(key)):
            return self.hint(taker, kinds(self.main))
        node: Any = PLAIN
        for name in key:
            node = node.get(name, Any) if isinstance(node, dict) else Any
        return node

    def explained(self, entry: Entry, known: dict[Key, str]) -> tuple[str, str]:
        """(words, unit) of the first comment that has them."""
        kind = known.get(entry.key[:-1])
        above = self.plain.get(entry.key)
        taker = self.plain.get(self.takers.get(".".join(entry.key), ()))
        link = re.fullmatch(r"\$\{([\w.]+)\}", entry.value)
        comments = (
            entry.comment,
            above.comment if above else "",
            remark(kind, entry.key[-1]) if kind else "",
            taker.comment if taker else "",
            self.of_a_part(entry.key)[0],
            usual(entry.key[-1]),
            f"that of `{link[1]}`" if link else "",
        )
        found = [split(comment, entry.value) for comment in comments]
        return next((words for words, _ in found if words), ""), next((unit for _, unit in found if unit), "")

    def row(self, name: str, value: str, words: str, unit: str, hint: Any, where: str) -> str:
        may, of_hint = allowed(hint)
        if not words:
            self.unexplained.append(f"{where}: {name}")
        value = value if value == NEEDED else code(value)
        return f"| `{name}` | {cell(value)} | {unit or of_hint} | {cell(may)} | {cell(words)} |"

    def table(self, path: Path, among: Iterator[Entry] | list[Entry], cut: int = 0) -> list[str]:
        """Entries of a file; the first `cut` names of each key are left out."""
        known = kinds(self.main) | kinds(path)
        where = str(path.relative_to(self.conf))
        lines = [f"| {' | '.join(TITLES)} |", "|" + "---|" * len(TITLES)]
        for entry in among:
            words, unit = self.explained(entry, known)
            name, hint = ".".join(entry.key[cut:]), self.hint(entry.key, known)
            lines.append(self.row(name, entry.value, words, unit, hint, where))
        return [*lines, ""]

    def experiment(self) -> Iterator[str]:
        """conf/config.yaml."""
        yield "## The whole experiment: `conf/config.yaml`\n"
        general = [entry for entry in self.plain.values() if len(entry.key) == 1 and entry.value]
        yield "### General\n"
        yield from self.table(self.main, general)
        for top in ("scene", "world", *STAGES):
            inside = [entry for entry in self.plain.values() if entry.key[0] == top and len(entry.key) > 1]
            yield f"### `{top}`\n"
            if own := self.plain.get((top,)):
                yield f"{own.comment[0].upper()}{own.comment[1:]}.\n"
            if kind := kinds(self.main).get((top,)):
                yield f"{link(kind)}: {summary(kind)}\n"
            if top == "scene":
                yield "A scene gives these:\n"
                inside = [Entry(key=("scene", n), value="", comment="") for n in sorted(self.of_a_scene())] + inside
            yield from self.table(self.main, inside, 1)

    def of_a_scene(self) -> set[str]:
        return {name.partition(".")[2] for name in self.takers if name.count(".") == 1 and name.startswith("scene.")}

    def choices(self) -> Iterator[str]:
        yield "## Choices\n"
        for group in GROUPS:
            yield f"### `{group}=`\n"
            yield "| choice | what it is |\n|---|---|"
            for path in self.files(group):
                yield f"| [`{path.stem}`](../conf/{group}/{path.name}) | {cell(described(path))} |"
            yield ""
        for group in PARTS:
            for path in self.files(group):
                found = list(entries(path))
                yield f"### `{group}={path.stem}`\n\n{link(kinds(path)[()])}. Set them as `{group}.<entry>`.\n"
                yield from self.table(path, found) if found else ["It has no entries.\n"]

    def files(self, group: str) -> list[Path]:
        return sorted((self.conf / group).glob("*.yaml"))

    def materials(self) -> Iterator[str]:
        yield "## Materials\n\nSet them as `material.start.<parameter>`. What they mean: [materials](materials.md).\n"
        for path in self.files("material"):
            plain = yaml.load(path.read_text(), Loader=LOADER)
            model = plain["model"]
            yield f"### `material={path.stem}`\n\n{described(path)[:1].upper()}{described(path)[1:]}.\n"
            yield (
                f"{link(model['_target_'])}; learned: {', '.join(map(code, plain['learn'])) or 'nothing'}"
                + (
                    "; one factor for each of: " + ", ".join(" and ".join(map(code, tie)) for tie in plain["ties"])
                    if plain["ties"]
                    else ""
                )
                + ".\n"
            )
            found = [e for e in entries(path) if e.key[0] in ("model", "start") and len(e.key) > 1]
            fields = [e for e in found if e.key[0] == "model"]
            if fields:
                yield from self.table(path, fields)
            ranges, where = parameter_ranges(model), str(path.relative_to(self.conf))
            yield f"| parameter | {' | '.join(TITLES[1:])} |\n" + "|" + "---|" * len(TITLES)
            for entry in found:
                if entry.key[0] == "start":
                    name = ".".join(entry.key[1:])
                    meant, own = parameter(model, name), split(entry.comment)
                    words = "; ".join(filter(None, (split(meant)[0], "" if own[0] in meant else own[0])))
                    unit = own[1] or split(meant)[1]
                    yield self.row(name, entry.value, words, unit, ranges[re.sub(r"_[23]$", "", name)], where)
            yield ""

    def scenes(self) -> Iterator[str]:
        yield "## Scenes, profiles and methods\n\nWhat each puts on top of `conf/config.yaml`.\n"
        for group in ("scene", "profile", "method"):
            for path in self.files(group):
                yield f"### `{group}={path.stem}`\n\n{described(path)[:1].upper()}{described(path)[1:]}.\n"
                below = (yaml.load(path.read_text(), Loader=LOADER) or {}).get("defaults", [])
                built = [f"[`{name}`](#{group}{name})" for name in below if isinstance(name, str) and name != "_self_"]
                for over in (item for item in below if isinstance(item, dict)):
                    built += [f"`{name.removeprefix('override /')}={value}`" for name, value in over.items()]
                if built:
                    yield f"Built upon {' and '.join(built)}.\n"
                found = list(entries(path))
                for name, kind in kinds(path).items():
                    if name[-1:] == ("source",):
                        yield f"Its source is {link(kind)}.\n"
                if found:
                    yield from self.table(path, found)

    def parts_of_a_scene(self) -> Iterator[str]:
        """Every class that a scene may name by `_target_`."""
        yield "## What a scene is made of\n\nClasses that a scene names by `_target_`, with all their fields.\n"
        for title, package, base in (
            ("Sources", "physics3d.scenes", "physics3d.scenes.base.AbstractSource"),
            ("Shapes of made scenes", "physics3d.scenes", "physics3d.scenes.shapes.AbstractShape"),
            ("Prompts", "physics3d.segmentation", "physics3d.segmentation.prompts.Prompt"),
            ("Boundaries and excitations", "physics3d.boundaries", "physics3d.boundaries.base.AbstractBoundary"),
            ("Models of materials", "physics3d.materials", "physics3d.materials.base.AbstractMaterial"),
        ):
            yield f"### {title}\n"
            for kind in concrete(package, base):
                yield f"**`{kind}`** {summary(kind)}\n"
                of = declared(kind)
                if of.hints:
                    yield f"| field | {' | '.join(TITLES[1:])} |\n" + "|" + "---|" * len(TITLES)
                    for field, hint in of.hints.items():
                        own, elsewhere = split(remark(kind, field)), split(usual(field))
                        words, unit = (a or b for a, b in zip(own, elsewhere, strict=True))
                        yield self.row(field, written(of, field), words, unit, hint, kind)
                    yield ""


def written(of: Declared, field: str) -> str:
    """The default of a field, as YAML has it; "needed" where there is none."""
    if field not in of.defaults:
        return NEEDED

    def plain(value: Any) -> str:
        if value is None or isinstance(value, bool):
            return {None: "null", True: "true", False: "false"}[value]
        if isinstance(value, tuple):
            return f"[{', '.join(map(plain, value))}]"
        return ".inf" if value == math.inf else str(value)

    return "" if of.defaults[field] is Any else plain(of.defaults[field])


def concrete(package: str, base: str) -> list[str]:
    """Dotted names of the classes of a package that are a `base`, in the order of their modules."""
    folder = ROOT.joinpath(*package.split("."))
    found = []
    for path in sorted(folder.glob("*.py")):
        for name in classes(f"{package}.{path.stem}"):
            kind = f"{package}.{path.stem}.{name}"
            if base in declared(kind).ancestors and not name.startswith("Abstract"):
                found.append(kind)
    return found


def link(kind: str) -> str:
    """A class, with a link to its file."""
    module, _, name = kind.rpartition(".")
    return f"[`{name}`](../{_file(module, ROOT).relative_to(ROOT)})"


def summary(kind: str) -> str:
    """The first sentence of the docstring of a class's module."""
    text = ast.get_docstring(ast.parse(_file(kind.rpartition(".")[0], ROOT).read_text())) or ""
    words = " ".join(text.split("\n\n")[0].split())
    return words if words.endswith(".") else f"{words}."


def page(conf: Path) -> str:
    """The whole page. Raises NoWords naming the entries that nobody explains."""
    made = Page(conf)
    parts = (made.experiment(), made.choices(), made.materials(), made.scenes(), made.parts_of_a_scene())
    lines = [TOP, *(line for part in parts for line in part)]
    if made.unexplained:
        first = ", ".join(made.unexplained[:12])
        raise NoWords(f"{len(made.unexplained)} entries need words: {first}; write a comment behind each")
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).rstrip() + "\n"


if __name__ == "__main__":
    (ROOT / "docs" / "configuration.md").write_text(page(ROOT / "conf"), encoding="utf-8")
