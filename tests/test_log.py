"""What a log keeps, and what it says where nobody watches a screen."""

import json
import re
import sys

import numpy as np
import pytest

import physics3d.log
from physics3d.log import Log


def test_a_silent_log_keeps_and_prints_nothing(capfd):
    log = Log(None)
    log.info("x")
    log.metric("a", 1.0)
    log.image("p", np.zeros((4, 4, 3)))
    assert list(log.progress([1, 2], "what")) == [1, 2]
    assert capfd.readouterr() == ("", "")
    with pytest.raises(ValueError, match="no folder"):
        log.path("file")


def test_numbers_lines_and_pictures_are_kept(tmp_path):
    log = Log(tmp_path, name="learn", quiet=True)
    log.info("hello")
    log.metric("loss", 0.5, 3)
    log.image("frame", np.full((4, 6), 0.5), 2)
    assert "hello" in (tmp_path / "log.txt").read_text()
    assert json.loads((tmp_path / "metrics.jsonl").read_text()) == {"name": "loss", "value": 0.5, "step": 3}
    assert (tmp_path / "previews" / "frame_00002.png").stat().st_size > 0


def test_what_was_said_is_kept_but_not_printed_again(tmp_path, capfd):
    """By one step or by two that share what was said; a word more is another line."""
    said: set[str] = set()
    learn, simulate = (Log(tmp_path / name, name=name, said=said) for name in ("learn", "simulate"))
    learn.warn("the stem is thin")
    learn.warn("the stem is thin")
    simulate.warn("the stem is thin")
    simulate.warn("the stem is thin, and long")
    printed = [line.strip() for line in capfd.readouterr().out.splitlines()]
    assert printed == ["learn | warning: the stem is thin", "simulate | warning: the stem is thin, and long"]
    assert [(tmp_path / name / "log.txt").read_text().count("is thin") for name in ("learn", "simulate")] == [2, 2]


def test_progress_without_a_screen_is_a_few_whole_lines(tmp_path, capfd, monkeypatch):
    """Even if every step sets a postfix, which makes a bar draw itself anew."""
    bar = Log(tmp_path, name="learn").progress(range(50), "steps")
    for i in bar:
        bar.set_postfix(loss=i)
        if i == 20:
            monkeypatch.setattr(physics3d.log, "LINES_EVERY", 0.0)
        elif i == 21:
            monkeypatch.setattr(physics3d.log, "LINES_EVERY", 1e9)
    sys.stderr.flush()
    _, err = capfd.readouterr()
    lines = err.splitlines()
    assert "\r" not in err and 1 <= len(lines) <= 3
    assert all(re.fullmatch(r" +learn \| steps: \d+/50 \[.*, loss=\d+\]", line) for line in lines)
