"""Laws of looking along a valley: an interval reaches as far as the loss allows, by losses written here."""

import numpy as np
import pytest

from physics3d.learning.interval import Told
from physics3d.learning.sandwich import NORMAL
from physics3d.learning.valley import reaches
from physics3d.log import Log

BEFORE = np.array([2.0, 1.0])  # widths of what was thought beforehand
TURN = np.array([[0.8, -0.6], [0.6, 0.8]])
SAID = Told(axes=TURN, middle=np.zeros(2), deviation=np.array([0.2, 0.001]))
END = NORMAL * 0.2 * BEFORE * TURN[:, 0]  # where the 90 % of derivatives end


def along(profile, base: float = 1.0):
    """`reaches` for a loss that rises by profile(s) at s END, in units of what it should rise by at s = 1."""
    asked = []

    def loss(d):
        s = float(d @ END / (END @ END))
        asked.append(s)
        np.testing.assert_allclose(d, s * END, atol=1e-12)  # along the valley, not across
        return base + 0.01 * profile(s)

    said, lower = reaches(SAID, before=BEFORE, rise=lambda d: 0.01, loss=loss, log=Log(None))
    return said, lower, asked


@pytest.mark.parametrize("power, share, reach", [
    (2.0, 1.0, 1.0),  # as derivatives say
    (2.0, 4.0, 1.0),  # steeper: an interval gets no narrower
    (2.0, 0.25, 2.0),  # a parabola half as steep
    (1.0, 0.4, 2.5),
    (4.0, 0.1, 0.1**-0.25),
])  # fmt: skip
def test_an_interval_ends_where_the_loss_has_risen(power, share, reach):
    """share |s|^power = 1 at the reach, to a tenth between places a factor 1.8 apart; what is well known stays."""
    said, lower, _ = along(lambda s: share * abs(s) ** power)
    assert lower is None
    assert said.deviation[0] == pytest.approx(0.2 * reach, rel=0.1)
    assert said.middle[0] == pytest.approx(0, abs=1e-9) and said.deviation[1] == SAID.deviation[1]


def test_a_valley_that_is_flat_to_one_side_reaches_there_alone():
    said, _, _ = along(lambda s: s**2 if s > 0 else 0.25 * s**2)
    low, high = (said.middle[0] + side * NORMAL * said.deviation[0] for side in (-1, 1))
    assert [low, high] == pytest.approx([-2 * NORMAL * 0.2, NORMAL * 0.2], rel=0.1)


def test_nobody_looks_beyond_what_was_thought_before():
    said, _, asked = along(lambda s: 0.0)
    assert max(abs(s) * np.abs(END / BEFORE).max() for s in asked) <= NORMAL
    assert said.deviation[0] > 0.4  # and it reaches as far as anyone looked


def test_a_lower_place_is_a_better_answer():
    _, lower, _ = along(lambda s: -50.0 if 1.5 < s < 4 else 0.2 * s**2)
    assert lower is not None and 1.5 < float(lower @ END / (END @ END)) < 4
