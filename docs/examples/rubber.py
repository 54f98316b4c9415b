"""Writes docs/examples/rubber/: tests of a rubber that is known, with noise, for the fit to find again.

    PYTHONPATH=. .venv/bin/python docs/examples/rubber.py

The truth: `rubber_two` with E 6e5 Pa, branches of 2e5 Pa and 8 s, 1e5 Pa and 0.2 s. Histories are computed on ten
times the rows that are written. Noise is 1 % of the largest value of a curve, correlated by 0.5 from row to row; seed
0.
"""

from pathlib import Path

import numpy as np

from physics3d.laboratory.prediction import predict
from physics3d.laboratory.tables import LabTest
from pipeline.fit_curves import configured

FINER, NOISE, CORRELATION = 10, 0.01, 0.5
TRUTH = {"youngs_modulus": 6e5}
TRUTH |= {"branch_shear_modulus": 2e5, "shear_relaxation_time": 8.0}
TRUTH |= {"branch_shear_modulus_2": 1e5, "shear_relaxation_time_2": 0.2}


def triangle(rate: float, low: float, high: float, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """(time, stretch) from low to high and back at a rate [1/s]."""
    time = np.linspace(0, 2 * abs(high - low) / rate, rows)
    return time, low + (high - low) * (1 - np.abs(1 - time / time[-1] * 2))


def plan() -> list[tuple[str, str, dict]]:
    """(name, start, what a LabTest needs beside the measurement) of every test, on the fine rows."""
    found = []

    def add(name, time, prescribed, *, kind="nominal", control="deformation", start="rest"):
        lead = {"rest": 1e-12, "jump": 1e-12, "relaxed": 1e9}[start]
        blank = np.ones_like(time)
        columns = dict(deformation=prescribed, stress=blank)
        if control == "stress":
            columns = dict(deformation=blank, stress=prescribed)
        found.append((name, start, dict(name=name, kind=kind, control=control, lead=lead, time=time, **columns)))

    n = 60 * FINER + 1
    add("tension_slow", *triangle(0.02, 1.0, 2.0, n))
    add("tension_fast", *triangle(2.0, 1.0, 2.0, n))
    time = np.concatenate([[0.0], np.geomspace(0.01, 60, n - 1)])
    add("relaxation", time, 1 + 0.5 * np.minimum(time / 0.1, 1))
    add("creep", time, np.full(n, 2e5), control="stress", start="jump")
    time = np.linspace(0, 6, 2 * n - 1)
    add("shear_cycles", time, 0.3 + 0.2 * np.sin(2 * np.pi * time / 1.5), kind="shear", start="relaxed")
    add("preloaded", *triangle(0.2, 1.3, 2.2, n), start="relaxed")
    add("compression", *triangle(0.1, 1.0, 0.6, n), kind="true")
    return found


def main() -> None:
    folder = Path(__file__).with_name("rubber")
    material, field, _ = configured("rubber_two")
    theta = np.array([np.log(TRUTH[group[0]] / float(field.start[group[0]])) for group in field.groups])
    rng = np.random.default_rng(0)
    for name, how, columns in plan():
        test = LabTest(**columns)
        measured = predict(material, field, theta, [test])[0].measured[::FINER]
        white = rng.standard_normal(len(measured)) * np.sqrt(1 - CORRELATION**2)
        noise = white.copy()
        noise[0] /= np.sqrt(1 - CORRELATION**2)
        for i in range(1, len(noise)):
            noise[i] = CORRELATION * noise[i - 1] + white[i]
        measured = measured + NOISE * np.abs(measured).max() * noise
        time = test.time[::FINER]
        deformation, stress = test.deformation[::FINER], test.stress[::FINER]
        if test.control == "stress":
            deformation = test.rest + measured
        else:
            stress = measured
        shear = test.kind == "shear"
        head = [f"# {name}: made by docs/examples/rubber.py"]
        head += ["# control: stress"] * (test.control == "stress") + [f"# start: {how}"] * (how != "rest")
        head += [f"time [s],{'shear' if shear else 'stretch'} [1],{test.kind} stress [kPa]"]
        rows = [f"{t:.5g},{d:.6g},{s / 1e3:.5g}" for t, d, s in zip(time, deformation, stress)]
        (folder / f"{name}.csv").write_text("\n".join(head + rows) + "\n")


if __name__ == "__main__":
    main()
