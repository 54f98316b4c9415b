"""What a fit leaves behind: a material for `conf/material`, the numbers as csv, a page and a picture.

material.yaml     the material, its 90 % intervals as comments      intervals.csv, errors.csv    the same numbers, for
programs fit.md            for people; written last, so that who finds it finds everything
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from physics3d.laboratory.fit import Fit, Fits, relative_error
from physics3d.laboratory.prediction import Prediction
from physics3d.laboratory.tables import LabTest
from physics3d.log import Log

CORRELATED = (
    "Intervals are of 90 %. Residuals along a curve are correlated, a row does not count as one measurement: each "
    "curve's are taken for an AR(1) process (sandwich estimate, `physics3d/laboratory/interval.py`). What the machine "
    "prescribed is taken as exact, as are the size of the specimen and parameters that are not fitted."
)

ERRORS = (
    "Errors are root mean squares of the residual over that of what was measured (stress; stretch - 1 or shear where "
    "stress was controlled). Correlation is that of the residual from one row to the next: near 1 the material cannot "
    "follow the curve, near 0 what is left is noise."
)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One test, and how far the material is from it, before and after; relative to the root mean square of the test."""

    test: LabTest
    fitted: bool  # else held out
    prediction: Prediction
    error: float
    largest: float
    at_start: float
    correlation: float | None  # of the residual, from row to row


def row(test: LabTest, prediction: Prediction, start: Prediction, correlation: float | None, *, fitted: bool) -> Row:
    scale = float(np.linalg.norm(test.measured)) / len(test.time) ** 0.5
    largest = float(np.abs(test.measured - prediction.measured).max()) / scale
    return Row(
        test=test,
        fitted=fitted,
        prediction=prediction,
        error=relative_error(test, prediction),
        largest=float("inf") if prediction.lost else largest,
        at_start=relative_error(test, start),
        correlation=correlation,
    )


def write(material: str, config: dict[str, Any], fits: Fits, rows: list[Row], *, log: Log) -> Path:
    """All files into the folder of the log; the path of fit.md."""
    done = "fit.md"
    for name in (done, "material.yaml", "intervals.csv", "errors.csv"):
        log.path(name).unlink(missing_ok=True)
    log.image("curves", curves(rows))
    best, seen = fits.best, [r.test.name for r in rows if r.fitted]
    with log.path("intervals.csv").open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(("valley", "parameter", "unit", "value", "lower", "upper", "determined"))
        for i, fit in enumerate((best, *fits.others)):
            for name, ends in fit.intervals.items():
                number = (fit.values[name], *ends)
                told = "no" if name in fit.undetermined else "yes"
                table.writerow((i + 1, name, unit(name), *(f"{x:.6g}" for x in number), told))
    with log.path("errors.csv").open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(
            ("test", "role", "controlled", "rows", "error_percent", "largest_percent", "error_at_start_percent")
        )
        for r in rows:
            numbers = (f"{100 * x:.4g}" for x in (r.error, r.largest, r.at_start))
            table.writerow(
                (r.test.name, "fitted" if r.fitted else "unseen", r.test.control, len(r.test.time), *numbers)
            )
    log.path("material.yaml").write_text(as_yaml(material, config, best, seen))
    log.path(done).write_text(as_page(material, fits, rows))
    return log.path(done)


def as_yaml(material: str, config: dict[str, Any], fit: Fit, tests: list[str]) -> str:
    """A file of conf/material: the fitted values, their intervals behind them."""
    lines = [f"# {material}, fitted to the tests {', '.join(tests)}; 90 % intervals behind the values"]
    lines += [f"model: {_flow(config['model'])}", "start:"]
    for name, value in fit.values.items():
        said = f"{said_of(fit, name)}{bracketed(name)}" if name in fit.intervals else f"as given{bracketed(name)}"
        lines.append(f"  {name}: {value:.6e} # {said}")
    lines += [f"{key}: {_flow(config[key])}" for key in ("learn", "ties")]
    return "\n".join(lines) + "\n"


def said_of(fit: Fit, name: str) -> str:
    """The interval of a parameter in words."""
    low, high = (f"{x:.4g}" for x in fit.intervals[name])
    if name in fit.undetermined:
        return f"not determined by these tests; between {low} and {high}"
    return f"{low} .. {high}"


def as_page(material: str, fits: Fits, rows: list[Row]) -> str:
    best = fits.best
    lines = [f"# {material}", "", "| parameter | value | 90 % interval |", "|---|---|---|"]
    for name, value in best.values.items():
        said = said_of(best, name) if name in best.intervals else "as given"
        lines.append(f"| {name}{bracketed(name)} | {value:.4g} | {said} |")
    lines += ["", CORRELATED, ""]
    lines += ["| test | | controlled | rows | error [%] | largest [%] | with the values before [%] | correlation |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    for r in rows:
        numbers = " | ".join(f"{100 * x:.3g}" for x in (r.error, r.largest, r.at_start))
        role = "fitted" if r.fitted else "**unseen**"
        q = "" if r.correlation is None else f"{r.correlation:.2f}"
        lines.append(f"| {r.test.name} | {role} | {r.test.control} | {len(r.test.time)} | {numbers} | {q} |")
    lines += ["", ERRORS, ""]
    if not any(not r.fitted for r in rows):
        lines += ["No test was held out (UNSEEN=<name>): these errors say how well curves are drawn, not foretold.", ""]
    for fit in fits.others:
        lines += [f"**Two valleys.** These values explain the tests as well (error {_total(fit, rows)} against"]
        lines += [f"{_total(best, rows)}); a test that the two answer differently would settle it:", ""]
        lines += ["| parameter | value | 90 % interval |", "|---|---|---|"]
        lines += [f"| {n}{bracketed(n)} | {fit.values[n]:.4g} | {said_of(fit, n)} |" for n in fit.intervals] + [""]
    return "\n".join([*lines, "![measured and predicted](previews/curves.png)"]) + "\n"


def curves(rows: list[Row]) -> Any:
    """Every test over time: measured as dots, predicted as a line."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    columns = min(3, len(rows))
    height = -(-len(rows) // columns)
    figure, axes = pyplot.subplots(height, columns, figsize=(4.4 * columns, 3.2 * height), squeeze=False)
    for axis in axes.flat[len(rows) :]:
        axis.axis("off")
    for axis, r in zip(axes.flat, rows):
        time, test = _from_the_start(r.test.time), r.test
        axis.plot(time, test.measured, ".", color="0.5", markersize=3, label="measured")
        axis.plot(
            time, r.prediction.measured, color="C0" if r.fitted else "C3", label="fitted" if r.fitted else "unseen"
        )
        strain = "shear" if test.kind == "shear" else "stretch - 1"
        axis.set(xlabel="time [s]", ylabel=f"{test.kind} stress [Pa]" if test.control == "deformation" else strain)
        axis.set_title(f"{test.name}: {100 * r.error:.3g} %", fontsize=10)
        if time[-1] > 200 * time[time > 0].min():
            axis.set_xscale("log")
        axis.legend(fontsize=8)
    figure.tight_layout()
    return figure


def unit(name: str) -> str:
    return "s" if "_time" in name else "1" if "ratio" in name else "Pa"


def bracketed(name: str) -> str:
    return "" if unit(name) == "1" else f" [{unit(name)}]"


def _from_the_start(time: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    return time - time[0]


def _total(fit: Fit, rows: list[Row]) -> str:
    return f"{100 * (fit.cost / sum(r.fitted for r in rows)) ** 0.5:.3g} %"


def _flow(value: Any) -> str:
    """On one line."""
    return yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000).strip()
