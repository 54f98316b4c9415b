"""The import arrows of the architecture, read from the source with `ast`: who may know whom."""

import ast
from pathlib import Path

import draw_architecture
import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted(p for folder in ("physics3d", "stages", "pipeline") for p in (ROOT / folder).rglob("*.py"))
BOTTOM = (
    "physics3d.artifact",
    "physics3d.checks",
    "physics3d.video",
    "physics3d.pictures",
    "physics3d.log",
    "physics3d.checkpoint",
    "physics3d.journal",
    "physics3d.open3d_import",
    "physics3d.warp_types",
    "physics3d.warp_start",
    "physics3d.clusters",
    "physics3d.cores",
    "physics3d.trajectory",
    "physics3d.matter",
)
# what each room of the library may use beside itself and the bottom; rooms that are not listed may use all of these
ROOMS = {
    "physics3d.materials": (),
    "physics3d.boundaries": (),
    "physics3d.world": ("physics3d.materials", "physics3d.boundaries"),
    "physics3d.gaussians": (),
    "physics3d.mpm": ("physics3d.world", "physics3d.materials", "physics3d.boundaries"),
    "physics3d.modes": ("physics3d.world", "physics3d.materials", "physics3d.boundaries"),
    "physics3d.laboratory": ("physics3d.materials", "physics3d.learning"),
    "physics3d.priors": (),
    "physics3d.motion": (),
}
ORCHESTRATION = ("prefect", "mlflow", "hydra", "omegaconf")
# sam2 brings its own Hydra configuration files, which are read where its model is built
EXCEPTIONS = {("physics3d.segmentation", "hydra"), ("physics3d.segmentation", "omegaconf")}
HEAVY = (
    "diffusers",
    "transformers",
    "sam2",
    "open3d",
    "torchmetrics",
    "cv2",
    "matplotlib",
    "mlflow",
    "prefect",
    "viser",
)


def module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports(tree: ast.AST) -> set[str]:
    """Dotted names imported anywhere below `tree`."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the arrows"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def below(name: str, packages: tuple[str, ...]) -> str | None:
    return next((p for p in packages if name == p or name.startswith(f"{p}.")), None)


@pytest.mark.parametrize("path", SOURCES, ids=module)
def test_arrows_point_downwards(path: Path):
    me, names = module(path), imports(ast.parse(path.read_text()))
    for name in names:
        if below(me, ("physics3d",)):
            assert not below(name, ("stages", "pipeline")), f"{me} imports {name}: the library knows no stages"
        if below(me, ("stages",)):
            assert not below(name, ("pipeline",)), f"{me} imports {name}: a stage does not know who runs it"
        if below(me, BOTTOM) and below(name, ("physics3d",)):
            assert below(name, BOTTOM), f"{me} imports {name}: the bottom layer imports nothing from the project"
        room = below(me, tuple(ROOMS))
        if room and below(name, ("physics3d",)):
            assert below(name, (room, *BOTTOM, *ROOMS[room])), f"{me} imports {name}: {room} does not know of that"


@pytest.mark.parametrize("path", SOURCES, ids=module)
def test_orchestration_lives_in_the_pipeline(path: Path):
    me = module(path)
    for name in imports(ast.parse(path.read_text())):
        used = below(name, ORCHESTRATION)
        excused = any(below(me, (package,)) and used == library for package, library in EXCEPTIONS)
        assert not used or excused or below(me, ("pipeline",)), f"{me} imports {name}; only pipeline/ may"


@pytest.mark.parametrize("path", SOURCES, ids=module)
def test_importing_costs_little(path: Path):
    """Heavy libraries are imported inside the functions that need them."""
    top = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.Import | ast.ImportFrom)]
    found = {name for node in top for name in imports(node) if below(name, HEAVY)}
    assert not found, f"{module(path)} imports {sorted(found)} at its top; move it into the function that needs it"


def test_the_page_of_the_architecture_is_that_of_the_code():
    """docs/architecture.md says what is there: `make architecture` after a file has moved."""
    rooms = draw_architecture.sources()
    table = draw_architecture.page(rooms, draw_architecture.arrows(rooms))
    written = (ROOT / "docs" / "architecture.md").read_text()
    # without the last two columns, which change with every line of code
    rows = [row.rsplit("|", 3)[0] for row in table.splitlines()]
    missing = [row for row in rows if row not in written]
    assert not missing, f"run `make architecture`; not on the page: {missing}"
