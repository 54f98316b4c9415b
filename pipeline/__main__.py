"""Command line: python -m pipeline scene=carnation profile=smoke learn.steps=50

Composes the configuration, says "up to date" if everything has been filed, else runs the flow under Prefect, records
it in MLflow, and prints what came out. Nothing heavy is imported before it is needed. Exit codes: 0 done, 1 a stage
failed, 2 the command line is wrong, 130 interrupted by Ctrl-C or SIGTERM.
"""

import io
import logging
import os
import shutil
import signal
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

from pipeline.fingerprint import installed
from pipeline.flow import execute, up_to_date
from pipeline.hired import end_within
from pipeline.report import report
from pipeline.settings import CONF, GROUPS, SettingsError, choices, compose, described
from pipeline.shelf import using
from pipeline.stage import Filed, StageError, Step, here
from pipeline.tracking import Tracking, address, git_commit, mend
from pipeline.words import literal_paths

USAGE = """\
python -m pipeline [group=name ...] [key=value ...]      e.g. python -m pipeline scene=carnation profile=smoke

Runs the pipeline on a scene; what has been computed before is reused. Keys are those of conf/config.yaml:
    learn.steps=50              any number of any stage
    data=<folder>               where data sets lie
    output=<folder>             where artifacts/, mlflow.db and mlartifacts/ go
    device=auto|cpu|cuda        seed=0
    verify=true                 check stored results by content, not only by size
    use.learn=<fingerprint>     take that result in place of the stage
    --help  --config            this text; the configuration as composed, without running
"""


LEAST_SPACE = 10_000_000  # what Prefect and MLflow need for their databases [byte]
LEAST_TEMPORARY = 1_000_000  # what they need besides, for a while [byte]


def main(words: list[str]) -> int:
    started = time.monotonic()
    if "--help" in words or "-h" in words:
        print(usage())
        return 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that this terminal cannot show must not end a run
            stream.reconfigure(errors="backslashreplace")
    try:
        config, picked = compose(literal_paths([w for w in words if w != "--config"]))
        if "--config" in words:
            show(config)
            return 0
        return run(config, picked, words, started)
    except SettingsError as error:
        return _fail(str(error), 2)
    except StageError as error:
        return _fail(str(error), 1)
    except KeyboardInterrupt:
        for name in (signal.SIGINT, signal.SIGTERM):  # once is enough; a second one ends what libraries do at the end
            signal.signal(name, signal.SIG_DFL)
        print("\ninterrupted; finished stages are kept, the same command goes on from there", file=sys.stderr)
        end_within(130)
        return 130
    except Exception as error:
        if os.environ.get("PHYSICS3D_TRACEBACK"):
            raise
        text = " ".join(str(error).split()) or type(error).__name__
        return _fail(f"{text} (PHYSICS3D_TRACEBACK=1 shows where)", 1)


def run(config: dict[str, Any], picked: dict[str, str], words: list[str], started: float) -> int:
    output = Path(config["output"]).expanduser().resolve()
    shelf = output / "artifacts"
    verify = config["verify"]
    mend(output)
    plan = up_to_date(config, shelf, verify)
    if plan is not None:
        report(plan, {step.name: True for step in plan.steps})
        print(f"up to date: all {len(plan.steps)} steps were computed before ({time.monotonic() - started:.1f} s)")
        return 0

    with using(shelf):  # a place that cannot be written is said before anything is imported
        pass
    if _free(output) < LEAST_SPACE:  # the server would wait for its database, rather than end
        raise StageError(_full(output))
    temporary = Path(tempfile.gettempdir())
    if _free(temporary) < LEAST_TEMPORARY:
        free = f"{_free(temporary) / 1e6:.1f} MB are free in {temporary}"
        raise StageError(f"the disk is full ({free}); set TMPDIR=<folder>")
    _kernels(output)
    quiet()
    hits: dict[str, bool] = {}
    tracking: Tracking | None = None
    name, tags = title(picked, config, words)
    status, scores = "FAILED", {}

    def begin(step: Step) -> None:
        if tracking is not None:
            tracking.begin(step)

    def done(filed: Filed) -> None:
        nonlocal tracking
        tracking = tracking or Tracking(output, config=config, name=name, tags=tags)
        tracking.stage(filed)
        hits[filed.step.name] = filed.hit

    try:
        with using(shelf):
            plan, _ = execute(config, shelf, output / ".prefect", device(config["device"]), verify, begin, done)
        scores = report(plan, hits)
        status = "FINISHED"
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    except Exception as error:
        if isinstance(error, StageError) or _free(output) > 1 << 20:
            raise
        raise StageError(_full(output)) from error  # the server, or a library, says anything but that
    finally:
        if tracking is not None:
            tracking.close(scores=scores, status=status)
    if tracking is not None and not tracking.broken:
        print(f"all runs  make ui, or {address(output)}")
    print(f"done in {time.monotonic() - started:.0f} s")
    return 0


def title(picked: dict[str, str], config: dict[str, Any], words: list[str]) -> tuple[str, dict[str, str]]:
    """What a run is called where runs are compared, and its tags: scene, method and profile, and what else was said."""
    named = ("scene", "method", "profile")
    said = " ".join(word for word in words if word.partition("=")[0] not in (*named, "data", "output", "seed"))
    name = " ".join([*(picked[group] for group in named), f"seed {config['seed']}", said]).strip()
    tags = {**picked, "seed": str(config["seed"]), "said": said, "git": git_commit(CONF.parent)}
    return name[:200], tags


def device(asked: str) -> str:
    """auto -> cuda if there is one, else cpu. Raises SettingsError for what is no device of this machine."""
    import torch

    there = ["auto", "cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    there += [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    if asked not in there:
        raise SettingsError(f"device={asked}: not available here; there are {', '.join(there)}")
    return here(asked)


def usage() -> str:
    lines = [USAGE]
    for group in GROUPS:
        lines.append(f"{group}=")
        lines += [f"    {name:<24}{described(CONF / group / f'{name}.yaml')}" for name in choices(group)]
    return "\n".join(lines)


def show(config: dict[str, Any]) -> None:
    from omegaconf import OmegaConf

    print(OmegaConf.to_yaml(config))


def _kernels(output: Path) -> None:
    """Keep compiled kernels below the output folder where the usual place may not be written.

    Raises StageError if a place was chosen that may not.
    """
    chosen = os.environ.get("WARP_CACHE_PATH")
    usual = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "warp"
    folder = Path(chosen or usual).expanduser() / (installed("warp") or "")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return
    except OSError as error:
        if chosen:
            reason = f"compiled kernels cannot be kept in {chosen} ({error.strerror})"
            raise StageError(f"{reason}; set WARP_CACHE_PATH to a folder that can be written, or unset it") from error
    os.environ["WARP_CACHE_PATH"] = str(output / ".warp")


def _free(output: Path) -> int:
    """Space on the disk of a folder [byte]."""
    return shutil.disk_usage(output).free


def _full(output: Path) -> str:
    free = f"{_free(output) / 1e6:.1f} MB are free in {output}"
    return f"the disk is full ({free}); free some space or write elsewhere with output=<folder>"


def quiet() -> None:
    """Libraries talk to themselves; the person watching reads our lines."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    warnings.filterwarnings("ignore", category=FutureWarning)
    for name in ("prefect", "httpx", "alembic", "mlflow", "matplotlib"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _fail(text: str, code: int) -> int:
    print(f"error: {text}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
