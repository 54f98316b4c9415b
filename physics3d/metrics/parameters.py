"""Parameters against the truth, where a scene knows it."""

import math

from physics3d.truth import truth_of
from physics3d.world import Estimate


def parameter_errors(estimates: dict[str, Estimate], truth: dict[str, float]) -> dict[str, dict[str, float | None]]:
    """ "learned: youngs_modulus" -> value, truth, error [%], ln(value/truth), ends of its 90 % interval
    where it has one; means over particles of a field."""
    table: dict[str, dict[str, float | None]] = {}
    numbers = {row: estimate.numbers for row, estimate in estimates.items()}
    for parameter in dict.fromkeys(name for known in numbers.values() for name in known):
        true = truth_of(parameter, truth)
        for row, estimate in estimates.items():
            if true is not None and parameter in numbers[row]:
                value = numbers[row][parameter]
                positive = value > 0 and true > 0
                table[f"{row}: {parameter}"] = {
                    "value": value,
                    "truth": float(true),
                    "error_percent": 100 * (value - true) / abs(true) if true else None,
                    "log_ratio": math.log(value / true) if positive else None,
                }
                if found := estimate.intervals.get(parameter):
                    table[f"{row}: {parameter}"] |= {"low": found.low, "high": found.high}
    return table
