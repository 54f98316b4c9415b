"""make fit-curves: folders of tables, through the same door as the Makefile's."""

import csv

import numpy as np
import pytest
from examples.rubber import NOISE, TRUTH

from physics3d.laboratory.fit import relative_error
from physics3d.laboratory.prediction import predict
from physics3d.laboratory.tables import read_folder
from pipeline.fingerprint import ROOT
from pipeline.fit_curves import configured, main
from pipeline.page import problem
from pipeline.settings import choices, compose

LONG, BRANCH, TIME = 4e4, 6e4, 0.7  # of a standard linear solid, shear: G, g [Pa], T [s]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Relaxation after a small shear at 8 and at 40 times as large a strain, 1 % of noise; the second is held out."""
    folder = tmp_path_factory.mktemp("tables with 'quotes' $and spaces")
    rng = np.random.default_rng(0)
    time = np.concatenate([[0], np.geomspace(0.01, 10, 30)])
    for name, strain in (("small", 1e-3), ("larger", 5e-3)):
        stress = strain * (LONG + BRANCH * np.exp(-time / TIME))
        stress += 0.01 * stress.max() * rng.standard_normal(len(time))
        rows = [f"{t:g},{100 * strain:g},{s:.6g}" for t, s in zip(time, stress)]
        text = "\n".join(["# start: jump", "time [s],shear [%],shear stress [Pa]", *rows])
        (folder / f"{name}.csv").write_text(text)
    return folder


def test_a_folder_becomes_a_material(folder, capsys):
    words = {"DATA": str(folder), "MATERIAL": "viscoelastic", "UNSEEN": "larger"}
    assert main(words) == 0
    out = folder.with_name(f"{folder.name}_viscoelastic")
    assert (out / "previews" / "curves.png").stat().st_size > 5000
    rows = {row["parameter"]: row for row in csv.DictReader((out / "intervals.csv").open())}
    for name, true in (
        ("youngs_modulus", 2.6 * LONG),
        ("branch_shear_modulus", BRANCH),
        ("shear_relaxation_time", TIME),
    ):
        low, high = float(rows[name]["lower"]), float(rows[name]["upper"])
        assert low / (high / low) < true < high * (high / low) and high / low < 1.2  # one draw: twice its width
    errors = {row["test"]: row for row in csv.DictReader((out / "errors.csv").open())}
    assert errors["larger"]["role"] == "unseen" and errors["small"]["role"] == "fitted"
    for row in errors.values():  # 1 % of the largest stress is 2 % of the mean one
        assert float(row["error_percent"]) < 3 < 20 < float(row["error_at_start_percent"])
    page = (out / "fit.md").read_text()
    assert "**unseen**" in page and "AR(1)" in page and "youngs_modulus" in capsys.readouterr().out

    # what is written can stand in conf/material
    from omegaconf import OmegaConf

    config, _ = compose(["scene=carnation"])
    made = OmegaConf.to_container(OmegaConf.load(out / "material.yaml"))
    for stage in config.values():
        if isinstance(stage, dict) and isinstance(stage.get("world"), dict):
            stage["world"] |= {"material": made["model"], "start": made["start"]}
    assert problem(config | {"material": made}, {}) is None
    assert made["start"]["youngs_modulus"] == pytest.approx(float(rows["youngs_modulus"]["value"]), rel=1e-5)


@pytest.mark.parametrize(
    "words, code, message",
    [
        ({}, 2, "DATA is not given"),
        ({"DATA": "here"}, 2, "MATERIAL is not given"),
        ({"MATERIAL": "../rubber"}, 2, "MATERIAL is '../rubber'; take one of"),
        ({"MATERIAL": "rubbber"}, 2, "MATERIAL is 'rubbber'; take one of"),
        ({"MATERIAL": "viscoelastic", "UNSEEN": "creep"}, 1, "UNSEEN names 'creep'; the tests are larger, small"),
        ({"MATERIAL": "viscoelastic", "UNSEEN": "small,larger"}, 1, "UNSEEN names every test"),
        ({"MATERIAL": "drucker_prager"}, 1, "friction_angle is no modulus"),
    ],
)
def test_what_cannot_be_fitted_is_one_line(folder, tmp_path, capsys, words, code, message):
    data = {"DATA": str(folder), "OUT": str(tmp_path)} if "MATERIAL" in words else {}
    assert main(data | words) == code
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "fit.md").exists()


@pytest.mark.parametrize("name", [choice for choice in choices("material") if choice != "parts"])
def test_every_configured_material_loads_and_obeys_its_limits(name):
    """Its start is allowed, what it learns and ties can be learned, and a branch is as compressible as its comment
    says."""
    material, field, config = configured(name)
    material.check_parameters(field.start)
    assert set(field.start) == set(material.parameters) and field.groups
    nu = config["start"].get("poissons_ratio")
    for suffix in ("", "_2", "_3"):
        if nu is not None and (mu := config["start"].get(f"branch_shear_modulus{suffix}")):
            ratio = config["start"][f"branch_bulk_modulus{suffix}"] / mu
            assert ratio == pytest.approx(2 * (1 + nu) / (3 * (1 - 2 * nu)), rel=0.03)  # written with two digits


def test_the_example_is_what_it_says():
    """The tables of docs/examples/rubber are those of their truth, but for their noise: 1 % of the largest value is 1
    to 3 % of the mean one. A load, a rest before the first row, compression, cycles: all of the reader at once."""
    material, field, _ = configured("rubber_two")
    theta = np.array([np.log(TRUTH[group[0]] / float(field.start[group[0]])) for group in field.groups])
    tests = read_folder(ROOT / "docs" / "examples" / "rubber")
    assert len(tests) == 7
    for test, found in zip(tests, predict(material, field, theta, tests)):
        assert NOISE / 2 < relative_error(test, found) < 3 * NOISE, test.name
