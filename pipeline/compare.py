"""make compare SCENES=carnation,cake [METHODS=...] [OUT=<folder>]: the table of the paper by one command.

    python -m pipeline.compare scenes=... [methods=...] [out=...] [runner=thread|process|dask] [workers=1] [key=value]

Every method of conf/method runs on every scene, as `make sweep` runs them: what they have in common is computed once,
and a second call goes on where the first was stopped. Beside them stand the first picture frozen and, where a motion
was recorded whose cause is known, a deformation field without physics that is fitted to it (`stages/deform.py`). All
are judged by the take that nobody learned from. Of real takes, whose cause nobody knows, there is the table of what is
foretold; METHODS=physics3d is enough for them. What could not be computed stands in the table with the reason.

PROFILE=smoke takes minutes for a scene. `compare_page.py` says what is written. Exit codes as `make sweep`.
"""

import sys
from pathlib import Path

from pipeline.compare_page import FIELD, FILMED, FROZEN, METRICS, WHOLE, Row, write
from pipeline.filed import one_line
from pipeline.flow import Plan, first, plan
from pipeline.places import folder_to_fill
from pipeline.settings import SettingsError, choices
from pipeline.shelf import using
from pipeline.stage import StageError, Step, here, manifest, peek, run
from pipeline.sweep import OWN, Variant, asked, swept
from pipeline.told import Parameter, Table, parameters, scores


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
    usual = output / "comparisons" / "-".join(dict.fromkeys(v.scene for v in variants))
    folder = folder_to_fill({"OUT": own.get("out", "")}, usual)
    states = swept(crew, variants)
    rows: list[Row] = []
    lost: dict[tuple[str, str], str] = {}
    for variant in variants:
        if (state := str(states[variant]["state"])) != "done":
            lost[variant.scene, variant.method] = state
            if variant.method == WHOLE:
                lost[variant.scene, FIELD] = lost[variant.scene, FROZEN] = f"{WHOLE} did not end"
            continue
        for method, make in ((variant.method, of_variant), (FIELD, deformed)):
            try:
                rows += make(variant)
            except StageError as error:
                lost[variant.scene, method] = str(error)
    if not rows:
        raise StageError(f"no method ended on any scene: {next(iter(lost.values()))}")
    write(folder, rows, lost, variants[0].config, words=rest)
    print(f"comparison {folder / 'compare.md'}")
    return 1 if lost else 0


def of_variant(variant: Variant) -> list[Row]:
    """The row of a run; with the whole method also those of what needs no run of its own."""
    from pipeline.moving import read

    whole, steps = planned(variant)
    tables = scores(whole)
    if not tables:
        raise StageError(f"{variant.scene} has no recorded motion to compare with; leave it out of SCENES")
    table, is_whole = tables[0], variant.method == WHOLE
    if table.step == "foretell":
        return [Row(scene=variant.scene, method=n, scores=_numbers(table, n)) for n in table.values if is_whole]
    name = next(n for n in ("learned", "initial") if n in table.values)
    found = Row(
        scene=variant.scene,
        method=variant.method,
        scores=_numbers(table, name),
        seconds=sum(_seconds(step) for step in steps.values() if not step.name.endswith("_initial")),
        learned={p.name: _found(p) for p in parameters(whole) if p.low is not None},
        video=read(steps["render"]).frames[0],
    )
    if not is_whole:
        return [found]
    capture = read(steps["capture"])
    take = capture.take("evaluate") or capture.take("learn")
    camera = (take.held_out_cameras or (0,))[0]
    filmed = Row(scene=variant.scene, method=FILMED, scores={}, video=take.videos[camera])
    still = [Row(scene=variant.scene, method=n, scores=_numbers(table, n)) for n in table.values if "frozen" in n]
    return [filmed, *still, found]


def planned(variant: Variant) -> tuple[Plan, dict[str, Step]]:
    """Plan and steps by name of a variant whose steps are filed, by the configuration that they were computed with."""
    shelf = Path(variant.config["output"]).expanduser().resolve() / "artifacts"
    whole = plan(variant.config, first(variant.config, shelf))
    return whole, {step.name: step for step in whole.steps}


def _numbers(table: Table, row: str) -> dict[str, float]:
    return {k: v for k, v in table.values[row].items() if k in METRICS and v is not None}


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
            scores=_numbers(table, FIELD),
            seconds=sum(map(_seconds, (*needed, motion, video, judged))),
            video=read(video).frames[0],
        )
    ]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
