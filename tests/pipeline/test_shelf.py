"""What may be removed is removed and said; what a run refers to, is pinned or in use stays."""

from pathlib import Path

import pytest
from test_stage import chain

from pipeline.shelf import clean, collect, pin, unpin, using
from pipeline.stage import StageError, Step, damage, run
from pipeline.tracking import Tracking


@pytest.fixture
def shelf(tmp_path, monkeypatch) -> dict[str, Step]:
    """Four results on the shelf of the folder one stands in."""
    monkeypatch.chdir(tmp_path)
    steps = {step.name: step for step in chain(tmp_path)}
    for step in steps.values():
        run(step, "cpu")
    return steps


def there(steps: dict[str, Step]) -> str:
    return "".join(name for name, step in steps.items() if not damage(step))


def recorded(folder: Path, steps: list[Step]) -> Tracking:
    made = Tracking(folder, config={}, name="x", tags={})
    for step in steps:
        made.stage(run(step, "cpu"))
    made.close(scores={}, status="FINISHED")
    assert not made.broken
    return made


def test_results_that_no_run_refers_to_are_collected(folder, shelf, capsys):
    kept, deleted = recorded(folder, [shelf["a"], shelf["b"]]), recorded(folder, [shelf["b"], shelf["c"]])
    unfinished = folder / "artifacts" / "d" / ".0123"
    unfinished.mkdir()
    kept.client.delete_run(deleted.run)  # MLflow leaves its nested runs as they are
    collect(folder)
    assert there(shelf) == "ab" and not unfinished.exists()
    said = capsys.readouterr().out
    assert all(str(shelf[name].folder.relative_to(folder)) in said for name in "cd") and "2 are kept" in said
    kept.client.restore_run(deleted.run)
    assert run(shelf["c"], "cpu").hit is False, "it is computed again when it is needed"


def test_a_pinned_result_outlives_both_until_it_is_unpinned(folder, shelf, capsys):
    recorded(folder, [])
    pin(folder / "artifacts", f"c/{shelf['c'].fingerprint[:5]}")
    pin(folder / "artifacts", str(shelf["d"].folder))  # as `make run` prints it
    collect(folder)
    assert there(shelf) == "cd"
    capsys.readouterr()
    clean([Path("artifacts"), Path("mlflow.db"), Path("nowhere")], Path("artifacts"))
    said = capsys.readouterr().out
    assert there(shelf) == "cd" and not Path("mlflow.db").exists()
    assert said.count("stays") == 2 and "mlflow.db" in said and "nowhere" not in said
    unpin(folder / "artifacts", "c/")
    unpin(folder / "artifacts", f"d/{shelf['d'].fingerprint}")
    clean([Path("artifacts")], Path("artifacts"))
    assert not Path("artifacts").exists()


def test_the_size_is_said_before_anything_goes(shelf, capsys):
    Path("caches").mkdir()
    Path("caches/a").write_bytes(bytes(1_500_000))
    Path("caches/link").symlink_to("/usr")
    clean([Path("caches")], Path("artifacts"))
    assert capsys.readouterr().out.splitlines()[0].split() == ["2", "MB", "caches"]
    assert there(shelf) == "abcd"


@pytest.mark.parametrize("remove", [lambda f: collect(f), lambda f: clean([Path("artifacts")], Path("artifacts"))])
def test_nothing_is_removed_while_somebody_runs(folder, shelf, remove):
    recorded(folder, [])
    refused = pytest.raises(StageError, match=r"a run is under way in .*artifacts; wait for its end")
    with using(folder / "artifacts"), using(folder / "artifacts"), refused:  # two runs may be at work
        remove(folder)
    assert there(shelf) == "abcd"


def test_mistakes_are_one_line(folder, shelf):
    (folder / "mlflow.db").unlink()
    with pytest.raises(StageError, match=r"no record of runs in .*mlflow\.db, .*; make clean removes all"):
        collect(folder)
    with pytest.raises(
        StageError, match=r"RESULT=b/xyz is none of those in .*; take RESULT=<stage/fingerprint> of: a/"
    ):
        pin(folder / "artifacts", "b/xyz")
    with pytest.raises(StageError, match=r"RESULT= is none of"):
        pin(folder / "artifacts", "")
    assert there(shelf) == "abcd"
