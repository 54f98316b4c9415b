"""Laws of rivals: an interval holds every stiffness that the clip does not tell from the one that was learned."""

import math

import numpy as np
import pytest
import torch

from physics3d.learning.course import Point
from physics3d.learning.interval import Posterior
from physics3d.learning.likelihood import ratio
from physics3d.learning.rivals import rivals, widened
from physics3d.learning.sandwich import NORMAL, Evidence
from physics3d.log import Log

STEP = math.log(4)


def aliased(frames: int, noise: float, swings: float, generator: np.random.Generator):
    """(course, what does as well, found, truth) of a thing that swings `swings` times, ln of its stiffness theta from
    the truth, filmed in so many frames whose pixels, 40 of them, err independently. Search by a factor 4, then the
    bottom of a valley."""
    t = np.linspace(0, 1, frames)[1:, None]
    gain = generator.normal(size=(1, 40))
    model = lambda theta: gain * np.sin(2 * np.pi * swings * math.exp(theta / 2) * t)
    seen = model(0.0) + noise * generator.normal(size=(frames - 1, 40))
    loss = lambda theta: float(np.mean((model(theta) - seen) ** 2))
    truth = generator.uniform(-1, 1)  # where the start is, that theta counts from
    tried = [STEP * k - truth for k in (-1, 0, 1)]
    best = min(tried, key=loss)
    while (lower := min(best + np.array([-0.005, 0.0, 0.005]), key=loss)) != best:
        best = lower
    J = (model(best + 1e-5) - model(best - 1e-5)) / 2e-5
    point = lambda way, theta: Point(way=way, theta=torch.tensor([theta + truth]), loss=loss(theta))
    course = [*(point("search", theta) for theta in tried), point("polish", best)]

    def told_apart(points: list[Point]) -> list[bool]:
        found = []
        for one in points:
            change = model(float(one.theta) - truth) - model(best)
            score = (change * (model(best) - seen))[:, :, None]
            evidence = Evidence(JJ=np.array([[float((change**2).sum())]]), score=score, share=(change**2)[:, :, None])
            half = seen.size / 2
            found.append(ratio(evidence, rise=half * (one.loss - loss(best)), loss=half * loss(best)).told_apart)
        return found

    width = noise / math.sqrt(float((J**2).sum()))
    found = Posterior(mean=np.array([best + truth]), covariance=np.array([[width**2]]), before=np.array([2.0]))
    return course, rivals(course, told_apart), found, truth


def held(found: Posterior, truth: float) -> bool:
    return bool(abs(found.mean[0] - truth) <= NORMAL * math.sqrt(found.covariance[0, 0]))


def test_the_truth_is_held_where_swings_are_aliased():
    """Five swings in six frames, and a search by factors of 4 that may skip the best valley: two truths in three are
    held at least, where the local interval holds one in many."""
    generator = np.random.default_rng(0)
    alone = together = 0
    for _ in range(60):
        course, equal, found, truth = aliased(6, 3.0, 5.0, generator)
        alone += held(found, truth)
        together += held(widened(found, course, equal, Log(None)), truth)
    assert alone < 10 and together >= 40  # of 60


def test_a_clear_clip_keeps_its_interval():
    """Half a swing in thirty frames with little noise: nothing else that was tried comes near."""
    course, equal, found, _ = aliased(30, 0.02, 0.5, np.random.default_rng(1))
    assert widened(found, course, equal, Log(None)) == found


def test_intervals_do_not_reach_beyond_what_was_thought_before(tmp_path):
    """Two stiffnesses that do as well, far from each other; a second parameter that the search leaves alone."""
    found = Posterior(mean=np.array([-3.0, 0.0]), covariance=0.01 * np.eye(2), before=np.array([0.5, 1.0]))
    ways = ((-3.0, "search"), (0.0, "search"), (3.0, "search"), (-3.0, "descent"))
    course = [Point(way=way, theta=torch.tensor([theta, 0.0]), loss=1.0) for theta, way in ways]
    wide = widened(found, course, course[:3], Log(tmp_path, quiet=True))
    reach = NORMAL * np.sqrt(wide.covariance.diagonal())
    assert wide.mean[0] + reach[0] == pytest.approx(NORMAL * 0.5)
    assert [wide.mean[1], reach[1]] == pytest.approx([0.0, NORMAL * 0.1])
    assert "as well as the one that was learned" in (tmp_path / "log.txt").read_text()


def test_an_interval_holds_the_other_valley_where_it_is_as_deep(tmp_path):
    """Two ends of a polish: both intervals where they do as well, that of the answer where the other is worse."""
    found = Posterior(mean=np.zeros(2), covariance=0.01 * np.eye(2), before=np.full(2, 5.0))
    half = NORMAL * 0.1
    for loss, reach in ((1.02, 1.5 + half), (9.0, half)):
        told_apart = lambda points: [point.loss > 2 for point in points]
        course = [
            Point(way="across", theta=torch.tensor([1.5, -1.0]), loss=loss),
            Point(way="polish", theta=torch.zeros(2), loss=1.0),
        ]
        wide = widened(found, course, rivals(course, told_apart), Log(tmp_path, quiet=True))
        high = wide.mean + NORMAL * np.sqrt(wide.covariance.diagonal())
        low = wide.mean - NORMAL * np.sqrt(wide.covariance.diagonal())
        assert high[0] == pytest.approx(reach) and low[0] == pytest.approx(-half)
        assert low[1] == pytest.approx(-half if loss > 2 else -1.0 - half) and high[1] == pytest.approx(half)
    assert "explains the clip as well" in (tmp_path / "log.txt").read_text()
