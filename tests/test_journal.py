"""What a journal is asked is answered once, by the path that was taken."""

import numpy as np
import torch
from scipy import optimize

import physics3d.checkpoint
from physics3d.journal import Journal
from physics3d.log import Log


def test_an_optimiser_of_scipy_goes_on_where_it_was(tmp_path, monkeypatch):
    """Rosenbrock's valley by Powell: however often it is stopped, no place is looked at twice; it ends at the same one.

    One round along all directions has every kind of question; each note waits for the disk, so a few dozen are enough.
    """
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.0)
    looked: list[tuple[float, ...]] = []

    def descended(folder, most: int):
        journal = Journal(Log(folder, quiet=True))

        def rosenbrock(x: np.ndarray) -> float:
            if len(looked) == most:
                raise KeyboardInterrupt
            looked.append(tuple(x))
            return float(optimize.rosen(x))

        cost = lambda x: journal.ask("cost", x.tolist(), answer=lambda: rosenbrock(x))
        return optimize.minimize(cost, np.array([-1.2, 1.0]), method="Powell", options={"maxiter": 1})

    straight, count = descended(None, -1), len(looked)
    looked.clear()
    for most in (1, 5, 12):
        try:
            descended(tmp_path, most)
        except KeyboardInterrupt:
            assert len(looked) == most
    resumed = descended(tmp_path, -1)
    assert np.array_equal(resumed.x, straight.x) and resumed.nfev == straight.nfev == count == len(looked)


def test_answers_to_other_questions_are_forgotten(tmp_path, monkeypatch):
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.0)
    one, two = torch.tensor([1.0, 2.0]), torch.tensor([1.0, 3.0])
    first = Journal(Log(tmp_path, quiet=True))
    for x in (one, two, one):
        first.ask("twice", x, answer=lambda x=x: 2 * x)
    again = Journal(Log(tmp_path, quiet=True))
    never = lambda: pytest_fail()
    assert torch.equal(again.ask("twice", one, answer=never), 2 * one)
    assert torch.equal(again.ask("thrice", two, answer=lambda: 3 * two), 3 * two)  # another question
    assert torch.equal(again.ask("twice", one, answer=lambda: 4 * one), 4 * one), "what came after it is computed anew"
    assert "takes another path" in (tmp_path / "log.txt").read_text()


def pytest_fail():
    raise AssertionError("it was asked before")
