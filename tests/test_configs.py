"""Every configuration in conf/ can be composed, every class named in it takes the values given to it, the page says all
that there is, and what cannot be is refused at once."""

import dataclasses
import math
import re
import tokenize
from collections.abc import Iterator
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from pipeline.fields import declared
from pipeline.fingerprint import ROOT, targets
from pipeline.page import MAY_BE_NULL, STAGES, problem, set_by
from pipeline.settings import CONF, GROUPS, before_checks, choices, compose
from pipeline.stage import build

YAML = "\n".join(path.read_text() for path in sorted(CONF.rglob("*.yaml")))


def paths(tree: Any, path: tuple = ()) -> Iterator[tuple]:
    """Of the leaves of a file, with the class where a leaf names one."""
    if isinstance(tree, dict) and tree:
        for name, value in tree.items():
            yield from paths(value, (*path, name))
    else:
        yield (*path, tree) if path[-1] == "_target_" else path


def met_by_methods() -> list[str]:
    """The scenes, but of those that say something of the same entries that methods change, the first."""
    import yaml

    read = lambda path: yaml.load(path.read_text(), yaml.CSafeLoader)
    changed = {key for method in choices("method") for key in read(CONF / "method" / f"{method}.yaml") or ()}
    alike: dict[Any, str] = {}
    for scene in choices("scene"):
        file = read(CONF / "scene" / f"{scene}.yaml")
        said = {path for key in {*changed, "material"} - {"defaults"} for path in paths(file.get(key, {}), (key,))}
        alike.setdefault((str(file.get("defaults")), "thing" in file["scene"], frozenset(said)), scene)
    return list(alike.values())


CASES = [[]]
CASES += [[f"{group}={name}"] for group in GROUPS for name in choices(group) if name != "parts"]
CASES += [
    [f"method={method}", f"scene={scene}", "profile=smoke"]
    for method in choices("method")
    for scene in met_by_methods()
    # an ablation's one material cannot be that of several parts
    if scene != "carnation_parts" or method in ("physics3d", "physgaussian", "without_filling")
    # and the bird is learned by a modulus that a fluid has not
    if (method, scene) != ("without_elastoplastic", "bird")
]


@pytest.mark.parametrize("words", CASES, ids=" ".join)
def test_configuration_builds_every_stage(words):
    config, picked = compose(words)
    for word in words:
        group, _, name = word.partition("=")
        assert picked[group] == name
    for name in STAGES:
        if config[name] is not None:
            stage = build(config[name], "cpu", name)
            assert callable(stage)
            assert f"{type(stage).__module__}.{type(stage).__name__}" == config[name]["_target_"]
    if config["learn"] is not None:
        start = config["material"]["start"]
        assert set(config["material"]["learn"]) <= set(start), "only a parameter with a start can be learned"
    assert targets(config), "nothing is named"


@pytest.mark.parametrize("method", choices("method"))
def test_a_method_is_kept_whatever_the_profile(method):
    """A profile is put below the method: it must not bring back what the method takes away."""
    plain, _ = compose([f"method={method}"])
    for profile in choices("profile"):
        config, _ = compose([f"method={method}", f"profile={profile}"])
        assert {n for n in STAGES if config[n] is None} == {n for n in STAGES if plain[n] is None}
        assert config["material"]["model"] == plain["material"]["model"]


@pytest.mark.parametrize("scene", ["photos", "llff", "thing", "clip", "carnation_real", "telephone_real"])
def test_a_thing_that_nobody_has_measured_is_pushed_whatever_it_weighs_and_held_where_it_is(scene):
    """Where its floor is and what it weighs nobody knows: no region stands still, and no force is given."""
    config, _ = compose([f"scene={scene}"])
    simulate = build(config["simulate"], "cpu", "simulate")
    assert simulate.world.boundaries == ()
    (push,) = simulate.excitation
    assert push.force is None and max(map(abs, push.acceleration_of_each)) > 1.0
    assert simulate.force is None


def test_every_file_says_what_it_is():
    """The first comment is what --help shows."""
    for path in sorted(CONF.rglob("*.yaml")):
        comments = [line for line in path.read_text().splitlines() if line.startswith("# ") and "@package" not in line]
        assert comments, f"{path.relative_to(CONF)} needs a first line that says what it is"


# ---- the page and the classes


def named(tree: Any, key: str = "") -> Iterator[tuple[str, dict]]:
    """Key and mapping of everything with a `_target_`."""
    if isinstance(tree, dict):
        if "_target_" in tree:
            yield key, tree
        for name, value in tree.items():
            yield from named(value, f"{key}.{name}".lstrip("."))


@pytest.mark.parametrize("choice", ["", *[f"{g}={n}" for g in GROUPS[2:7] for n in choices(g)]])
def test_the_page_shows_every_field_and_the_defaults_it_departs_from(choice):
    """Of the stages, of World and of the classes that the page chooses. What a scene's source, prompts and boundaries
    may be depends on the scene: there a field need not be shown to be set."""
    config, _ = composed((choice,) if choice else ())
    shown = {key: tree for key, tree in named(config) if key.split(".")[0] in (*STAGES, "world", *GROUPS[2:7])}
    assert {*STAGES, "world"} <= set(shown)
    for key, tree in shown.items():
        if re.search(r"source|material", key):
            continue
        module, _, name = tree["_target_"].rpartition(".")
        kind = getattr(__import__(module, fromlist=[name]), name)
        fields = {f.name for f in dataclasses.fields(kind) if f.init}
        assert set(tree) - {"_target_"} == fields, f"{key} on the page and {name} differ"


# where the page is not the class: the page is for ten minutes on two cores, the class for no scene in particular
TUNED = {
    "reconstruct.iterations", "reconstruct.max_gaussians", "learn.steps", "learn.polish", "learn.learning_rate",
    "learn.search", "learn.search_span", "simulate.force", "world.solver",
}  # fmt: skip


def test_defaults_of_the_page_are_those_of_the_class():
    from omegaconf import OmegaConf

    for key, tree in named(OmegaConf.to_container(OmegaConf.load(CONF / "config.yaml"), resolve=False)):
        module, _, name = tree["_target_"].rpartition(".")
        for field in dataclasses.fields(getattr(__import__(module, fromlist=[name]), name)):
            where = f"{key}.{field.name}"
            value = tree[field.name]
            if field.default is not dataclasses.MISSING and where not in TUNED and "${" not in str(value):
                assert (tuple(value) if isinstance(value, list) else value) == field.default, where


@pytest.mark.parametrize("path", sorted(set(re.findall(r"(?:physics3d|stages)\.[\w.]+\.[A-Z]\w+", YAML))))
def test_fields_read_from_the_source_are_those_of_the_class(path):
    """The reader imports nothing; Python's own answer is the truth."""
    from typing import get_args, get_type_hints

    module, _, name = path.rpartition(".")
    kind = getattr(__import__(module, fromlist=[name]), name)
    found, true = declared(path), get_type_hints(kind, include_extras=True)
    fields = [f for f in dataclasses.fields(kind) if f.init]
    assert set(found.hints) == {f.name for f in fields}
    required = {f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING}
    assert set(found.hints) - set(found.defaults) == required
    assert found.rules == getattr(kind, "RULES", ()) and found.ranges == getattr(kind, "RANGES", {})
    for name, hint in found.hints.items():
        # classes of the project have stand-ins, and what only tensors are is left out: their text differs
        if not re.search(r"Abstract|World|Rates|Beyond|Imagined|Sam2|Prompt|Tensor|Any", f"{true[name]} {hint}"):
            assert hint == true[name] and get_args(hint) == get_args(true[name]), name


# ---- what is recommended

MISSPELT = {"learn.stepz"}  # the first hour shows what is said of it


def recommended() -> list[str]:
    """key=value and group=value in README, docs, comments, docstrings and error messages."""
    groups = "|".join((*GROUPS, "device", "seed", "output", "verify"))
    entries = "|".join(
        (*STAGES, "world", "scene", "material", "prior", "estimator", "masker", "densification", "solid", "twin")
    )
    value = r"\[+[\d\w., \[\]-]*\]|[^\s`\"'<{,;)\[]+"
    pattern = rf"(?<![\w.+/])((?:{groups})=[a-z0-9_]+|\+?(?:{entries})(?:\.[a-z_0-9]+)+=(?:{value}))"
    files = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "Makefile", *(ROOT / "docs").rglob("*.md")]
    files += [p for folder in ("conf", "stages", "pipeline", "physics3d") for p in (ROOT / folder).rglob("*.*")]
    words = set()
    for file in files:
        if file.suffix in (".md", ".py", ".yaml", ""):
            words |= set(re.findall(pattern, prose(file)))
    return sorted(word.rstrip(".:") for word in words if word.partition("=")[0] not in MISSPELT)


def prose(file: Path) -> str:
    """The text of a file; of a program, its comments and strings."""
    if file.suffix != ".py":
        return file.read_text()
    with file.open("rb") as stream:
        tokens = [t.string for t in tokenize.tokenize(stream.readline) if t.type in (tokenize.STRING, tokenize.COMMENT)]
    return "\n".join(tokens)


def mentioned() -> list[str]:
    """Keys of stages that an error message, a comment or a page names, e.g. `learn.span`."""
    pattern = (
        r"(?<![\w./])((?:world|reconstruct|segment|fill|learn|simulate|render|prior|masker|scene)\.[a-z_]+)\b(?![(.])"
    )
    modules = r"\.(py|yaml|md|md\)|csv|html|fit|fields|base|name)$"
    words = set()
    for file in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        words |= set(re.findall(pattern, file.read_text()))
    for folder in ("stages", "pipeline", "physics3d"):
        for file in (ROOT / folder).rglob("*.py"):
            words |= set(re.findall(pattern, prose(file)))
    return sorted(w for w in words - MISSPELT if not re.search(modules, w))


SCENE_OF = {
    "start.stem": "carnation_parts",
    "source.name": "lego",
    "source.scale": "lego",
    "source.world": "jelly",
    "scene.camera_distance": "clip",
    "camera_distance": "photos",
    "prompts.0.view": "photos",
    "boundaries.0.point": "trained",
}


@pytest.mark.parametrize("word", recommended())
def test_what_is_recommended_composes(word):
    key, _, value = word.partition("=")
    scene = next((f"scene={s}" for part, s in SCENE_OF.items() if part in key), "scene=carnation")
    words = [word] if key == "scene" else ["scene=carnation_parts", word] if value == "parts" else [scene, word]
    if key.startswith("prior."):
        words.insert(
            0, next(f"prior={p}" for p in choices("prior") if key[6:] in composed((f"prior={p}",))[0]["prior"])
        )
    compose(words)


@pytest.mark.parametrize("key", mentioned())
def test_what_is_mentioned_exists(key):
    found = False
    for word in ("", "scene=bird", "scene=clip", *(f"prior={p}" for p in choices("prior")), "masker=sam2"):
        words = (word,) if word else ()
        node: Any = composed(words)[0]
        for name in key.split("."):
            node = node.get(name, ...) if isinstance(node, dict) else ...
        found |= node is not ...
    assert found, f"{key} is named in a page or a message, and is no entry"


# ---- what cannot be

COUNTED = re.compile(
    r"(^|\.)(seed|views|width|height|frames|iterations|max_gaussians|longest_side|sh_degree|check_every|patience|size|"
    r"rounds|steps|frames_per_step|views_per_step|polish|search|paint|nodes|every|most_points|image_size|motion_bucket|"
    r"branches|max_substeps|held_out_cameras\.\d+|view|checkpoint_bytes|clip_frames|copies|curls|flutes|veins)$"
)
SIGNED = re.compile(
    r"(gravity|velocity|point|normal|force|acceleration_of_each|centre|lower|upper|up)\.(\d|[xyz])$|(poissons_ratio|quadratic_coefficient)$|"
    r"prior\.guidance(\.\d)?$|truth\.\w+$|(path|profile)\.\d+\.[12]$|path\.\d+\.0$|(across|turn|carried_at|foot|target)\.\d$|"
    r"(fold|curl_height)$"
)
ZERO_IS_FINE = re.compile(
    r"(^|\.)(seed|sh_degree|rounds|steps|frames_per_step|views_per_step|polish|search|paint|nodes|motion_bucket|branches|view|"
    r"damping|friction|start|stay|ssim_weight|opacity|drop_pieces_below|opacity_weight|scale_weight|noise|noise_strength|"
    r"enclosure|hardening|hardening_modulus|second_modulus|cubic_modulus|viscosity|power_index|checkpoint_bytes|held_out_cameras\.\d+)$|"
    r"rates\.(?!final)\w+$|beyond\.\w+$|blur\.\d$|(positive|negative)\.\d+\.\d$|(colour|second|half_widths)\.\d+$|"
    r"(bands|profile)\.\d+\.\d$|(mottle|translucency|flutes|flute_depth|curls|coil|turns|lobes|waves)$"
)
ENDLESS = re.compile(r"(shear|bulk)_relaxation_time(_[23])?$")
NULL_IS_FINE = re.compile(
    r"(resolution|sheet_thickness|learn\.(duration|frames|steps)|floaters|variant|simulate\.force|render\.view|world\.(dt|checkpoint_bytes)|"
    r"prompts\.\d\.box|veins)$"
)
WORD_IS_FINE = re.compile(r"(capture\.clip|prompts\.\d\.view|render\.view|prior\.weights)$")
CHOICES = re.compile(r"(kind|precision|scheme|solver|spring|flow|isolated|attach|device|learn\.\d+|ties\.\d\.\d)$")
ORDERED = re.compile(r"(lower|upper|box|sigma|time)\.\d$")  # whether one number can be depends on its neighbours
BAD = [math.nan, math.inf, -1, 0, 1e30, 10**400, 1e-320, 1.5, "word", ["a", "list"], None]


def legal(key: str, old: Any, new: Any) -> bool | None:
    """Whether a person would expect `new` to be taken for `old`; None: no opinion. Written without the hints."""
    if (key.endswith(".part") and new == "word") or (key.startswith("simulate.force.") and new == -1):
        return None  # there may be no such part or no such force in the scene
    if key == "scene.source.scale" and new is None:
        return None  # some sources can do without
    if re.search(r"\.rings\.\d+\.0$", key) and new in (-1, 0, 1.5):
        return True  # degrees above the horizon, or below it
    if re.search(r"\.rings\.\d+\.1$", key) and new == 0:
        return None  # a share, if the others add up to one
    if new is None:
        return old is None or bool(NULL_IS_FINE.search(key))
    if isinstance(new, list) or (isinstance(new, float) and math.isnan(new)) or new in (1e30, 10**400, 1e-320):
        return False
    if isinstance(old, bool):
        return False
    if isinstance(old, str) and not WORD_IS_FINE.search(key):
        return isinstance(new, str) and not CHOICES.search(key)
    if isinstance(new, str):
        return bool(WORD_IS_FINE.search(key))
    if new == math.inf:
        return bool(ENDLESS.search(key))
    if ORDERED.search(key):
        return None
    if new == -1:
        return None if key.endswith("poissons_ratio") else bool(SIGNED.search(key))
    if new == 0:
        if key == "material.model.branches":
            return None  # a viscoelastic solid may have its elastic branch alone, a solid with branches needs one
        if re.search(r"\.normal\.|\.up\.|\.across\.", key):
            return None
        if key.startswith("learn.guess_widths."):
            return False  # a width, whatever it is the width of
        return bool(SIGNED.search(key) or ZERO_IS_FINE.search(key))
    return False if COUNTED.search(key) else None  # 1.5


def leaves(tree: Any, path: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    if isinstance(tree, dict | list) and tree:
        for name, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            if name != "_target_":
                yield from leaves(value, (*path, name))
    elif not isinstance(tree, dict | list):
        yield path, tree


@cache
def composed(words: tuple[str, ...]) -> tuple[dict, dict]:
    """The configuration, and key to set -> the paths that it reaches. An entry that no stage takes is none."""
    config, written, _ = before_checks(list(words))
    assert problem(config, written) is None
    reached: dict[str, list] = {}
    for path, _ in leaves(config):
        reached.setdefault(set_by(".".join(map(str, path)), written), []).append(path)
    taken = (*STAGES, "data", "output", "device", "seed", "verify", "twin")
    return config, {key: paths for key, paths in reached.items() if any(p[0] in taken for p in paths)}


def put(tree: Any, path: tuple, value: Any) -> None:
    for name in path[:-1]:
        tree = tree[name]
    tree[path[-1]] = value


def alike(key: str) -> str:
    """The same for all points of a list, and for all shapes of a thing that is made of them."""
    return re.sub(
        r"\b(path|profile|bands|half_widths|radii)\.\d+", r"\1", re.sub(r"\b(moving|still)\.\w+", "shape", key)
    )


SETTINGS = [()]
SETTINGS += [
    (f"{g}={n}",) for g in ("scene", "prior", "estimator", "masker", "densification", "solid") for n in choices(g)
]
SETTINGS += [(f"material={n}",) for n in choices("material") if n != "parts"]
SETTINGS += [(f"profile={n}",) for n in choices("profile")] + [(f"method={n}",) for n in choices("method")]


@cache
def fields(words: tuple[str, ...]) -> dict[tuple, str]:
    """What is to be tried -> its key: a field of a class, a value of one type in it. What a parameter of a material may
    be depends on the material as well."""
    config, reached = composed(words)
    found: dict[tuple, str] = {}
    for key, (path, *_) in reached.items():
        node, kind, field, material = config, "", path, ""
        for i, name in enumerate(path):
            if isinstance(node, dict):
                if "_target_" in node:
                    kind, field = node["_target_"], path[i:]
                if name == "start":
                    material = str(node.get("material", node.get("model")))
            node = node[name]
        found.setdefault((kind, alike(".".join(map(str, field))), material, type(node)), key)
    return found


@pytest.mark.parametrize("words", SETTINGS, ids=" ".join)
def test_every_number_and_name_that_cannot_be_is_refused_in_one_line(words):
    """Every leaf of the page, every bad value; those of a scene, prior, ... only of fields that none before it has."""
    config, reached = deepcopy(composed(words))
    own = dict(leaves(config))
    before = {field for earlier in SETTINGS[: SETTINGS.index(words)] for field in fields(earlier)}
    tried = 0
    for key in (key for field, key in fields(words).items() if field not in before):
        paths = reached[key]
        old = own[paths[0]]
        for new in BAD:
            expected = legal(key, old, new)
            for path in paths:
                put(config, path, new)
            text = problem(config, {})
            for path in paths:
                put(config, path, old)
            tried += 1
            if expected is not None:
                assert (text is None) == expected, f"{key}={new}: {text}"
            if text is not None:
                assert "\n" not in text and "; " in text and ("take" in text or "needs" in text or "give" in text), text
                assert any(str(name) in text for name in paths[0][-3:]), (key, text)
    assert tried > 500 or words
    assert config == composed(words)[0], "every value was put back"


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_can_be_left_out_only_where_the_graph_does_without_it(stage):
    config = deepcopy(composed(())[0])
    config[stage] = None
    text = problem(config, {})
    assert (text is None) == (stage in MAY_BE_NULL), text
