"""Scores: one table of videos, one of material parameters, and the notes that say why a number is missing."""

from dataclasses import dataclass, field
from typing import Any

from physics3d.artifact import AbstractArtifact

FROZEN, REFERENCE = "frozen first frame", "reference"  # rows that everyone is compared with
UNITS = {
    "psnr": "PSNR [dB]", "ssim": "SSIM", "ms_ssim": "MS-SSIM", "vmaf": "VMAF", "motion_psnr": "motion PSNR [dB]",
    "flow_error": "flow error", "frequency": "frequency [Hz]", "damping": "damping [1/s]",
    "phase": "phase [deg]", "thing_flow_error": "flow error, the thing's pixels",
    "thing_damping": "damping, the thing's pixels [1/s]",
    "value": "value", "truth": "truth", "error_percent": "error [%]", "log_ratio": "ln(value/truth)",
    "low": "5 % below", "high": "5 % above",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Scores(AbstractArtifact):
    """What was measured, and where it could not be, why."""

    values: dict[str, dict[str, float | None]]  # reference, frozen first frame, initial, learned -> metric -> number
    parameters: dict[str, dict[str, float | None]] = field(
        default_factory=dict
    )  # "learned: youngs_modulus" -> value, ...
    notes: dict[str, str] = field(default_factory=dict)  # metric or row -> why it is missing
    comparable: bool = True  # False: the videos do not show the reference's excitation, so only the eye may compare

    def check(self) -> None:
        if not self.values:
            raise ValueError("Scores.values is empty; nothing was evaluated")
        for table in (self.values, self.parameters):
            for row, cells in table.items():
                if bad := [name for name, value in cells.items() if value is not None and value != value]:
                    raise ValueError(
                        f"Scores row {row!r} holds NaN in {bad}; what cannot be measured is None with a note"
                    )

    def markdown(self) -> str:
        """Both tables and the notes, as a README or a terminal shows them."""
        parts = [markdown_table(self.values), markdown_table(self.parameters)]
        parts += ["\n".join(f"- {name}: {text}" for name, text in self.notes.items())]
        return "\n\n".join(p for p in parts if p)

    def tables(self) -> list[Any]:
        """The same as rich tables, to print."""
        from rich.table import Table

        tables = []
        for values in (self.values, self.parameters):
            if values:
                table = Table("", *(UNITS.get(name, name) for name in columns(values)))
                for row, cells in values.items():
                    table.add_row(row, *(cell(cells.get(name)) for name in columns(values)))
                tables.append(table)
        return tables


def columns(values: dict[str, dict[str, float | None]]) -> list[str]:
    return list(dict.fromkeys(name for cells in values.values() for name in cells))


def cell(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def markdown_table(values: dict[str, dict[str, float | None]]) -> str:
    if not values:
        return ""
    names = columns(values)
    lines = ["| | " + " | ".join(UNITS.get(name, name) for name in names) + " |", "|---" * (len(names) + 1) + "|"]
    lines += [
        "| " + " | ".join([row, *(cell(cells.get(name)) for name in names)]) + " |" for row, cells in values.items()
    ]
    return "\n".join(lines)
