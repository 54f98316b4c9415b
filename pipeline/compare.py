"""make compare SCENES=carnation,cake [METHODS=...] [OUT=<folder>]: the table of the paper by one command.

    python -m pipeline.compare scenes=... [methods=...] [out=...] [runner=thread|process|dask] [workers=1] [key=value]

Scene by scene every method of conf/method runs, as `make sweep` runs them: what they have in common is computed once,
and a second call goes on where the first was stopped. Beside them stand the first picture frozen and a deformation
field without physics that is fitted to the recorded take (`stages/deform.py`). All are judged by the take that nobody
learned from. The page is written after every scene, so whoever stops has a page of what ended.

Of recorded takes whose cause nobody knows the rows are those of what is foretold (`stages/foretell.py`), means over the
takes: the given material is there, a deformation field is what it would be fitted to, played again, and methods that
cannot be asked are left out with the reason. What was asked and could not be computed stands in the table likewise.

PROFILE=smoke takes minutes for a scene. `compare_page.py` says what is written. Exit codes as `make sweep`.
"""

import math
import sys
from dataclasses import replace
from pathlib import Path

from pipeline.compare_page import FIELD, FILMED, FROZEN, METRICS, WHOLE, Compared, Row, write
from pipeline.filed import one_line
from pipeline.flow import Plan, cause_unknown, first, plan
from pipeline.places import folder_to_fill
from pipeline.server import server
from pipeline.settings import SettingsError, choices
from pipeline.shelf import using
from pipeline.stage import StageError, Step, here, manifest, peek, run
from pipeline.sweep import OWN, Crew, Variant, asked, swept
from pipeline.told import Parameter, Table, models, parameters, scores

GIVEN = "physgaussian"  # the method that learns nothing
# what rows of takes of unknown cause are called in the table of methods; others keep their names
FORETOLD = {
    "modes as seen": WHOLE,
    "material before": GIVEN,
    "frame 0, frozen": FROZEN,
    "what was seen, again": FIELD,
}
BESIDE = (WHOLE, FIELD, FROZEN)  # what a run of the whole method gives rows of


def main(words: list[str]) -> int:
    code: list[int] = []
    left = "finished stages are kept, the same command goes on from there"
    failed = one_line(lambda: code.append(compare(words)), lambda text: print(text, file=sys.stderr), left)
    return failed or code[0]


def compare(words: list[str]) -> int:
    """Run, judge, write. Raises as `filed` and the stages do."""
    own = dict(word.partition("=")[::2] for word in words if word.partition("=")[0] in (*OWN, "out", "scene"))
    rest = [word for word in words if word.partition("=")[0] not in (*OWN, "out", "scene", "method", "seed")]
    scenes = own.get("scenes") or own.get("scene") or ""
    methods = [m.strip() for m in (own.get("methods") or ",".join(choices("method"))).split(",") if m.strip()]
    if WHOLE not in methods:
        raise SettingsError(f"methods is {','.join(methods)}; take {WHOLE} among them, with which the others compare")
    settings = [f"runner={own.get('runner') or 'thread'}", f"workers={own.get('workers') or '1'}", *rest]
    crew, variants = asked([f"scenes={scenes}", f"methods={','.join(methods)}", *settings])
    output = Path(variants[0].config["output"]).expanduser().resolve()
    names = list(dict.fromkeys(v.scene for v in variants))
    folder = folder_to_fill({"OUT": own.get("out", "")}, output / "comparisons" / "-".join(names))
    with using(output / "artifacts"):  # a place that cannot be written is said before a server is waited for
        pass
    found = Compared()
    with server(output / ".prefect", meanwhile=lambda: None, host=crew.host()):  # one for all scenes
        for name in names:
            found.add(of_scene(crew, [v for v in variants if v.scene == name]))
            if found.rows:
                write(folder, found, variants[0].config, words=rest)
    if not found.rows:
        raise StageError(f"no method ended on any scene: {next(iter(found.lost.values()))}")
    print(f"comparison {folder / 'compare.md'}")
    return 1 if found.lost else 0


def of_scene(crew: Crew, variants: list[Variant]) -> Compared:
    """All methods on one scene: first the whole one, which shows what the others can be asked."""
    whole = next(v for v in variants if v.method == WHOLE)
    found = Compared()
    states = tried(crew, [whole])
    if states[whole] != "done":
        found.lost = {(whole.scene, method): f"{WHOLE} did not end" for method in BESIDE}
    others = [v for v in variants if v is not whole]
    if states[whole] == "done" and cause_unknown(peek(planned(whole)[1]["capture"].folder)):
        found.left_out = {(v.scene, v.method): why for v in others if (why := unasked(v, whole))}
        others = []
    states |= tried(crew, others)
    for variant in (whole, *others):
        if states[variant] != "done":
            found.lost[variant.scene, variant.method] = states[variant]
            continue
        for method, make in ((variant.method, of_variant), (FIELD, deformed)):
            try:
                found.rows += make(variant)
            except StageError as error:
                found.lost[variant.scene, method] = str(error)
    return found


def tried(crew: Crew, variants: list[Variant]) -> dict[Variant, str]:
    """Variant -> done, or what went wrong, here or before any of them could begin."""
    try:
        return {variant: str(row["state"]) for variant, row in swept(crew, variants).items()} if variants else {}
    except StageError as error:
        return dict.fromkeys(variants, str(error))


def unasked(variant: Variant, whole: Variant) -> str:
    """Why a method is not asked about takes whose cause nobody knows; nothing of one that learns nothing, whose row is
    in the table of what is foretold."""
    if not variant.config["learn"]:
        return ""
    if variant.config["material"]["model"] != whole.config["material"]["model"]:
        return f"a motion of unknown cause is learned with the material of {WHOLE} alone"
    return "the thing swings in the modes that were seen, whatever is inside"


def of_variant(variant: Variant) -> list[Row]:
    """The row of a run; with the whole method also those of what needs no run of its own."""
    from pipeline.moving import read

    whole, steps = planned(variant)
    tables = scores(whole)
    if not tables:
        raise StageError(f"{variant.scene} has no recorded motion to compare with; leave it out of SCENES")
    table, is_whole = tables[0], variant.method == WHOLE
    name = next((n for n in ("learned", "initial") if n in table.values), "")
    found = Row(
        scene=variant.scene,
        method=variant.method,
        scores=_numbers(table.values[name]) if name else {},
        seconds=sum(_seconds(step) for step in steps.values() if not step.name.endswith("_initial")),
        learned=_learned(variant, whole),
        models=models(whole) if is_whole else [],
    )
    if table.step == "foretell":
        return of_takes(found, table)
    found = replace(found, video=read(steps["render"]).frames[0])
    if not is_whole:
        return [found]
    capture = read(steps["capture"])
    take = capture.take("evaluate") or capture.take("learn")
    camera = (take.held_out_cameras or (0,))[0]
    filmed = Row(scene=variant.scene, method=FILMED, scores={}, video=take.videos[camera], fps=take.fps)
    still = [Row(scene=variant.scene, method=n, scores=_numbers(table.values[n])) for n in table.values if n == FROZEN]
    return [filmed, *still, found]


def of_takes(whole: Row, table: Table) -> list[Row]:
    """Rows of what was foretold of takes of unknown cause, means over the takes; `whole`: what else is known of it."""
    by_name: dict[str, list[dict[str, float]]] = {}
    for key, cells in table.values.items():
        by_name.setdefault(key.partition(": ")[2], []).append(_numbers(cells))
    rows = []
    for name, takes in by_name.items():
        method = FORETOLD.get(name, name)
        known = [m for m in METRICS if all(m in take for take in takes)]
        if means := {m: math.fsum(take[m] for take in takes) / len(takes) for m in known}:
            rows.append(
                replace(whole if method == WHOLE else Row(scene=whole.scene, method=method, scores={}), scores=means)
            )
    return rows


def planned(variant: Variant) -> tuple[Plan, dict[str, Step]]:
    """Plan and steps by name of a variant whose steps are filed, by the configuration that they were computed with."""
    shelf = Path(variant.config["output"]).expanduser().resolve() / "artifacts"
    whole = plan(variant.config, first(variant.config, shelf))
    return whole, {step.name: step for step in whole.steps}


def _numbers(cells: dict[str, float | None]) -> dict[str, float]:
    return {k: v for k, v in cells.items() if k in METRICS and v is not None}


def _learned(variant: Variant, whole: Plan) -> dict[str, str]:
    """Parameter -> what was learned, in words; of those that share one factor the first alone."""
    ties: list[list[str]] = (variant.config["learn"] or {}).get("ties") or []
    follow = {name for tie in ties for name in tie[1:]}
    return {p.name: _found(p) for p in parameters(whole) if p.low is not None and p.name not in follow}


def _found(parameter: Parameter) -> str:
    """What was learned, in words."""
    truth = "" if parameter.truth is None else f"truth {parameter.truth:.3g}, "
    return f"{parameter.learned:.3g} ({truth}{parameter.between})"


def _seconds(step: Step) -> float:
    return float(manifest(step)["seconds"])


def deformed(variant: Variant) -> list[Row]:
    """The row of the deformation field, fitted to the take that the others learned from, beside that of the whole
    method; none where there is no such take, or nobody knows what set it going."""
    from pipeline.moving import read

    config, (_, steps) = variant.config, planned(variant)
    if variant.method != WHOLE or "learn" not in steps or "evaluate" not in steps:
        return []
    device = here(config["device"])
    shared = {"device": config["device"], "seed": config["seed"]}
    fitted = {"_target_": "stages.deform.Deform", "prior": config["learn"]["prior"]}
    fitted |= {"image_scale": config["learn"]["image_scale"], **shared}
    capture, body, shelf = steps["capture"], steps["fill"], steps["capture"].shelf
    gaussians = steps.get("reconstruct") or capture.part("gaussians")
    motion = Step.of("deform", "deform", fitted, (capture, gaussians, body), shelf)
    video = Step.of("render_deformed", "render", config["render"], (capture, gaussians, body, motion), shelf)
    judged = Step.of("evaluate_deformed", "evaluate", config["evaluate"], (capture, {FIELD: video}, {}), shelf)
    with using(shelf):
        for step in (motion, video, judged):
            run(step, device, config["verify"])
    table = Table(step="evaluate", values=peek(judged.folder)["values"])
    needed = [steps[n] for n in ("capture", "reconstruct", "segment", "fill") if n in steps]
    return [
        Row(
            scene=variant.scene,
            method=FIELD,
            scores=_numbers(table.values[FIELD]),
            seconds=sum(map(_seconds, (*needed, motion, video, judged))),
            video=read(video).frames[0],
        )
    ]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
