"""Cost per unit of work as a slope over several lengths, and what rows of a table say against each other.

A difference of the shortest times of two lengths is as good as the worse of the two, and its error is unknown. Here
every length is run several times in turn, every pair of lengths of one round gives a slope, and their median is the
cost, with half the distance of the quartiles as its spread (Theil 1950; Sen 1968).
"""

import itertools
import statistics
from collections.abc import Callable

Row = dict  # what, kind, size, value, spread, unit, and what a benchmark has besides
CONTRADICTED = 1.0  # of the spreads of two rows together: what one may be below the other


def slope(run: Callable[[int], tuple[float, int]], lengths: tuple[int, ...], rounds: int) -> tuple[float, float]:
    """(median, half the distance of the quartiles) of seconds per unit, of `run`: length -> (seconds, units)."""
    found = []
    for _ in range(rounds):
        points = [run(length) for length in lengths]
        found += [(b[0] - a[0]) / (b[1] - a[1]) for a, b in itertools.combinations(points, 2)]
    low, middle, high = statistics.quantiles(found, n=4)
    return middle, (high - low) / 2


def contradictions(rows: list[Row], *, simpler: tuple[tuple[str, str], ...] = ()) -> list[str]:
    """One sentence for every two rows that cannot both be true, up to their spreads:

    - a forward run takes longer than the same with its adjoint;
    - a larger body costs less per substep as a whole than a smaller one;
    - `simpler` (a, b): a, a part of b, takes longer than b;
    - a cost is below zero, or a share above one."""
    found = [
        f"{_named(r)}: {r['value']:.3g} {r['unit']}"
        for r in rows
        if r["value"] < -r["spread"] or (r["unit"] == "share" and r["value"] > 1 + r["spread"])
    ]
    timed = [r for r in rows if r["unit"].startswith(("ns", "ms"))]
    for a, b in itertools.permutations(timed, 2):
        same = {key: a.get(key) == b.get(key) for key in ("what", "kind", "size", "unit", "threads")}
        both = (a["kind"], b["kind"]) == ("forward", "forward + adjoint")
        if both and all(same[key] for key in same if key != "kind") and _above(a, b):
            found.append(_against(a, b, "does more"))
        if (a["what"], b["what"]) in simpler and all(same[key] for key in same if key != "what") and _above(a, b):
            found.append(_against(a, b, "does more"))
        per_particle = a["unit"].startswith("ns per particle")
        if per_particle and all(same[key] for key in same if key != "size") and a["size"] < b["size"]:
            whole_a, whole_b = (dict(r, value=r["value"] * r["size"], spread=r["spread"] * r["size"]) for r in (a, b))
            if _above(whole_a, whole_b):
                found.append(_against(a, b, "has more particles and takes less in all"))
    return found


def _above(a: Row, b: Row) -> bool:
    return a["value"] - b["value"] > CONTRADICTED * (a["spread"] + b["spread"])


def _named(r: Row) -> str:
    return ", ".join(str(x) for x in (r["what"], r["kind"], r["size"]) if x != "")


def _against(a: Row, b: Row, why: str) -> str:
    values = " and ".join(f"{r['value']:.3g} +- {r['spread']:.2g}" for r in (a, b))
    return f"{_named(a)} against {_named(b)}, which {why}: {values} {a['unit']}"
