"""What a journal is asked is answered once, by the path that was taken."""

import numpy as np
import pytest
import torch
from scipy import optimize

import physics3d.checkpoint
from physics3d.journal import Journal
from physics3d.log import Log
from physics3d.trajectory import NotMoved


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


def test_that_there_is_no_answer_is_noted_and_costs_nothing_that_follows(tmp_path, monkeypatch):
    """The second of three questions has none, as of a body that nothing moves: asked again after a stop, all three are
    as they were, and nothing is computed."""
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.0)
    computed = []

    def answers() -> list[int | str]:
        journal, found = Journal(Log(tmp_path, quiet=True)), []

        def inverse(x: int) -> int:
            computed.append(x)
            if x == 0:
                raise NotMoved("nothing moves it")
            return 12 // x

        for x in (3, 0, 4):
            try:
                found.append(journal.ask("inverse", x, answer=lambda x=x: inverse(x)))
            except NotMoved as reason:
                found.append(str(reason))
        return found

    assert answers() == answers() == [4, "nothing moves it", 3]
    assert computed == [3, 0, 4]
    assert "another path" not in (tmp_path / "log.txt").read_text()


def test_of_a_long_answer_what_it_asked_for_is_kept_until_it_is_known(tmp_path, monkeypatch):
    """Sums of products, two levels deep, stopped before each product in turn: none is computed twice."""
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.0)
    computed: list[tuple[int, int]] = []

    def table(folder, most: int) -> list[int]:
        journal = Journal(Log(folder, quiet=True))

        def product(i: int, j: int) -> int:
            if len(computed) == most:
                raise KeyboardInterrupt
            computed.append((i, j))
            return i * j

        def row(i: int) -> int:
            # another computation may open the journal as well
            ask = Journal(journal.log).ask
            return sum(ask("product", j, answer=lambda j=j: product(i, j)) for j in range(3))

        return [journal.ask("row", i, answer=lambda i=i: row(i)) for i in range(4)]

    for most in range(12):
        with pytest.raises(KeyboardInterrupt):
            table(tmp_path, most)
    # rows ask the same questions: of another row the answers do not count
    assert table(tmp_path, 12) == [3 * i for i in range(4)]
    assert computed == [(i, j) for i in range(4) for j in range(3)]
    assert table(tmp_path, 12) == [3 * i for i in range(4)], "all of it is known"
    assert len(Journal(Log(tmp_path, quiet=True)).book.levels) == 1, "and what only led to it is forgotten"


def test_an_answer_is_laid_out_as_it_will_be_after_a_stop(tmp_path, monkeypatch):
    """Sums of an array are rounded by the order of its axes in memory: it has to be one order."""
    monkeypatch.setattr(physics3d.checkpoint, "LONGEST", 0.0)
    x = np.random.default_rng(0).standard_normal((40, 30, 20))
    answer = lambda: dict(array=x.transpose(2, 1, 0), tensor=torch.from_numpy(x).permute(1, 2, 0))
    first = Journal(Log(tmp_path, quiet=True)).ask("turned", answer=answer)
    again = Journal(Log(tmp_path, quiet=True)).ask("turned", answer=answer)
    assert np.array_equal(first["array"], x.transpose(2, 1, 0))
    assert first["array"].strides == again["array"].strides and first["tensor"].stride() == again["tensor"].stride()
    assert first["array"].sum((0, 1)).tolist() == again["array"].sum((0, 1)).tolist()


def test_arrays_that_differ_in_one_number_are_other_questions():
    journal, x = Journal(Log(None)), np.zeros(5000)
    y = x.copy()
    y[2500] = 1.0  # where a printed array has dots
    journal.ask("array", x, answer=lambda: 0)
    journal.book.told = [0]  # from the beginning
    assert journal.ask("array", y, answer=lambda: 1) == 1


def pytest_fail():
    raise AssertionError("it was asked before")
