"""Tables of a test machine: one csv per test; its name is the file's.

    # control: stress          what the machine prescribed: deformation (if nothing is said) or stress (creep)
    # start: relaxed           how the specimen came to the first row, where that is not at rest:
    #                            jump        at once, at the time of that row
    #                            relaxed     long ago; it was held until nothing changed any more
    #                            ramp 2.5    at a constant rate, in so many seconds
    time [s],stretch [1],nominal stress [kPa]
    0,1,0
    0.1,1.02,1.9

The first line that does not begin with # names the columns, each with its unit in brackets. Tension and compression:
`stretch` (length/length at rest) or `strain` (stretch - 1), with `nominal stress` (force/area at rest) or `true stress`
(force/area now). Simple shear: `shear` (an angle's tangent) with `shear stress`. Other columns are not allowed:
nothing is silently left aside. Between two rows the machine is taken to move at a constant rate.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

TIME = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}  # [s]
PURE = {"1": 1.0, "-": 1.0, "%": 0.01}
STRESS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9, "N/mm2": 1e6, "N/mm^2": 1e6}  # [Pa]
DEFORMATIONS, STRESSES = ("stretch", "strain", "shear"), ("nominal stress", "true stress", "shear stress")
UNITS = {"time": TIME} | dict.fromkeys(DEFORMATIONS, PURE) | dict.fromkeys(STRESSES, STRESS)
REST = 0.01  # of the largest value: a first row within it counts as at rest


@dataclass(frozen=True, kw_only=True)
class LabTest:
    """One test, SI."""

    name: str
    kind: Literal["nominal", "true", "shear"]  # tension by its nominal or true stress, or simple shear
    control: Literal["deformation", "stress"]  # which of both columns the machine prescribed
    lead: float  # how long it took to come from rest to the first row [s]
    time: Float[np.ndarray, " t"]  # [s]
    deformation: Float[np.ndarray, " t"]  # stretch, or shear
    stress: Float[np.ndarray, " t"]  # [Pa]

    @property
    def rest(self) -> float:
        """The deformation at rest."""
        return 0.0 if self.kind == "shear" else 1.0

    @property
    def measured(self) -> Float[np.ndarray, " t"]:
        """What the specimen answered: stress [Pa], or stretch - 1 or shear where stress was prescribed."""
        return self.stress if self.control == "deformation" else self.deformation - self.rest

    @property
    def prescribed(self) -> Float[np.ndarray, " t"]:
        return self.deformation - self.rest if self.control == "deformation" else self.stress


def read_folder(folder: Path) -> list[LabTest]:
    """Every *.csv of the folder, by name. Raises ValueError in one line naming file, row and remedy."""
    if not folder.is_dir():
        raise ValueError(f"no folder at {folder}; give DATA=<folder with a csv for each test>")
    # systems and spreadsheets leave hidden files beside those that they opened
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".csv" and p.is_file() and p.name[0] not in ".~")
    if not paths:
        raise ValueError(f"{folder} holds no .csv; put a table for each test into it (docs/laboratory.md)")
    return [read_table(path) for path in paths]


def read_table(path: Path) -> LabTest:
    """One table. Raises ValueError as `read_folder`."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path.name} is no text in UTF-8; save it as a csv again") from error
    words = _words(path.name, [line[1:] for line in lines if line.startswith("#")])
    rows = [(i + 1, line) for i, line in enumerate(lines) if line.strip() and not line.startswith("#")]
    if not rows:
        raise ValueError(f"{path.name} is empty; its first line names the columns")
    try:
        columns = _columns(path.name, next(csv.reader([rows[0][1]])))
        table = np.array([_numbers(path.name, i, line, columns) for i, line in rows[1:]])
    except csv.Error as error:
        raise ValueError(f"{path.name} is no csv ({error}); save it as one again") from error
    if len(table) < 2:
        raise ValueError(f"{path.name} has {len(table)} rows of numbers; it needs 2 or more")
    found = {name: table[:, i] * UNITS[name][unit] for i, (name, unit) in enumerate(columns)}
    return _checked(path, found, words, [i for i, _ in rows[1:]])


def _words(name: str, comments: list[str]) -> dict[str, str]:
    """`key: value` of the comments; comments without a colon are for people."""
    words = {}
    for comment in comments:
        key, colon, value = (part.strip().lower() for part in comment.partition(":"))
        if colon and key in ("control", "start"):
            words[key] = value
    if words.get("control", "deformation") not in ("deformation", "stress"):
        raise ValueError(f"{name}: control is {words['control']!r}; take deformation or stress")
    return words


def _columns(name: str, cells: list[str]) -> list[tuple[str, str]]:
    """(quantity, unit) of each column."""
    columns = []
    for cell in cells:
        quantity, bracket, rest = (part.strip() for part in cell.partition("["))
        quantity, unit = " ".join(quantity.lower().split()), rest.rstrip("]").strip()
        if quantity not in UNITS:
            raise ValueError(f"{name}: there is a column {cell.strip()!r}; take {', '.join(UNITS)}, each with its unit")
        if not bracket or unit not in UNITS[quantity]:
            allowed = ", ".join(f"[{u}]" for u in UNITS[quantity])
            raise ValueError(
                f"{name}: the unit of {quantity} is {f'[{unit}]' if bracket else 'missing'}; take {allowed}"
            )
        columns.append((quantity, unit))
    names = [quantity for quantity, _ in columns]
    for what, choices in (("time", ("time",)), ("deformation", DEFORMATIONS), ("stress", STRESSES)):
        found = [n for n in names if n in choices]
        if not found:
            raise ValueError(f"{name}: no column of {what}; add one of {', '.join(f'{n} [unit]' for n in choices)}")
        if len(found) > 1:
            raise ValueError(f"{name}: columns {' and '.join(found)} are both there; keep one of them")
    if ("shear" in names) != ("shear stress" in names):
        raise ValueError(f"{name}: {names} mixes shear and tension; shear goes with shear stress")
    return columns


def _numbers(name: str, row: int, line: str, columns: list[tuple[str, str]]) -> list[float]:
    cells = next(csv.reader([line]))
    if len(cells) != len(columns):
        raise ValueError(f"{name}, line {row}: {len(cells)} cells for {len(columns)} columns; write 1.5, not 1,5")
    numbers = []
    for cell, (quantity, _) in zip(cells, columns):
        try:
            numbers.append(float(cell.replace("_", "?")))  # which Python would take as a part of a number
        except ValueError as error:
            raise ValueError(f"{name}, line {row}: {quantity} is {cell.strip()!r}, no number; mend the row") from error
        if not math.isfinite(numbers[-1]):
            raise ValueError(f"{name}, line {row}: {quantity} is {cell.strip()}; leave out rows without a measurement")
    return numbers


def _checked(path: Path, found: dict[str, np.ndarray], words: dict[str, str], lines: list[int]) -> LabTest:
    name, time = path.name, found["time"]
    late = np.flatnonzero(np.diff(time) <= 0)
    if len(late):
        row, at = lines[late[0] + 1], time[late[0] + 1]
        raise ValueError(f"{name}, line {row}: time {at:g} s does not increase; sort the rows, drop repeated ones")
    shear = "shear" in found
    deformation = found["shear"] if shear else found["stretch"] if "stretch" in found else 1 + found["strain"]
    flat = np.flatnonzero(deformation <= 0)
    if not shear and len(flat):
        row, at = lines[flat[0]], deformation[flat[0]]
        raise ValueError(f"{name}, line {row}: the stretch is {at:g}; it is length over length at rest, above 0")
    kind: Literal["nominal", "true", "shear"] = "shear" if shear else "nominal" if "nominal stress" in found else "true"
    control: Literal["deformation", "stress"] = "stress" if words.get("control") == "stress" else "deformation"
    stress = found[next(n for n in STRESSES if n in found)]
    test = LabTest(
        name=path.stem, kind=kind, control=control, time=time, deformation=deformation, stress=stress,
        lead=_lead(name, words.get("start"), time),
    )  # fmt: skip
    for what, values in (("prescribed", test.prescribed), ("measured", test.measured)):
        if not np.any(values):
            raise ValueError(f"{name}: what was {what} ({control} is controlled) is 0 in every row; nothing is tested")
    first = abs(test.prescribed[0])
    if "start" not in words and first > REST * np.abs(test.prescribed).max():
        raise ValueError(
            f"{name} does not start at rest; say how it came there by a line `# start: jump`, `# start: relaxed` or "
            "`# start: ramp <seconds>`"
        )
    return test


def _lead(name: str, start: str | None, time: Float[np.ndarray, " t"]) -> float:
    """Seconds from rest to the first row; a jump and a long rest are the two ends of the same."""
    match (start or "jump").split():
        case ["jump"]:
            return 1e-9 * float(np.diff(time).min())
        case ["relaxed"]:
            return 1e9 * float(time[-1] - time[0])
        case ["ramp", seconds] if seconds.replace(".", "", 1).isdigit() and float(seconds) > 0:
            return float(seconds)
    raise ValueError(f"{name}: start is {start!r}; take jump, relaxed, or ramp <seconds>")
