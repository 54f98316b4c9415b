"""What a person reads of a parameter."""

import pytest

from pipeline.told import Parameter


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
