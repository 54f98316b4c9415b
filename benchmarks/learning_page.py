"""The page of `learning.py`: bars of what must hold, every run, what each thing that truth hands over is worth; a plot.

Made from the rows of the table alone, so that it can be made again without computing anything.
"""

import math
from pathlib import Path

import numpy as np
from machine import machine

Row = dict[str, str]
NAMES = {
    "E": "stiffness E",
    "mu": "stiffness of the branch mu_N",
    "tau": "relaxation time tau",
    "nu": "Poisson's ratio nu",
    "rho": "density",
}
LEAST, MOST = 0.80, 0.97  # share of the truths that intervals of 90 % may hold, over twenty runs
CLOSE = 0.038  # mean |log10 E/truth|, with three cameras or more
OF_NU = 0.1  # error of Poisson's ratio

WORDS = """
Each row is one thing with a material of its own: a flower, a cup on a stem, a hat, with a stiffness drawn from a
hundredfold range. It was pushed, and filmed by one, three or eleven cameras, as small noisy clips. The learner got the
clips, the shape, the push and a wrong weight, which the push corrects, and believed at first that the thing is ten
times stiffer or softer.

- **E** is how hard it is to bend the thing and keep it bent; **found / truth** is 1 where the answer is right.
- **tau** is how long the thing takes to forget that it was bent: a jelly forgets at once, dough slowly. **mu_N** is how
  much of its stiffness it forgets.
- **density** is how heavy it is for its size: of two things pushed alike the heavier one swings less far.
- **90 %** is what the learner itself says, over the truth: in nine cases of ten 1 lies between these two. A **bold**
  one did not hold it. Of ten about one should fail; if none ever does, they are wider than they need be.
- **still, learned** compare another push, that was not learned from, with a picture that stands still and with what was
  foretold [dB]. More is better; the noise of the clips lets nobody much above {ceiling:.1f} dB.
"""

USUAL = "nothing"  # is taken away in the run that other ways are compared with
SHAPE = "shape"  # what is taken away in the runs whose surface is reconstructed
TOLD = "size and push"  # in the runs in which all that is assumed is told wrongly
ASSUMED = """
Other bodies by three cameras. Intervals allow for a size, a push and a density that are told wrongly; above the size
and the push are right, and intervals told so. Here the learner's lengths are e^N(0, {length}), its forces e^N(0,
{force}) and its densities e^N(0, {density}) times the true ones, and it allows for as much (`learn.beyond.length` and
`.force` as in a scene that says nothing of them). E goes with force/length^2 and the density that the push tells with
force/length^4, so that by these alone E is wrong by {of_E:.0f} % (a standard deviation), the density by {of_rho:.0f} %.
Half of the frames are learned from, which takes a third of the time and finds the same (last table).
"""
PHOTOGRAPHED = """
The same bodies, clips and starts by three cameras, but the learner has the shape from {shots} photographs of {width} x
{height} px, by `{words}`, and allows for it (`learn.beyond.surface` as configured).
"""
HANDED = """
The {scene} by {cameras} cameras, each time the same clips. First the learner is handed all but what it learns: density,
push, Poisson's ratio, that both relaxation times are one, and the ratio of both branch moduli. Then one of these is
taken away: density and push are 10 % wrong, and are known to be uncertain by as much; Poisson's ratio is learned, from
0.1 too low; what was tied is learned apart.
"""
OTHERWISE = """
The {scene} by {cameras} cameras once more, handed all but what it learns, with one thing otherwise than usual. Times
are processor time of filling and learning on one thread; "usual" is the row "nothing" of the table above.
"""


def write(rows: list[Row], folder: Path, total: int) -> None:
    """`learning.md` and `learning.png`, of the rows of `learning.csv`; `total` runs were asked for."""
    from learning import HANDED

    done = [row for row in rows if not row["failed"]]
    runs = [row for row in done if not row["taken"]]
    failed = [row for row in rows if row["failed"]]
    lines = [
        "# Learning, where the answer is known",
        "",
        "Made by `make bench-learning`.",
        f"Machine: {machine('cpu')}.",
        "",
    ]
    if len(rows) < total:
        lines += [f"**{len(rows)} of {total} runs are done**; `make bench-learning` goes on with the others.", ""]
    lines += [*about().splitlines(), "", "## In words", *WORDS.format(ceiling=ceiling()).splitlines(), ""]
    lines += ["## What must hold", "", "| what | measured | bar | holds |", "|---|---|---|---|"]
    lines += [f"| {' | '.join(law)} |" for law in bars(runs, failed)]
    lines += [
        "",
        "Where size, push and density are told wrongly ([below](#where-all-that-is-assumed-is-told-wrongly)):",
        "",
    ]
    told = [row for row in done if row["taken"] == TOLD]
    lines += ["| what | measured | bar | holds |", "|---|---|---|---|"]
    lines += [f"| {' | '.join(law)} |" for law in coverage(told)]
    lines += ["", "![found over truth, with intervals](learning.png)", "", "## Every run", "", *every(runs)]
    lines += [
        f"- {row['scene']}, {row['cameras']} camera(s), seed {row['seed']} failed: {row['failed']}" for row in failed
    ]
    lines += ["", "## Where all that is assumed is told wrongly", "", *assumed(told)]
    shaped = [row for row in done if row["taken"] == SHAPE]
    lines += ["", "## The shape from photographs", "", *photographed(runs, shaped)]
    others = [row for row in done if row["taken"] in HANDED]
    lines += ["", "## What each thing that is handed over is worth", "", *handed(others)]
    ways = [row for row in done if row["taken"] not in ("", TOLD, SHAPE, *HANDED[1:])]
    lines += ["", "## Error against run time", "", *otherwise(ways)]
    (folder / "learning.md").write_text("\n".join(lines) + "\n")
    if len(ways) > 1:
        draw_costs(ways).savefig(folder / "learning_costs.png", dpi=100)
    draw(runs).savefig(folder / "learning.png", dpi=100)


def about() -> str:
    """What is said in the docstrings of the benchmark, so that page and code say the same."""
    import learning
    import learning_twins

    text = learning.__doc__ or "", learning_twins.__doc__ or ""
    said = f"Learning is that of the default profile but for `{' '.join(learning.WORDS)}`."
    return "\n\n".join(
        [*text[0].strip().split("\n\n")[2:], said, "## How bodies are drawn", *text[1].strip().split("\n\n")[1:]]
    )


def ceiling() -> float:
    """PSNR of the noise alone [dB]."""
    from learning_twins import NOISE

    return -20 * math.log10(NOISE)


def ratio(row: Row, name: str) -> float:
    """ln(found/truth)."""
    return math.log(float(row[f"{name}_found"]) / float(row[name]))


def heavier(row: Row) -> float:
    """ln of the density that the learner ends with over the true one: found, or as given."""
    return ratio(row, "rho") if row["rho_found"] else math.log(float(row["density"]))


def holds(row: Row, name: str) -> bool:
    """Whether the truth is in the interval."""
    return float(row[f"{name}_low"]) <= float(row[name]) <= float(row[f"{name}_high"])


def covered(runs: list[Row], names: tuple[str, ...]) -> tuple[int, int]:
    """(how many intervals hold the truth, of how many)."""
    told = [holds(row, name) for row in runs for name in names if row[f"{name}_low"]]
    return sum(told), len(told)


def verdict(good: bool) -> str:
    """Whether a bar holds."""
    return "yes" if good else "**no**"


def coverage(runs: list[Row]) -> list[tuple[str, str, str, str]]:
    """(what, measured, bar, whether it holds), of the truths that intervals hold."""
    found = []
    for names in (("E",), ("mu",), ("tau",), ("E", "mu", "tau"), ("rho",)):
        hits, total = covered(runs, names)
        share = hits / max(total, 1)
        what = f"intervals that hold the truth: {', '.join(NAMES[name] for name in names)}"
        spread = 100 * math.sqrt(0.09 / max(total, 1))  # of a share of nine in ten, of so many that are independent
        found.append((
            what, f"{hits} of {total}: {100 * share:.0f} %, by chance +-{spread:.0f}", "80 to 97 %, at least 20 runs",
            verdict(LEAST <= share <= MOST and len(runs) >= 20),
        ))  # fmt: skip
    return found


def bars(runs: list[Row], failed: list[Row]) -> list[tuple[str, str, str, str]]:
    """(what, measured, bar, whether it holds)."""
    found = coverage(runs)
    for few, many, what in ((3, math.inf, "three cameras or more"), (1, 1, "one camera")):
        off = [abs(ratio(row, "E")) / math.log(10) for row in runs if few <= int(row["cameras"]) <= many]
        mean = float(np.mean(off)) if off else math.nan
        bar, holds_ = (f"{CLOSE}", verdict(mean < CLOSE)) if few == 3 else ("", "")
        found.append((f"mean of abs(log10 E/truth), {what}, {len(off)} runs", f"{mean:.3f}", bar, holds_))
    several = [row for row in runs if int(row["cameras"]) >= 3]
    for which, told in (
        ("as given", [abs(math.log10(float(row["density"]))) for row in several]),
        ("as found", [abs(ratio(row, "rho")) / math.log(10) for row in several if row["rho_found"]]),
    ):
        mean = f"{np.mean(told):.3f}" if told else ""
        found.append((f"mean of abs(log10 of density {which}/truth), three cameras or more", mean, "", ""))
    of_mass = [abs(ratio(row, "E") - heavier(row)) / math.log(10) for row in several]
    apart = f"{np.mean(of_mass):.3f}" if of_mass else ""
    found.append(("mean of abs(log10 of E/density, found/truth), the same runs: what a swing tells", apart, "", ""))
    hits, total = covered(runs, ("tau",))
    found.append(("relaxation time inside its interval", f"{hits} of {total}", "all", verdict(0 < total == hits)))
    better = sum(float(row["psnr"]) > float(row["still"]) for row in runs)
    found.append(
        (
            "held-out push foretold better than a still picture",
            f"{better} of {len(runs)}",
            "all",
            verdict(0 < len(runs) == better),
        )
    )
    found.append(
        ("runs that ended in an error", f"{len(failed)} of {len(runs) + len(failed)}", "0", verdict(not failed))
    )
    seconds = sum(float(row["seconds"]) for row in runs)
    found.append((f"filling and learning, {len(runs)} runs", f"{seconds / 60:.0f} min of processor time", "", ""))
    return found


def every(runs: list[Row]) -> list[str]:
    """One line a run."""
    head = "| body | cameras | seed | moved by | truth E [Pa] | start / truth | **E found / truth** | 90 % "
    head += "| truth tau [s] | start / truth | **tau found / truth** | 90 % | mu_N found / truth | 90 % "
    head += "| density as given / truth | found / truth | 90 % | still, learned [dB] | time [s] |"
    lines = [head, "|---" * (head.count("|") - 1) + "|"]
    for row in runs:
        cells = [row["scene"], row["cameras"], row["seed"], row["moved_by"]]
        for name in ("E", "tau"):
            start = float(row[f"{name}_start"]) / float(row[name])
            cells += [
                f"{float(row[name]):.3g}",
                f"{start:.2g}",
                f"{math.exp(ratio(row, name)):.3f}",
                between(row, name),
            ]
        cells += [f"{math.exp(ratio(row, 'mu')):.3f}", between(row, "mu"), f"{float(row['density']):.2f}"]
        cells += [f"{math.exp(ratio(row, 'rho')):.3f}", between(row, "rho")] if row["rho_found"] else ["", ""]
        cells += [f"{float(row['still']):.1f}, {float(row['psnr']):.1f}", f"{float(row['seconds']):.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def between(row: Row, name: str) -> str:
    """The interval over the truth; bold where 1 is not in it."""
    low, high = (float(row[f"{name}_{end}"]) / float(row[name]) for end in ("low", "high"))
    text = f"{low:.2f} to {high:.2f}"
    return text if holds(row, name) else f"**{text}**"


def assumed(rows: list[Row]) -> list[str]:
    """The runs in which all that is assumed is told wrongly."""
    if not rows:
        return ["No run yet."]
    from learning_twins import DENSITY, FORCE, LENGTH

    told = ASSUMED.format(
        length=LENGTH, force=FORCE, density=DENSITY,
        of_E=100 * math.hypot(FORCE, 2 * LENGTH), of_rho=100 * math.hypot(FORCE, 4 * LENGTH),
    )  # fmt: skip
    error = np.mean([abs(ratio(row, "E")) for row in rows]) / math.log(10)
    close = f"Mean of abs(log10 E/truth): {error:.3f}."
    return [*told.strip().splitlines(), "", *every(rows), "", close]


def photographed(runs: list[Row], shaped: list[Row]) -> list[str]:
    """The runs with a reconstructed shape beside those with the true one."""
    if not shaped:
        return ["No run yet."]
    from learning import PHOTOGRAPHED as WORDS_OF_SHAPE
    from learning_twins import PHOTOGRAPH, SHOTS

    said = PHOTOGRAPHED.format(shots=SHOTS, width=PHOTOGRAPH[0], height=PHOTOGRAPH[1], words=" ".join(WORDS_OF_SHAPE))
    head = "| body | seed | **E found / truth** | 90 % | with the true shape | tau found / truth | 90 % "
    head += "| mu_N found / truth | 90 % | still, learned [dB] | with the true shape | particles | time [s] |"
    lines = [*said.strip().splitlines(), "", head, "|---" * (head.count("|") - 1) + "|"]
    true = {(row["scene"], row["seed"]): row for row in runs if row["cameras"] == "3"}
    for row in shaped:
        other = true.get((row["scene"], row["seed"]))
        cells = [row["scene"], row["seed"], f"{math.exp(ratio(row, 'E')):.3f}", between(row, "E")]
        cells.append("" if other is None else f"{math.exp(ratio(other, 'E')):.3f}")
        for name in ("tau", "mu"):
            cells += [f"{math.exp(ratio(row, name)):.3f}", between(row, name)]
        cells.append(f"{float(row['still']):.1f}, {float(row['psnr']):.1f}")
        cells.append("" if other is None else f"{float(other['psnr']):.1f}")
        cells += [row["particles"], f"{float(row['seconds']):.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    hits, number = covered(shaped, ("E", "mu", "tau"))
    error = np.mean([abs(ratio(row, "E")) for row in shaped]) / math.log(10)
    lines += ["", f"Intervals hold {hits} of {number} truths; mean of abs(log10 E/truth) {error:.3f}."]
    return lines


def handed(rows: list[Row]) -> list[str]:
    """Of one body: error and width of what is learned as truth is taken from the learner."""
    if not rows:
        return ["No run yet."]
    lines = [
        *HANDED.format(**rows[0]).strip().splitlines(),
        "",
        "| taken away | E found / truth | 90 % | mu_N found / truth | 90 % | tau found / truth | 90 % | nu | 90 % |",
        "|---" * 9 + "|",
    ]
    for row in rows:
        cells = [row["taken"]]
        for name in ("E", "mu", "tau"):
            cells += [f"{math.exp(ratio(row, name)):.3f}", between(row, name)]
        told = bool(row["nu_found"])
        cells += [f"{float(row['nu_found']):.2f}, truth {float(row['nu']):.2f}" if told else "given"]
        cells += [f"{float(row['nu_low']):.2f} to {float(row['nu_high']):.2f}" if told else ""]
        lines.append(f"| {' | '.join(cells)} |")
    known = [row for row in rows if row["nu_found"]]
    worst = max((abs(float(row["nu_found"]) - float(row["nu"])) for row in known), default=math.nan)
    if known:
        bar = f"the bar is {OF_NU} where the clip determines it"
        lines += ["", f"Poisson's ratio, where it is learned, is wrong by at most {worst:.2f}; {bar}."]
    return lines


def usual(row: Row) -> str:
    """What a way is called."""
    return "usual" if row["taken"] == USUAL else row["taken"]


def otherwise(rows: list[Row]) -> list[str]:
    """Of one body: what is learned and foretold, and how long it takes."""
    if len(rows) < 2:
        return ["No run yet."]
    lines = [
        *OTHERWISE.format(**rows[0]).strip().splitlines(),
        "",
        "![error and foretelling against time](learning_costs.png)",
        "",
        "| | particles | time [s] | E found / truth | 90 % | mu_N found / truth | tau found / truth | learned [dB] |",
        "|---" * 8 + "|",
    ]
    for row in rows:
        found = [f"{math.exp(ratio(row, 'E')):.3f}", between(row, "E")]
        found += [f"{math.exp(ratio(row, name)):.3f}" for name in ("mu", "tau")]
        cells = [usual(row), row["particles"], f"{float(row['seconds']):.0f}", *found, f"{float(row['psnr']):.1f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def draw_costs(rows: list[Row]):
    """Error of E, and what the held-out push is foretold at, against time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    error = lambda row: 100 * abs(math.expm1(ratio(row, "E")))
    foretold = lambda row: float(row["psnr"])
    for axis, value in zip(figure.subplots(1, 2), (error, foretold)):
        for i, row in enumerate(rows):
            marker = "o*sDv^<>PXh"[i % 11]
            axis.plot(
                float(row["seconds"]), value(row), marker, color=f"C{i % 10}", markersize=9, label=usual(row)
            )  # fmt: skip
        axis.set(xscale="log", xlabel="processor time of filling and learning [s]")
        axis.xaxis.set_major_formatter(lambda seconds, _: f"{seconds:g}")
        axis.xaxis.set_minor_formatter(lambda seconds, _: f"{seconds:g}" if f"{seconds:g}"[0] in "25" else "")
        axis.grid(alpha=0.3, which="both")
    figure.axes[0].set(ylabel="error of E [%]", yscale="log")
    figure.axes[1].set_ylabel("held-out push, foretold [dB]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    return figure


def draw(runs: list[Row]):
    """Found over truth with its interval, run beside run, a panel for each number."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6.5), layout="constrained")
    for axis, name in zip(figure.subplots(3, 1, sharex=True), ("E", "mu", "tau")):
        for i, row in enumerate(runs):
            low, found, high = (float(row[f"{name}_{end}"]) / float(row[name]) for end in ("low", "found", "high"))
            colour = {"1": "C0", "3": "C1", "11": "C2"}.get(row["cameras"], "C3")
            axis.plot([i, i], [low, high], color=colour, lw=3, alpha=1.0 if holds(row, name) else 0.4)
            axis.plot(i, found, "k_")
        axis.axhline(1, color="0.6", lw=0.8)
        axis.set(yscale="log", ylabel=f"{NAMES[name]}\nfound / truth")
        axis.yaxis.label.set_size(8)
    axis.set_xticks(range(len(runs)), [f"{row['scene']} {row['cameras']}" for row in runs], rotation=90, fontsize=7)
    figure.suptitle(
        "90 % intervals over the truth; blue, orange, green: 1, 3, 11 cameras; pale: does not hold it", fontsize=9
    )
    return figure
