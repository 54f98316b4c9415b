"""The command line: what is wrong with it is said in one line, quickly, and with the remedy."""

import re
import subprocess
import sys

import pytest

from pipeline.settings import CONF, GROUPS, SettingsError, choices, compose


@pytest.mark.parametrize(
    "word, message",
    [
        ("scene=carnaton", r"no scene 'carnaton'; there are .*carnation"),
        ("profile=tiny", r"no profile 'tiny'; there are .*smoke"),
        ("learn.stepss=50", r"no 'stepss' in learn; did you mean learn\.steps\?"),
        ("lern.steps=50", r"no 'lern'; did you mean learn\?"),
        ("simulate.qqqq=1", r"no 'qqqq' in simulate; there are .*fps"),
        ("learn.steps=many", r"learn\.steps is 'many'; take a whole number >= 0"),
        ("verify=maybe", r"verify is 'maybe'; take true or false"),
        # a number that cannot be
        ("simulate.fps=0", r"simulate\.fps is 0; take a number > 0"),
        ("simulate.frames=1", r"simulate\.frames is 1; take a whole number >= 2"),
        ("learn.frames=4.5", r"learn\.frames is 4\.5; take a whole number"),
        ("reconstruct.iterations=nan", r"reconstruct\.iterations is nan; take a whole number"),
        ("reconstruct.max_gaussians=1e12", r"reconstruct\.max_gaussians is .*; take a whole number .* <= 1000000000"),
        ("scene.dx=1e9", r"^scene\.dx is 1000000000\.0; take .* <= 10000 \[m\]"),
        ("scene.spacing=5", r"^scene\.spacing is 5; take at most a cell, world\.dx = 0\.012 m"),
        ("material.start.poissons_ratio=0.5", r"^material\.start\.poissons_ratio is 0\.5; take .* < 0\.5"),
        ("learn.frames=500", r"^learn\.frames is 500; take at most the 60 of a take"),
        # a name that does not exist
        ("fill.isolated=burn", r"fill\.isolated is 'burn'; take one of attach, drop, keep"),
        ("learn.learn=[youngs_modolus]", r"learn\.learn names 'youngs_modolus'; take some of youngs_modulus"),
        ("learn.ties=[[youngs_modulus,youngs_modulus]]", r"learn\.ties names youngs_modulus twice"),
        ("learn.world.dx=0.02", r"learn\.world\.dx is taken from scene\.dx; set scene\.dx"),
        ("world.material=3", r"world\.material is 3; take a mapping with the _target_ of a AbstractMaterial"),
        ("scene.source._target_=physics3d.scenes.ply.PlyScen", r"did you mean PlyScene\?"),
        (
            "prior._target_=physics3d.gaussians.densification.adaptive.Adaptive",
            r"prior\._target_ is .*; take a class that is a AbstractPrior",
        ),
        # what belongs together
        ("world.lower=[0,0,0]", r"world\.lower is \[0, 0, 0\] and upper null; take both corners, or neither"),
        ("scene.prompts.0.box=[0.5,0,0.2,1]", r"scene\.prompts\.0\.box is .*; take left < right"),
        ("scene.boundaries.0.upper=[-1,0,0]", r"scene\.boundaries\.0\.lower is .*; take a corner below upper"),
        ("material=parts", r"names the parts \['plant'\]; take those that the material has, \['petals', 'stem'\]"),
        ("scene.excitation=[]", r"no impulse in scene\.excitation has a force"),
        # taken away, or added
        ("~simulate.force.z", r"simulate\.force is .*; take x, y, z, each a number"),
        ("~scene.dx", r"scene\.dx is not there, but others are taken from it; keep it"),
        ("~reconstruct", r"reconstruct is null; only segment, learn, foretell, evaluate may be"),
        ("+learn.foo=1", r"learn\.foo: Learn has no such field; there are world, prior"),
        ("+foo=1", r"foo: there is no such entry; there are data, output"),
        ("~learn", r"learn is missing; learn=null leaves it out"),
        ("material.start=null", r"material\.start is null; take names, each with a number"),
        ("material.start=5", r"material\.start is 5; take names"),
        # in the place of what it is not
        ("simulate.force=[1,2,3]", r"simulate\.force cannot become that; set what is in it by simulate\.force\."),
        ("learn.guess_widths={no: 1}", r"learn\.guess_widths cannot become that; .*by \+learn\.guess_widths\.<name>="),
        ("learn.steps=1,2", r"learn\.steps=1,2: one value is needed; a list is learn\.steps=\[\.\.\.\]"),
        ("learn.steps=range(1,5)", r"one value is needed"),
        ("+hydra.run.dir=x", r"settings of Hydra change nothing here"),
        *((f"scene.name={n}", r"scene\.name is .*; take a name that a file can have") for n in ("a/b", "..", "' '")),
        ("carnation", r"'carnation' is not of the form key=value"),
        ("simulate.excitation=[", r"cannot read 'simulate\.excitation=\['"),
    ],
)
def test_a_mistake_is_one_line_with_the_remedy(word, message):
    with pytest.raises(SettingsError, match=message) as caught:
        compose([word])
    assert "\n" not in str(caught.value)


def test_overrides_reach_the_configuration():
    config, picked = compose(["profile=smoke", "learn.steps=7", "world.dt=1e-3"])
    assert config["learn"]["steps"] == 7 and config["world"]["dt"] == config["simulate"]["world"]["dt"] == 1e-3
    assert picked["profile"] == "smoke" and set(picked) == set(GROUPS)


@pytest.mark.parametrize(
    "word, path, value",
    [
        ("scene.source.seed=3", ("capture", "source", "seed"), 3),  # a field that no file mentions
        ("world.scheme=implicit", ("simulate", "world", "scheme"), "implicit"),
        ("material.start.stem.youngs_modulus=3e5", ("learn", "world", "start", "stem.youngs_modulus"), 3e5),
    ],
)
def test_whatever_a_class_takes_can_be_set(word, path, value):
    node, _ = compose(["scene=carnation_parts", word])
    for name in path:
        node = node[name]
    assert node == value


def run(*words: str) -> subprocess.CompletedProcess:
    call = [sys.executable, "-X", "importtime", "-m", "pipeline", *words]
    return subprocess.run(call, capture_output=True, text=True, cwd=CONF.parent)


def test_help_lists_what_there_is_and_imports_nothing_heavy():
    done = run("--help")
    assert done.returncode == 0
    for group in GROUPS:
        assert f"\n{group}=" in done.stdout
        assert all(re.search(rf"^    {name}\s+\S", done.stdout, re.M) for name in choices(group))  # with a description
    assert not re.search(r"\| +(torch|warp|prefect|mlflow|hydra)$", done.stderr, re.M)


@pytest.mark.parametrize("word", ["scene=nowhere", "learn.frames=4.5", "fill.isolated=burn"])
def test_a_mistake_ends_with_code_2_and_before_anything_heavy_is_imported(word):
    done = run(word)
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("import time")]
    assert done.returncode == 2 and line.startswith("error: ")
    assert not re.search(r"\| +(torch|warp|prefect|mlflow)$", done.stderr, re.M)
