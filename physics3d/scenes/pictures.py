"""Any picture file -> colour in 0..255, its matte, and the turn that its EXIF asks for.

What a file stores, and what it means here:

    8 bits, palette, CMYK, ...          0..255, black to white, as it is
    16 bits                             0..65535
                                        (14 bits or fewer in them: taken as they are, and said)
    floating point                      0..1; 0..255 or 0..65535 where the largest number leaves no other reading
    alpha, also of a palette            0..1, the matte; colours multiplied by it in the file are divided again

The turn is the EXIF orientation 1..8 (1: none). It is not applied here: a camera file may speak of the picture as it
is stored or as it is shown, and only whoever knows the camera can tell. Pillow reads the files, OpenCV those that
Pillow cannot (16 bits or floating point with several channels), or would cut to 8 bits.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

PHOTOGRAPHS = (
    ".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".webp", ".avif", ".tif", ".tiff", ".bmp", ".jp2", ".gif",
    ".ppm", ".pgm", ".pnm",
)  # fmt: skip
UNREAD = (
    ".heic",
    ".heif",
    ".dng",
    ".cr2",
    ".cr3",
    ".nef",
    ".arw",
    ".raf",
    ".orf",
    ".rw2",
    ".exr",
)  # formats to convert
TURN = 0x0112  # the EXIF tag of the orientation
NARROW = 16383  # a picture of 16 bits with no larger number is dark, or of a camera of 12 or 14 bits
BELOW = 0.2  # how far below black a number may be, as a share of white: sharpening and cubic sampling ring
QUARTER = (5, 6, 7, 8)  # orientations that exchange width and height


@dataclass(frozen=True, kw_only=True)
class Picture:
    color: Float32[np.ndarray, "h w 3"]  # 0..255, sRGB, as stored
    alpha: Float32[np.ndarray, "h w"] | None  # 0..1; None where the file has none
    turn: int  # EXIF orientation, 1..8
    remarks: tuple[str, ...] = ()  # what the user should know of how the file was read

    @property
    def size(self) -> tuple[int, int]:
        """Width and height as stored [px]."""
        return self.color.shape[1], self.color.shape[0]

    @property
    def shown_size(self) -> tuple[int, int]:
        """Width and height after the turn [px]."""
        w, h = self.size
        return (h, w) if self.turn in QUARTER else (w, h)

    def shown(self) -> "Picture":
        """The picture as a viewer shows it, with nothing left to turn."""
        alpha = None if self.alpha is None else _turned(self.alpha, self.turn)
        return Picture(color=_turned(self.color, self.turn), alpha=alpha, turn=1, remarks=self.remarks)


def read_picture(path: Path) -> Picture:
    """Read one file. Raises ValueError naming it, in one line, if it is missing, empty, broken or of no known kind."""
    from PIL import Image, UnidentifiedImageError

    if not path.is_file():
        raise ValueError(f"there is no image {path}; restore it or drop its entry")
    if path.stat().st_size == 0:
        raise ValueError(f"the image {path} is empty (0 bytes); copy it again or drop its entry")
    if path.suffix.lower() in UNREAD:
        raise ValueError(f"cannot read {path}: convert {path.suffix} to JPEG or PNG first")
    turn = 1
    try:
        with Image.open(path) as file:
            has_more = _loses_bits(file)  # asked before anything is read: then Pillow no longer knows
            turn = file.getexif().get(TURN, 1)
            stored = _from_opencv(path) if has_more else _from_pillow(file)
    except UnidentifiedImageError:
        stored = _from_opencv(path)
    except Exception as error:  # PIL raises OSError, SyntaxError, zlib.error, DecompressionBombError, struct.error ...
        reason = " ".join(str(error).split())
        raise ValueError(f"cannot read the image {path}: {reason}; the file is broken, replace it") from error
    stored = stored[..., None] if stored.ndim == 2 else stored
    color = _to_255(stored, path)
    alpha = color[..., -1] / 255 if stored.shape[-1] in (2, 4) else None
    color = np.repeat(color[..., :1], 3, -1) if stored.shape[-1] <= 2 else color[..., :3]
    wide = stored.dtype.kind in "iu" and stored.dtype.itemsize > 1
    narrow = wide and 0 < int(stored.max(initial=0)) <= NARROW
    remarks = ("dark: of 16 bits, of which 14 or fewer are used; if the camera has no more, scale them up",) * narrow
    turn = turn if turn in range(1, 9) else 1
    return Picture(color=np.ascontiguousarray(color), alpha=alpha, turn=turn, remarks=remarks)


def is_picture(path: Path) -> bool:
    """Whether a file without an ending is a picture; of one with an ending, the ending says so."""
    from PIL import Image

    if path.suffix:
        return path.suffix.lower() in PHOTOGRAPHS
    try:
        with Image.open(path):
            return True
    except Exception:
        return False


def _loses_bits(file) -> bool:
    """Whether Pillow would keep the upper byte of 16 bits alone, as it does of PNG with several channels."""
    raw = file.tile[0][3] if file.tile else ""
    return file.mode in ("RGB", "RGBA", "LA") and "16" in str(raw[0] if isinstance(raw, tuple) else raw)


def _from_pillow(file) -> np.ndarray:
    """[h, w] or [h, w, 3 or 4], of the type that tells the range."""
    if file.mode == "F" or file.mode.startswith("I"):
        return np.asarray(file)
    if file.mode in ("LAB", "HSV"):  # these bands are not what their letters say in other modes
        raise ValueError(f"its colours are {file.mode}; save it as RGB")
    if file.mode == "La":  # multiplied by alpha
        file = file.convert("LA")
    if {"A", "a"} & set(file.getbands()) or "transparency" in file.info:
        return np.asarray(file.convert("RGBA"))
    return np.asarray(file.convert("RGB"))


def _from_opencv(path: Path) -> np.ndarray:
    """The same for what Pillow does not know. Raises ValueError naming the file."""
    import cv2

    try:  # not imread, which prints warnings
        stored = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        stored = None
    if stored is None or (stored.ndim == 3 and stored.shape[-1] > 4):
        raise ValueError(f"cannot read the image {path}: the file is broken, or of no known format; save it as PNG")
    if stored.ndim == 2 or stored.shape[-1] < 3:
        return stored
    return stored[..., [2, 1, 0, 3][: stored.shape[-1]]]


def _to_255(stored: np.ndarray, path: Path) -> Float32[np.ndarray, "h w c"]:
    """Whatever range the type and the largest number tell -> 0..255. Raises ValueError if they do not tell it."""
    if stored.dtype.kind == "f" and not np.isfinite(stored).all():
        raise ValueError(f"the image {path} holds NaN or infinite pixels; save it again")
    high, low = float(stored.max(initial=0)), float(stored.min(initial=0))
    if stored.dtype == bool:
        full = 1.0
    elif stored.dtype == np.uint8:
        full = 255.0
    elif stored.dtype.kind == "f":
        full = next((f for lowest, f in ((0, 1.0), (16, 255.0), (4096, 65535.0)) if lowest < high <= f), 0.0)
        full = 1.0 if high <= 0 else full
    else:  # 32 bits that hold no more than 16 are 16 bits in disguise: Pillow reads PGM so
        full = 65535.0 if high <= 65535 else float(np.iinfo(stored.dtype).max)
    if full == 0:
        raise ValueError(
            f"the image {path} holds floating point numbers up to {high:.4g}, which is neither 0..1 nor 0..255; "
            "save it with 8 or 16 bits"
        )
    if low < (-BELOW * full if stored.dtype.kind == "f" else 0):
        raise ValueError(f"the image {path} holds numbers down to {low:.4g}; save it with 8 or 16 bits")
    if full > 65535 and high < full / 256:
        raise ValueError(
            f"the image {path} has 32 bits and holds whole numbers up to {high:.4g}, of which all would be black; "
            "save it with 8 or 16 bits"
        )
    return np.clip(stored * np.float32(255 / full), 0, 255).astype(np.float32)


def _turned(array: np.ndarray, turn: int) -> np.ndarray:
    """Stored rows and columns -> shown ones; array [h, w, ...]."""
    if turn in QUARTER:
        array = array.swapaxes(0, 1)
    if turn in (2, 3, 6, 7):
        array = array[:, ::-1]
    if turn in (3, 4, 7, 8):
        array = array[::-1]
    return np.ascontiguousarray(array)


def photographs_in(folder: Path) -> list[Path]:
    """The pictures of a folder by name; not hidden ones, as macOS leaves them on other file systems (._IMG.jpg)."""
    files = (p for p in folder.iterdir() if not p.name.startswith(".") and p.is_file())
    return sorted(p for p in files if is_picture(p))
