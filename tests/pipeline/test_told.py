"""What a person reads of a parameter, and what is true of it."""

import pytest
import torch

from physics3d.learning import which_model
from physics3d.metrics.parameters import parameter_errors
from physics3d.truth import truth_of
from physics3d.world import Estimate
from pipeline.told import TIE, Parameter, of_models


@pytest.mark.parametrize(
    "told, words",
    [
        ({}, "as given"),
        ({"learned": 0.30000001192092896}, "as given"),  # 0.3 in float32
        ({"learned": 0.35}, "no interval is known"),
        ({"learned": 0.35, "low": 0.2, "high": 0.5}, "between 0.2 and 0.5"),
        (
            {"learned": 0.35, "low": 0.2, "high": 0.5, "determined": False},
            "not determined by this clip; between 0.2 and 0.5",
        ),
    ],
)
def test_an_interval_is_told_in_words(told, words):
    assert Parameter(name="poissons_ratio", start=0.3, **told).between == words


@pytest.mark.parametrize(
    "name, true",
    [
        ("youngs_modulus", 1.5e5),
        ("stem.youngs_modulus", 1.5e5),  # one material is that of all parts
        ("petals.youngs_modulus", 2e4),  # said of the part itself
        ("stem.yield_stress", None),
    ],
)
def test_what_is_true_of_the_body_is_true_of_its_parts(name, true):
    truth = {"youngs_modulus": 1.5e5, "petals.youngs_modulus": 2e4}
    assert truth_of(name, truth) == true
    estimate = Estimate(parameters={name: torch.tensor(3e5)}, velocity=torch.zeros(3))
    table = parameter_errors({"learned": estimate}, truth)
    assert [row["truth"] for row in table.values()] == ([] if true is None else [true])


def test_what_a_clip_leaves_open_is_told_in_words():
    """By the odds that the learning itself decides by; the recording that tells most comes first."""
    assert TIE == which_model.TIE
    odds, recordings = {"without a": TIE + 0.1, "without b": TIE - 0.1}, {"a push": 1.0, "a pull": 9.0, "again": -2.0}
    assert [line.partition(" (")[0] for line in of_models(odds, recordings)] == [
        "without a: does not explain the clip",
        "without b: explains the clip as well: a tie",
        "to film next: a pull: should settle it",
        "to film next: a push: would hardly settle it",
        "to film next: again: would hardly settle it",
    ]
    assert of_models({}, {}) == []
