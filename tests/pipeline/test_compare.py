"""The page that compares methods, its rows, and what its command refuses."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from physics3d.metrics.image import psnr
from physics3d.motion.stills import FIRST, LAST, MEAN
from pipeline.compare import FORETOLD, compare, deformed, main, of_takes, of_variant, unasked
from pipeline.compare_page import FIELD, FILMED, FROZEN, IMAGE, TOLD, WHOLE, Compared, Row, better, overall, ties, write
from pipeline.flow import first, plan
from pipeline.settings import choices
from pipeline.stage import load, run
from pipeline.sweep import Variant, asked
from pipeline.told import Table
from stages import foretell

ROWS = [
    Row(scene="cake", method="filmed", scores={}, video=torch.zeros((9, 12, 16, 3), dtype=torch.uint8), fps=18.0),
    Row(scene="cake", method="frozen first frame", scores={"psnr": 25.0, "flow_error": 1.0}),
    Row(
        scene="cake",
        method="physics3d",
        scores={"psnr": 30.0, "flow_error": 0.25},
        seconds=100.0,
        learned={"youngs_modulus": "1e5 (between 8e4 and 1.2e5)"},
        video=torch.full((9, 12, 16, 3), 200, dtype=torch.uint8),
    ),
    Row(scene="cake", method="without_filling", scores={"psnr": 28.0}, seconds=80.0),
]


def test_every_number_is_on_the_page_and_the_best_is_bold(tmp_path):
    lost = {
        ("hat", "physics3d"): "capture: no photographs",
        ("cake", "physgaussian"): "render: nothing (traceback: /x/y.txt)",
    }
    found = Compared(rows=ROWS, lost=lost, left_out={("cake", "physdreamer"): "of another material"})
    write(tmp_path, found, {"seed": 7, "device": "cpu"}, words=["profile=smoke", "output=/x", "learn.steps=3"])
    text = (tmp_path / "compare.md").read_text()
    cake = text[text.index("## cake") : text.index("## hat")]
    rows = {line.split("|")[1].strip(): line for line in cake.splitlines() if line.startswith("| ")}
    assert "filmed" not in rows, "what was filmed has no score"
    assert "**30**" in rows["physics3d"] and "**0.25**" in rows["physics3d"] and "| 100 |" in rows["physics3d"]
    assert "**" not in rows["frozen first frame"] and "| 25 |" in rows["frozen first frame"]
    assert {line.count("|") for line in rows.values()} == {2 + 3}, "two measures are known of any method"
    named = ["frozen first frame", "without_filling", "physics3d", "physgaussian", "physdreamer"]
    assert list(rows) == ["method", *named]
    assert "| not done: render: nothing |" in rows["physgaussian"]
    assert "| left out: of another material |" in rows["physdreamer"]
    assert "filmed for 0.5 s" in cake, "nine frames at 18 per second"
    assert "| physics3d | not done: capture: no photographs |" in text[text.index("## hat") :]
    assert '`make compare SCENES=cake,hat PROFILE=smoke ARGS="learn.steps=3"`, seed 7' in text
    assert "- physics3d learned youngs_modulus 1e5 (between 8e4 and 1.2e5)" in text
    assert "14.72" in text[text.index("## What others have published") :]
    table = list(csv.DictReader((tmp_path / "compare.csv").open()))
    assert [float(row["psnr"] or math.nan) for row in table[1:]] == [25.0, 30.0, 28.0]
    # a line of six pictures for what was filmed, and one for the method that has a video
    with Image.open(tmp_path / "compare_cake.jpg") as picture:
        assert picture.width > 2 * picture.height
    assert (tmp_path / "compare.png").stat().st_size > 1000


def test_means_are_of_the_scenes_on_which_every_method_ended():
    """Of cake and hat one mean, 25; of the cup, where one failed, none: the other's 40 would count for it alone."""
    psnr = {("cake", "a"): 20.0, ("cake", "b"): 22.0, ("hat", "a"): 30.0, ("hat", "b"): 26.0, ("cup", "a"): 40.0}
    names = {"a": "physgaussian", "b": "physics3d"}
    rows = [Row(scene=scene, method=names[m], scores={"psnr": value}) for (scene, m), value in psnr.items()]
    rows.append(Row(scene="cup", method="image modes", scores={"psnr": 41.0}))  # of real takes alone
    lost = {("cup", "physics3d"): "learn: nothing"}
    table = overall(Compared(rows=rows, lost=lost, left_out={("cup", "physdreamer"): "of another material"}))
    assert "2 of 3 scenes" in table[0]
    assert "| physgaussian | 20 | **30** | 40 | **25** |" in table
    assert "| physics3d | **22** | 26 | not done | 24 |" in table
    assert "| image modes |  |  | **41** |  |" in table
    assert "| physdreamer |  |  | - |  |" in table


SMALL = (
    "profile=smoke", "device=cpu", "learn.search=0", "learn.polish=0", "learn.steps=0", "learn.image_scale=0.5",
    "scene.source.frames=6", "simulate.frames=6", "learn.frames=6",
)  # fmt: skip
USUAL = ("capture", "reconstruct", "fill", "learn", "simulate", "render", "evaluate")


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Variant:
    """The ball by the whole method, every step filed, as a run leaves it."""
    words = [*SMALL, f"output={tmp_path_factory.mktemp('ball')}"]
    _, (variant,) = asked(["scenes=ball", "methods=physics3d", "runner=thread", *words])
    capture = first(variant.config, Path(variant.config["output"]) / "artifacts")
    run(capture, "cpu")
    for step in plan(variant.config, capture).steps:
        run(step, "cpu")
    return variant


def test_rows_are_what_the_steps_of_a_run_filed(ball):
    filmed, still, whole = of_variant(ball)
    assert (filmed.method, still.method, whole.method) == (FILMED, FROZEN, "physics3d")
    # by definition: the error of the flow in units of the motion, of a picture that does not move
    assert still.scores["flow_error"] == pytest.approx(1.0, abs=1e-6) and still.seconds is None
    assert whole.scores["psnr"] > still.scores["psnr"] and whole.seconds > 0
    assert filmed.video.shape == whole.video.shape


def test_the_deformation_field_is_fitted_once_and_plays_what_it_has_seen(ball):
    """It knows the clip that was learned from: it draws that one better than the one of another force."""
    (row,), (again,) = deformed(ball), deformed(ball)
    shelf = Path(ball.config["output"]) / "artifacts"
    assert row.method == FIELD and again.seconds == row.seconds and torch.equal(again.video, row.video)
    assert len(list((shelf / "deform").glob("[!.]*"))) == 1
    capture = load(first(ball.config, shelf), "cpu")
    assert set(row.scores) == set(of_variant(ball)[-1].scores)
    seen, unseen = (capture.take(role).videos[0][: len(row.video)] for role in ("learn", "evaluate"))
    assert psnr(row.video, seen) > psnr(row.video, unseen)


def test_a_scene_that_fails_costs_the_others_nothing_and_what_is_filed_stays(ball, tmp_path, prefect):
    """Photographs that are not there, beside the ball, of which everything is filed but its deformation field."""
    shelf = Path(ball.config["output"]) / "artifacts"
    filed = lambda: {p: p.stat().st_mtime_ns for p in shelf.glob("*/[!.]*/manifest.json") if p.parts[-3] in USUAL}
    before = filed()
    words = [*SMALL, f"output={ball.config['output']}", f"data={tmp_path / 'nowhere'}", f"out={tmp_path}"]
    assert compare(["scenes=photos,ball", "methods=physics3d", *words]) == 1
    assert filed() == before and len(before) >= len(USUAL)
    text = (tmp_path / "compare.md").read_text()
    assert "| physics3d | not done: capture:" in text and "nowhere" in text
    rows = list(csv.DictReader((tmp_path / "compare.csv").open()))
    assert {row["method"] for row in rows if row["scene"] == "ball"} == {FILMED, FROZEN, FIELD, "physics3d"}
    assert not [row for row in rows if row["scene"] == "photos"]


def test_rows_of_takes_of_unknown_cause_are_means_over_the_takes():
    """The modes that were seen are the whole method's, the material before learning is the given one's."""
    cells = lambda psnr, flow: {"psnr": psnr, "flow_error": flow, "frequency": 2.0}
    told = {"modes as seen": (30.0, 0.2), "material before": (20.0, 1.1), "frame 0, frozen": (22.0, 1.0)}
    told |= {"what was seen, again": (18.0, 1.4), IMAGE: (29.0, 0.5)}
    takes = (("a", 0.0), ("b", 4.0))
    table = {f"{take}: {name}": cells(psnr + more, flow) for take, more in takes for name, (psnr, flow) in told.items()}
    table["a: modes as seen"]["flow_error"] = None  # unknown of one take: of all there is no mean
    table |= {f"{take}: reference": {"psnr": None, "frequency": 2.0} for take in "ab"}
    whole = Row(scene="real", method=WHOLE, scores={}, seconds=5.0)
    rows = {row.method: row for row in of_takes(whole, Table(step="foretell", values=table))}
    assert set(rows) == {WHOLE, "physgaussian", FROZEN, FIELD, IMAGE}
    assert rows[WHOLE].scores == {"psnr": 32.0} and rows[WHOLE].seconds == 5.0
    assert rows["physgaussian"].scores == {"psnr": 22.0, "flow_error": pytest.approx(1.1)}


def test_methods_that_takes_of_unknown_cause_cannot_tell_apart_are_left_out_with_a_word():
    _, variants = asked(["scenes=carnation_real", f"methods={','.join(choices('method'))}", "data=x"])
    whole = next(v for v in variants if v.method == WHOLE)
    why = {v.method: unasked(v, whole) for v in variants if v is not whole}
    assert why.pop("physgaussian") == "", "it learns nothing, and has a row"
    assert {method for method, said in why.items() if "material" not in said} == {"without_filling"}
    assert all(why.values())


def test_what_is_foretold_has_the_names_that_the_table_knows():
    assert set(FORETOLD) == {foretell.SEEN, foretell.START, foretell.AGAIN, FIRST}
    assert set(TOLD) - {FROZEN, FIELD} == {foretell.IMAGE, foretell.LEARNED, LAST, MEAN}


def clips(off: dict[str, float], frames: int = 61) -> dict[str, torch.Tensor]:
    """A grey clip, and others that are off by so many grey levels, up and down from pixel to pixel, and by noise."""
    generator = torch.Generator().manual_seed(0)
    board = (torch.arange(12)[:, None] + torch.arange(16)) % 2 * 2.0 - 1
    noise = lambda: 4 * torch.randn((frames, 1, 1, 1), generator=generator).abs()
    made = {name: (128 + (by + noise()) * board[None, :, :, None]).expand(-1, -1, -1, 3) for name, by in off.items()}
    filmed = torch.full((frames, 12, 16, 3), 128, dtype=torch.uint8)
    return {FILMED: filmed} | {name: clip.round().to(torch.uint8) for name, clip in made.items()}


def test_a_difference_of_psnr_is_told_from_noise():
    """Off by 10 and by 20 grey levels: 6 dB, less what the noise adds to both."""
    made = clips({"ten": 10, "twenty": 20})
    gain, low, high = better(made[FILMED], made["ten"], made["twenty"])
    assert 3 < low < gain < high < 6.1
    back = better(made[FILMED], made["twenty"], made["ten"])
    assert back == pytest.approx((-gain, -high, -low))


def test_intervals_of_differences_hold():
    """Nine in ten of them, of 200 noises; with frames that err alike, in threes, as well. 77 %: six stretches are few,
    and 200 noises leave 2 % of their own."""
    for alike in (1, 3):
        held = 0
        for seed in range(200):
            generator = torch.Generator().manual_seed(seed)
            size = 20 * 10 ** (0.1 * torch.randn((60 // alike, 2), generator=generator)).repeat_interleave(alike, 0)
            filmed = torch.full((61, 1, 2, 3), 128, dtype=torch.uint8)
            off = torch.cat([torch.zeros(1, 2), size])
            one, other = (
                (128 + off[:61, i].round())[:, None, None, None].expand(-1, 1, 2, 3).to(torch.uint8) for i in (0, 1)
            )
            _, low, high = better(filmed, one, other, seed=seed)
            held += low <= 0 <= high
        assert 0.77 <= held / 200 <= 0.97, (alike, held)


def test_ties_are_called_ties_and_say_what_would_settle_them():
    made = clips({"full": 10, "elastic": 10, "shell": 40})
    made["elastic"] = torch.where(torch.arange(61)[:, None, None, None] % 2 == 0, made["full"].flip(2), made["elastic"])
    rows = [Row(scene="cake", method=FILMED, scores={}, video=made[FILMED])]
    rows += [
        Row(scene="cake", method=name, scores={"psnr": psnr}, video=made[name])
        for name, psnr in (("shell", 20.0), ("full", 30.0), ("elastic", 29.9))
    ]
    rows[2] = replace(rows[2], models=["to film next: a weight: should settle it (ln B +4.0)"])
    text = ties(rows)
    assert text[3:] == ["- full itself says: to film next: a weight: should settle it (ln B +4.0)"]
    assert "above elastic" in text[0] and text[0].endswith("a tie")
    assert "above shell" in text[1] and "tie" not in text[1]
    assert "does not tell full, elastic apart" in text[2] and "second force" in text[2]
    assert ties(rows[:2]) == []


@pytest.mark.parametrize(
    "words, message",
    [
        (["scenes=carnation", "methods=physgaussian"], "take physics3d among them"),
        (["scenes=carnation", "methods=physics3d,nothing"], "no method 'nothing'"),
        (["scenes="], "scenes is empty"),
        (["scenes=carnation", "runner=train"], "runner is 'train'"),
    ],
)
def test_what_cannot_be_compared_is_one_line(words, message, capsys):
    assert main(words) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1
