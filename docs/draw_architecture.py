"""Draws the rooms of the project and who imports whom, from the imports themselves: `make architecture`.

A room is a folder of physics3d/ (or a file beside these), `stages` or `pipeline`; `pipeline` finds the stages by the
`_target_` of conf/config.yaml instead of importing them (dashed). A room's row is one more than the highest of those
that it uses, so every arrow points downwards, or there is a circle and no picture. Writes docs/architecture.png and,
between its two marks, the table in docs/architecture.md.
"""

import ast
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- rooms: made by `make architecture` -->\n", "<!-- end of rooms -->"
NAMED = "stages"  # by the pipeline, in conf/config.yaml
Arrows = dict[str, dict[str, int]]  # room -> room that it imports -> number of its files that do


def room_of(parts: tuple[str, ...]) -> str | None:
    """The room of a module given as the parts of its dotted name; None: not of this project."""
    if parts[0] in ("pipeline", "stages"):
        return parts[0]
    return parts[1] if parts[0] == "physics3d" and len(parts) > 1 else None


def sources() -> dict[str, list[Path]]:
    """Room -> its files."""
    found: dict[str, list[Path]] = defaultdict(list)
    for folder in ("physics3d", "stages", "pipeline"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            room = room_of(path.relative_to(ROOT).with_suffix("").parts)
            if room not in (None, "__init__"):
                found[str(room)].append(path)
    return dict(found)


def arrows(rooms: dict[str, list[Path]]) -> Arrows:
    table: Arrows = {room: defaultdict(int) for room in rooms}
    for room, paths in rooms.items():
        for path in paths:
            names = set()
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    names |= {alias.name for alias in node.names}
                elif isinstance(node, ast.ImportFrom):
                    names |= {f"{node.module}.{alias.name}" for alias in node.names}
            for other in {room_of(tuple(name.split("."))) for name in names} - {None, room}:
                table[room][str(other)] += 1
    table["pipeline"][NAMED] = (ROOT / "conf" / "config.yaml").read_text().count("_target_: stages.")
    return table


def rows(table: Arrows) -> dict[str, int]:
    """Room -> row, 0 at the bottom. Raises ValueError naming a circle."""
    height: dict[str, int] = {}

    def climb(room: str, path: tuple[str, ...]) -> int:
        if room in path:
            raise ValueError(f"the imports go in a circle: {' -> '.join((*path, room))}")
        if room not in height:
            height[room] = 1 + max((climb(other, (*path, room)) for other in table[room]), default=-1)
        return height[room]

    for room in table:
        climb(room, ())
    return height


def first_line(room: str, paths: list[Path]) -> str:
    """What a room says of itself: the docstring of its __init__.py, or of the file."""
    own = next((p for p in paths if p.name == "__init__.py" and p.parent.name == room), paths[0])
    text = ast.get_docstring(ast.parse(own.read_text())) or ""
    return " ".join(text.split("\n\n")[0].split())


def page(rooms: dict[str, list[Path]], table: Arrows) -> str:
    """The table of the page: room, what it is, what it imports, files and lines."""
    height = rows(table)
    lines = ["| room | what it is | imports | files | lines |", "|---|---|---|---|---|"]
    for room in sorted(rooms, key=lambda r: (-height[r], r)):
        count = sum(len(p.read_text().splitlines()) for p in rooms[room])
        uses = ", ".join(sorted(table[room])) or "nothing of the project"
        lines.append(f"| `{room}` | {first_line(room, rooms[room])} | {uses} | {len(rooms[room])} | {count} |")
    return "\n".join(lines) + "\n"


def draw(table: Arrows, path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot
    from matplotlib.patches import FancyArrowPatch

    height = rows(table)
    levels: dict[int, list[str]] = defaultdict(list)
    for room in sorted(height):
        levels[height[room]].append(room)
    # rooms stand near the middle of what uses them: two sweeps of barycentres leave few crossings
    place = {room: (i + 0.5) / len(level) for level in levels.values() for i, room in enumerate(level)}
    for _ in range(4):
        for k in sorted(levels, reverse=True):
            users = {r: [place[u] for u in table if r in table[u]] or [place[r]] for r in levels[k]}
            levels[k].sort(key=lambda r: sum(users[r]) / len(users[r]))
            place |= {r: (i + 0.5) / len(levels[k]) for i, r in enumerate(levels[k])}
    figure, axis = pyplot.subplots(figsize=(11, 1.15 * len(levels)))
    for room, others in table.items():
        for other, files in others.items():
            arrow = FancyArrowPatch(
                (place[room], height[room]), (place[other], height[other]), arrowstyle="-|>", mutation_scale=9,
                shrinkA=12, shrinkB=13, linewidth=0.5 + 0.15 * min(files, 10), color="0.55", alpha=0.7,
                connectionstyle="arc3,rad=0.06", linestyle="--" if (room, other) == ("pipeline", NAMED) else "-",
            )  # fmt: skip
            axis.add_patch(arrow)
    for room in table:
        box = dict(boxstyle="round,pad=0.35", facecolor="#f4efe6", edgecolor="#6b5b45")
        axis.text(place[room], height[room], room, ha="center", va="center", fontsize=9.5, bbox=box)
    axis.set(xlim=(0, 1), ylim=(-0.5, len(levels) - 0.5))
    axis.axis("off")
    figure.savefig(path, dpi=130, bbox_inches="tight")


def main() -> None:
    rooms = sources()
    table = arrows(rooms)
    draw(table, ROOT / "docs" / "architecture.png")
    document = ROOT / "docs" / "architecture.md"
    before, rest = document.read_text().split(BEGIN)
    document.write_text(before + BEGIN + page(rooms, table) + END + rest.split(END)[1])
    print(f"{len(rooms)} rooms in {1 + max(rows(table).values())} rows: docs/architecture.md, docs/architecture.png")


if __name__ == "__main__":
    sys.exit(main())
