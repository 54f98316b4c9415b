"""The handbook: its numbers can be; what a scene says of a thing arrives where learning starts, and nothing else."""

import math

import numpy as np
import pytest
import write_handbook
import yaml

from physics3d.handbook import begin, find, read
from pipeline.fingerprint import ROOT
from pipeline.settings import CONF, SettingsError, compose

FILE = CONF / "handbook.yaml"
THINGS = read(FILE)
GOOD = yaml.safe_load(FILE.read_text())
ZENER = ["youngs_modulus", "poissons_ratio", "branch_shear_modulus", "branch_bulk_modulus", "shear_relaxation_time"]


@pytest.mark.parametrize("name", THINGS)
def test_sound_in_it_is_faster_than_a_walk_and_slower_than_in_steel(name):
    """A unit that slipped by a thousand shows: c = sqrt(E/rho) [m/s] of solids lies between 1 and 5200."""
    thing = THINGS[name]
    assert 1 < math.sqrt(thing.youngs_modulus.value / thing.density.value) < 5200
    assert thing.density.value * math.exp(-2 * thing.density.width) < 8000
    assert all(len(getattr(thing, figure).source) > 5 for figure in GOOD[name])


@pytest.mark.parametrize("eta", [0.001, 0.1, 0.5, 2.0])
def test_the_branch_loses_as_much_as_is_said(eta):
    """Largest tan delta of a Zener solid over all frequencies, from its textbook moduli; K and mu alike."""
    thing = next(iter(THINGS.values()))
    figure = type(thing.loss_factor)(value=eta, width=0.5, source="a test")
    values, widths = begin(type(thing)(**{**vars(thing), "loss_factor": figure}), ZENER)
    mu = values["youngs_modulus"] / (2 * (1 + values["poissons_ratio"]))
    K = values["youngs_modulus"] / (3 * (1 - 2 * values["poissons_ratio"]))
    w = np.geomspace(1e-3, 1e3, 200_001)  # times the relaxation time
    for branch, spring in (("branch_shear_modulus", mu), ("branch_bulk_modulus", K)):
        loss = values[branch] * w / (1 + w**2) / (spring + values[branch] * w**2 / (1 + w**2))
        assert loss.max() == pytest.approx(eta, rel=1e-6)
        assert widths[branch] == pytest.approx(math.hypot(thing.youngs_modulus.width, 0.5))
    assert "shear_relaxation_time" not in values


def test_a_scene_takes_start_and_widths_and_keeps_its_density():
    plain, _ = compose(["scene=carnation"])
    config, _ = compose(["scene=carnation", "scene.thing=foam"])
    foam = GOOD["foam"]
    for stage in ("learn", "guess", "simulate"):
        start = config[stage]["world"]["start"]
        assert start["youngs_modulus"] == foam["youngs_modulus"]["value"]
        assert start["poissons_ratio"] == foam["poissons_ratio"]["value"]
        assert start["shear_relaxation_time"] == plain[stage]["world"]["start"]["shear_relaxation_time"]
        assert config[stage]["world"]["density"] == 300.0, "the scene gives it"
    assert config["learn"]["guess_widths"]["youngs_modulus"] == foam["youngs_modulus"]["width"]
    assert config["learn"]["beyond"] == plain["learn"]["beyond"]
    assert plain["learn"]["guess_widths"] == {}, "nothing is taken where no thing is named"


def test_a_density_that_nobody_gives_is_the_handbooks():
    config, _ = compose(["scene=carnation", "scene.thing=foam", "scene.density=null"])
    assert config["learn"]["world"]["density"] == config["simulate"]["world"]["density"] == 35.0
    assert config["learn"]["beyond"]["density"] == GOOD["foam"]["density"]["width"]
    with pytest.raises(SettingsError, match=r"scene\.density"):
        compose(["scene=carnation", "scene.density=null"])


def test_what_is_said_elsewhere_wins_over_the_handbook():
    words = ["material.start.youngs_modulus=7e4", "+learn.guess_widths.youngs_modulus=0.1"]
    config, _ = compose(["scene=carnation", "scene.thing=foam", *words])
    assert config["learn"]["world"]["start"]["youngs_modulus"] == 7e4
    assert config["learn"]["guess_widths"]["youngs_modulus"] == 0.1


def test_every_part_may_be_a_thing_of_its_own():
    config, _ = compose(["scene=carnation_parts", "scene.thing={stem: twig, petals: petal}"])
    start, widths = config["learn"]["world"]["start"], config["learn"]["guess_widths"]
    assert start["stem.youngs_modulus"] == GOOD["twig"]["youngs_modulus"]["value"]
    assert start["petals.youngs_modulus"] == GOOD["petal"]["youngs_modulus"]["value"]
    assert set(widths) <= set(start) and "petals.poissons_ratio" in widths
    with pytest.raises(SettingsError, match="names 2 things; give scene"):
        compose(["scene=carnation_parts", "scene.thing={stem: twig, petals: petal}", "scene.density=null"])


@pytest.mark.parametrize(
    "words", [["material=elastic"], ["material=maxwell"], ["material=neo_hookean"], ["method=physgaussian"]]
)
def test_every_material_takes_what_it_has(words):
    """A Maxwell body alone, which nothing else holds, starts as stiff as the thing."""
    config, _ = compose(["scene=carnation", "scene.thing=rubber", *words])
    start, rubber = config["simulate"]["world"]["start"], GOOD["rubber"]
    E, nu = rubber["youngs_modulus"]["value"], rubber["poissons_ratio"]["value"]
    if "maxwell" in words[0]:
        assert start["branch_shear_modulus"] == pytest.approx(E / (2 * (1 + nu)))
    else:
        assert start["youngs_modulus"] == E


@pytest.mark.parametrize("words, told", [
    (["scene.thing=stam"], "take stem"), (["scene.thing=rubbr"], "take .*rubber"),
    (["scene.thing=qqq"], "take bread, cake"),
    (["scene.thing=foam", "material=newtonian"], "has none of youngs_modulus"), (["scene.thing=3"], "take a name of"),
])  # fmt: skip
def test_what_is_no_thing_is_refused_with_the_nearest_names(words, told):
    with pytest.raises(SettingsError, match=told):
        compose(["scene=carnation", *words])


@pytest.mark.parametrize("change, told", [
    (lambda of: of.pop("density"), "it needs youngs_modulus"),
    (lambda of: of["density"].update(value=-1.0), r"density is -1\.0; take"),
    (lambda of: of["poissons_ratio"].update(value=0.5), "poissons_ratio is 0.5; take"),
    (lambda of: of["youngs_modulus"].update(width=0.0), "width is 0.0; take"),
    (lambda of: of["loss_factor"].pop("source"), "it needs value, width and source"),
    (lambda of: of["loss_factor"].update(source=""), "source is ''; take"),
    (lambda of: of["density"].update(value="heavy"), "value is 'heavy'; take"),
])  # fmt: skip
def test_a_figure_that_cannot_be_is_refused(tmp_path, change, told):
    things = yaml.safe_load(FILE.read_text())
    change(things["bread"])
    file = tmp_path / "handbook.yaml"
    file.write_text(yaml.safe_dump(things))
    with pytest.raises(ValueError, match=rf"bread.*{told}"):
        read(file)


def test_the_page_is_the_file():
    """docs/handbook.md: `make handbook` after a change."""
    assert (ROOT / "docs" / "handbook.md").read_text() == write_handbook.page(THINGS)
    assert find(THINGS, "bread").name == "bread"
