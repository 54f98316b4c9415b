"""make report: one file that needs no network, shows in a browser, and says what the tables of the run say."""

import html
import os
import re
from html.parser import HTMLParser
from urllib.parse import unquote

import numpy as np
import pytest
from moved import foretold_configuration, moved_configuration, run_all
from PIL import Image
from report_picture import chromium, shot

from pipeline import filed, shelf_page, web
from pipeline.stage import peek

CHROMIUM = chromium()


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    config = moved_configuration(tmp_path_factory.mktemp("run"))
    return config, run_all(config)


@pytest.fixture
def report(scene, monkeypatch, capsys):
    for module in (filed, shelf_page):
        monkeypatch.setattr(module, "compose", lambda words: (scene[0], {}))

    def call(*words, **environment):
        code = web.main(list(words), {name: str(value) for name, value in environment.items()})
        told = capsys.readouterr()
        return code, told.out, told.err

    return call


class Page(HTMLParser):
    """Words that a person reads, and what the file asks the browser to fetch."""

    def __init__(self, text: str):
        super().__init__()
        self.words: list[str] = []
        self.fetched: list[str] = []
        self.tags: list[str] = []
        self.inside = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.inside = tag
        self.fetched += [v for name, v in attrs if name in ("src", "href", "srcset", "data", "poster") and v]

    def handle_data(self, data):
        if self.inside not in ("script", "style"):
            self.words.append(data.strip())


@pytest.mark.parametrize("words", [["scene=toy"], []], ids=["a scene", "all scenes"])
def test_a_page_needs_nothing_but_itself(report, tmp_path, words):
    out = tmp_path / "new" / "a page.html"
    code, said, wrong = report(*words, OUT=out)
    assert (code, wrong) == (0, "") and str(out) in said
    text = out.read_text()
    page = Page(text)
    assert page.fetched and all(address.startswith("data:image/jpeg;base64,") for address in page.fetched)
    assert not re.search(r"https?://|@import|url\(|fetch\(|XMLHttpRequest|import\(", text)
    assert os.listdir(out.parent) == ["a page.html"]
    assert "it's <a> body" in page.words  # a name is text, not markup


def test_the_page_of_a_scene_says_what_the_run_says(report, scene, tmp_path):
    assert report("scene=toy", OUT=tmp_path / "a.html")[0] == 0
    page = Page((tmp_path / "a.html").read_text())
    words = " ".join(page.words)
    steps = scene[1]
    for row, cells in peek(steps["evaluate"].folder)["values"].items():
        assert row in page.words and f"{cells['psnr']:.4g}" in page.words
    for wanted in ("youngs_modulus", "1.5", "-25 %", "vmaf: too small", "log of segment", "Configuration and versions"):
        assert wanted in words, wanted
    for name in steps:
        assert name in page.words
    # two films of five frames and the recorded one; the replay; a slider above and one below
    assert page.tags.count("canvas") == 4 and page.tags.count("input") == 2


def test_every_take_that_was_foretold_has_its_table_and_pictures(tmp_path, monkeypatch):
    """On the page of the run, and as a page of its own in the folder of the stage, whose links all lead somewhere."""
    config = foretold_configuration(tmp_path)
    folder = run_all(config)["foretell"].folder
    for module in (filed, shelf_page):
        monkeypatch.setattr(module, "compose", lambda words: (config, {}))
    assert web.main(["scene=toy"], {"OUT": str(tmp_path / "a.html")}) == 0
    text = (tmp_path / "a.html").read_text()
    page = Page(text)
    for k, take in enumerate(("a: poke", "<b>")):
        (at,) = (i for i, word in enumerate(page.words) if word == take)
        assert page.words[at:].index(f"{10.125 + k:.4g}") < 20 and "recorded and foretold, " + take in page.words
        assert len(re.findall(f'alt="{html.escape(take)}: ', text)) == 3
        own = (folder / f"{take}.md").read_text()
        links = [unquote(link) for link in re.findall(r"\]\(([^)]*)\)", own)]
        assert len(links) == 4 and all((folder / link).is_file() for link in links)
        assert "15 of 30 frames at 1 fps were seen" in own and f"{10.125 + k:.4g}" in own
    assert "frequency: nothing swings" in page.words


def test_the_page_of_all_runs_has_every_run_once(report, scene, tmp_path):
    assert report(OUT=tmp_path / "a.html")[0] == 0
    page = Page((tmp_path / "a.html").read_text())
    words = " ".join(page.words)
    assert "1 run on" in words and page.words.count("learned") == 1
    assert "learned: youngs modulus 1.5" in words and "Simulation: error against run time" in words


def test_a_page_of_our_choice_is_renewed_and_one_of_yours_is_kept(report, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        code, _, _ = report("scene=toy")
        assert code == 0
    (made,) = (tmp_path / "exports").iterdir()
    code, _, wrong = report("scene=toy", OUT=made)
    assert code == 1 and "is there already" in wrong and wrong.count("\n") == 1


def test_no_run_is_one_line(report, scene, tmp_path, monkeypatch):
    for module in (filed, shelf_page):
        monkeypatch.setattr(module, "compose", lambda words: (scene[0] | {"output": str(tmp_path)}, {}))
    for words in (["scene=toy"], []):
        code, _, wrong = report(*words, OUT=tmp_path / "a.html")
        assert code == 1 and "make run SCENE=" in wrong and wrong.count("\n") == 1
    assert not (tmp_path / "a.html").exists()


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium; on Debian: apt install chromium")
def test_a_browser_shows_the_films_and_the_gaussians(report, tmp_path):
    assert report("scene=toy", OUT=tmp_path / "a.html")[0] == 0
    shot(str(CHROMIUM), tmp_path / "a.html", tmp_path / "a.png", width=1200, height=1000)
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"), float)
    # colours (the body is coloured, text and page are grey) in the row of films, and below it in the replay
    colour = picture.max(2) - picture.min(2) > 25
    rows = np.flatnonzero(colour[:, :720].sum(1) > 20)
    assert rows.min() < 420 < 600 < rows.max()
