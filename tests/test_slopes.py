"""Costs as slopes, and rows that cannot both be true."""

import pytest
from slopes import contradictions, slope

UNIT = "ns per particle and substep"


def test_the_slope_is_what_a_unit_costs_whatever_setting_up_costs():
    """Seconds are made: 0.5 to set up, 0.002 per unit, one round of four disturbed by half a second."""
    calls = []

    def run(length: int) -> tuple[float, int]:
        calls.append(length)
        disturbed = 0.5 if len(calls) == 5 else 0.0
        return 0.5 + 0.002 * length + disturbed, length

    value, spread = slope(run, (10, 20, 30), 4)
    assert value == pytest.approx(0.002) and spread < 0.001
    assert calls == [10, 20, 30] * 4


def test_the_spread_is_half_the_distance_of_the_quartiles():
    """Two lengths: as many slopes as rounds, 1 to 7; the quartiles of seven numbers are the second and the sixth."""
    costs = iter([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    state = {}

    def run(length: int) -> tuple[float, int]:
        if length == 1:
            state["cost"] = next(costs)
        return state["cost"] * length, length

    assert slope(run, (1, 2), 7) == pytest.approx((4.0, 2.0))


def row(what, kind, size, value, spread=0.0, unit=UNIT, **more):
    return dict(what=what, kind=kind, size=size, value=value, spread=spread, unit=unit, **more)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        # as a table once had them: of one million particles, forward 5.15 and with adjoint 4.96
        ([row("solid", "forward", 1e6, 5.15), row("solid", "forward + adjoint", 1e6, 4.96)], "does more"),
        # ... and the material with a branch beside the one without
        ([row("solid", "forward", 1e6, 5.15), row("branch", "forward", 1e6, 0.89)], "does more"),
        # ten times the particles in a twentieth of the time each
        ([row("solid", "forward", 1e5, 171.0), row("solid", "forward", 1e6, 8.0)], "more particles"),
        ([row("solid", "forward", 1e5, -3.0)], "-3"),
        ([row("solid", "share of a copy", 1e5, 1.2, unit="share")], "1.2"),
    ],
)
def test_rows_that_contradict_each_other_are_named(rows, said):
    found = contradictions(rows, simpler=(("solid", "branch"),))
    assert len(found) == 1 and said in found[0]


def test_rows_that_agree_or_differ_by_less_than_their_spreads_are_no_contradiction():
    rows = [
        row("solid", "forward", 1e5, 150.0, 10.0),
        row("solid", "forward + adjoint", 1e5, 500.0, 30.0),
        row("branch", "forward", 1e5, 140.0, 5.0),
        row("solid", "forward", 1e6, 130.0, 10.0),
        # of one thread and of two: no law says which is faster
        row("solid", "forward", 1e4, 120.0, threads=2),
        row("solid", "forward", 1e4, 150.0, threads=1),
        row("solid", "share of a copy", 1e5, 0.3, unit="share"),
    ]
    assert contradictions(rows, simpler=(("solid", "branch"),)) == []
