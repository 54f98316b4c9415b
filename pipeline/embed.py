"""Pictures, films and curves as text, so that a page holds them itself."""

import base64
import html
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent / "pages"
WIDEST = 900  # of a picture [px]
FILM, MOST = 360, 90  # of a film: width [px], and frames
QUALITY = 82


def page(template: str, **values: Any) -> str:
    """A template of pages/ filled in; what is inserted is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    engine = Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    engine.filters |= {"number": number, "seconds": seconds}
    engine.globals |= {"source": lambda name: (HERE / name).read_text()}
    return engine.get_template(template).render(**values)


def picture(path: Path, widest: int = WIDEST) -> str:
    """A file of a picture as a data address, JPEG, at most so wide [px]."""
    from PIL import Image

    with Image.open(path) as image:
        flat = image.convert("RGBA")
        white = Image.new("RGBA", flat.size, "white")
        made = Image.alpha_composite(white, flat).convert("RGB")
        made.thumbnail((widest, 4 * widest))
        return _jpeg(made)


def film(frames: np.ndarray, fps: float) -> dict[str, Any]:
    """uint8 [t, h, w, 3] -> one picture with all frames in rows, and where they are in it; long ones lose frames."""
    from PIL import Image

    every = math.ceil(len(frames) / MOST)
    kept = frames[::every]
    height, width = kept.shape[1:3]
    small = min(1.0, FILM / width)
    size = max(1, round(width * small)), max(1, round(height * small))
    columns = math.ceil(math.sqrt(len(kept)))
    sheet = Image.new("RGB", (columns * size[0], math.ceil(len(kept) / columns) * size[1]))
    for i, frame in enumerate(kept):
        image = Image.fromarray(np.ascontiguousarray(frame)).resize(size, Image.Resampling.LANCZOS)
        sheet.paste(image, (i % columns * size[0], i // columns * size[1]))
    place = {"frames": len(kept), "columns": columns, "width": size[0], "height": size[1], "fps": fps / every}
    return {"sheet": _jpeg(sheet), "place": place}


def curve(points: Sequence[tuple[float, float]], width: int = 240, height: int = 90) -> str:
    """A line over its steps as SVG, with the least and the largest of both axes."""
    x, y = np.asarray(points, float).T
    low, high = float(y.min()), float(y.max())
    across = (x - x.min()) / max(float(np.ptp(x)), 1e-300) * (width - 2) + 1
    up = (height - 16) - (y - low) / max(high - low, 1e-300) * (height - 32) if high > low else y * 0 + height / 2
    path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, up))
    label = lambda a, b, text, anchor: (
        f'<text class="tick" x="{a}" y="{b}" text-anchor="{anchor}">{html.escape(text)}</text>'
    )
    return (
        f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}" role="img">'
        f'<line class="axis" x1="0" x2="{width}" y1="{height - 14}" y2="{height - 14}"/>'
        f'<polyline class="curve" points="{path}"/>'
        + label(0, 10, number(high) if low == high else f"{number(low)} to {number(high)}", "start")
        + label(0, height - 2, number(float(x.min())), "start")
        + label(width, height - 2, number(float(x.max())), "end")
        + label(width, 10, f"last {number(float(y[-1]))}", "end")
        + "</svg>"
    )


def number(value: float | None) -> str:
    return "–" if value is None else "∞" if math.isinf(value) else f"{value:.4g}"


def seconds(value: float) -> str:
    return f"{value:.1f} s" if value < 120 else f"{value / 60:.1f} min"


def raw(array: np.ndarray) -> str:
    """Numbers as they lie in memory, little endian, in base64."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _jpeg(image: Any) -> str:
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"
