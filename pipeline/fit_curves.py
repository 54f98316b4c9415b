"""A material from tables of a test machine: make fit-curves DATA=folder MATERIAL=name [UNSEEN=test,test] [OUT=folder].

Every csv in DATA is a test (docs/laboratory.md); MATERIAL is one of conf/material and says which model, which
parameters are fitted (learn, ties) and what the others are (start). Tests that UNSEEN names are predicted only.
material.yaml, fit.md, tables and a picture in OUT, or in a folder beside DATA. Exit codes: 0 done, 1 the tables cannot
be fitted, 2 DATA or MATERIAL is not given or means nothing, 130 Ctrl-C.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.filed import one_line
from pipeline.places import folder_to_fill, place
from pipeline.settings import CONF, SettingsError, choices

USAGE = "make fit-curves DATA=<folder of csv> MATERIAL=<name in conf/material> [UNSEEN=<test,test>] [OUT=<folder>]"


def main(environment: Mapping[str, str]) -> int:
    return one_line(lambda: fitted(environment), lambda text: print(text, file=sys.stderr), "there is no fit.md")


def fitted(environment: Mapping[str, str]) -> None:
    """Raises SettingsError for what is not given, or no material, else as `fit_curves`."""
    folder, material = place(environment, "DATA"), environment.get("MATERIAL", "")
    if folder is None or not material:
        raise SettingsError(f"{'DATA' if folder is None else 'MATERIAL'} is not given; {USAGE}")
    if material not in materials():
        raise SettingsError(f"MATERIAL is {material!r}; take one of {', '.join(materials())}")
    whole = folder.resolve()
    out = folder_to_fill(environment, whole.parent / f"{whole.name}_{material}")
    unseen = tuple(name.strip() for name in environment.get("UNSEEN", "").split(",") if name.strip())
    fit_curves(folder, material, unseen, out)


def materials() -> list[str]:
    """Those of conf/material that one specimen can be of."""
    return [choice for choice in choices("material") if choice != "parts"]


def fit_curves(folder: Path, name: str, unseen: tuple[str, ...], out: Path) -> None:
    """Raises ValueError in one line if a table cannot be used by the material, or no test is left to fit."""
    import numpy as np

    from physics3d.laboratory import page
    from physics3d.laboratory.fit import fit
    from physics3d.laboratory.prediction import predict
    from physics3d.laboratory.tables import read_folder
    from physics3d.log import Log

    material, field, config = configured(name)
    tests = read_folder(folder)
    names = [test.name for test in tests]
    for wanted in unseen:
        if wanted not in names:
            raise ValueError(f"UNSEEN names {wanted!r}; the tests are {', '.join(names)}")
    seen = [test for test in tests if test.name not in unseen]
    if not seen:
        raise ValueError(f"UNSEEN names every test ({', '.join(names)}); leave one to be fitted")

    log = Log(out, name="fit-curves")
    log.path("fit.md").unlink(missing_ok=True)  # it is written last: whoever finds it finds everything
    log.info(f"{len(seen)} tests, {sum(len(t.time) for t in seen)} rows; parameters {', '.join(field.names)}")
    fits = fit(material, field, seen, log=log)
    before = predict(material, field, np.zeros(len(field.names)), tests)
    after = predict(material, field, fits.best.theta, tests)
    correlations = dict(zip((test.name for test in seen), fits.best.interval.correlation))
    rows = [
        page.row(test, now, start, correlations.get(test.name), fitted=test.name not in unseen)
        for test, now, start in zip(tests, after, before)
    ]
    done = page.write(name, config, fits, rows, log=log)
    for parameter in fits.best.intervals:
        log.info(f"{parameter} {fits.best.values[parameter]:.4g}   {page.said_of(fits.best, parameter)}")
    for row in rows:
        log.info(f"{'fitted' if row.fitted else 'unseen'} {row.test.name}: error {100 * row.error:.3g} %")
    for other in fits.others:
        values = ", ".join(f"{key} {other.values[key]:.4g}" for key in other.intervals)
        log.warn(f"two valleys: {values} explain the tests as well; a test that both answer otherwise would settle it")
    log.info(f"written {done}, material.yaml and previews/curves.png")


def configured(name: str) -> tuple[Any, Any, dict[str, Any]]:
    """(material, its GlobalField, what conf/material says) of one of `materials`."""
    import torch
    from omegaconf import OmegaConf

    from physics3d.learning.fields import GlobalField
    from pipeline.stage import build

    config: Any = OmegaConf.to_container(OmegaConf.load(CONF / "material" / f"{name}.yaml"))
    field = GlobalField(
        start={key: torch.tensor(value, dtype=torch.float64) for key, value in config["start"].items()},
        learn=tuple(config["learn"]),
        ties=tuple(tuple(tie) for tie in config["ties"]),
    )
    return build(config["model"], "cpu", "material.model"), field, config


if __name__ == "__main__":
    sys.exit(main(os.environ))
