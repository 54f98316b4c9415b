"""Which modules have their annotated shapes checked in tests."""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def with_checked_shapes() -> list[str]:
    """The modules of library and stages that have shapes in them, and no Warp kernels: those are another language.

    Where there is no shape there is nothing to check, and every call would cost as much as three of torch's."""
    files = [path for folder in ("physics3d", "stages") for path in sorted((ROOT / folder).rglob("*.py"))]
    plain = [path for path in files if path.name != "__init__.py" and "@wp." not in path.read_text()]
    shaped = [path for path in plain if "jaxtyping" in path.read_text()]
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in shaped]
