"""A lens that bends straight lines, and the picture that a pinhole would have taken in its place.

    x = X/Z, y = Y/Z,  r^2 = x^2 + y^2
    c(r) = (1 + k1 r^2 + k2 r^4 + ...) / (1 + d1 r^2 + d2 r^4 + ...)
    x_d = c x + 2 p1 x y + p2 (r^2 + 2 x^2)            y_d = c y + p1 (r^2 + 2 y^2) + 2 p2 x y
    u = fx x_d + skew y_d + cx                         v = fy y_d + cy                         [px]

which holds COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV and OpenCV's first eight coefficients (pixel centres
are at integer + 0.5 here). The pinhole has as many pixels and looks as far to each side as all of them are in the
picture: nothing is invented at the rim, and little is lost. Brown (1966); Heikkilä and Silvén (1997).
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NoReturn

import numpy as np
from jaxtyping import Float32, Float64

NOTHING = 0.01  # a shift below this is none: sampling the picture again would cost more [px]
SHORTEST = 0.04  # focal length as a share of the width: 170 degrees
OFF_CENTRE = 2.0  # of the optical axis, as a share of the width: cropped pictures have it outside, but not far
RIM = 200  # places along each side of the picture at which its rim is looked at


@dataclass(frozen=True, kw_only=True)
class Lens:
    width: int  # [px]
    height: int  # [px]
    fx: float  # [px]
    fy: float  # [px]
    cx: float  # [px], width/2 is the middle
    cy: float  # [px]
    skew: float = 0.0  # [px]
    radial: tuple[float, ...] = ()  # k1, k2, ...
    denominator: tuple[float, ...] = ()  # d1, d2, ...
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2

    def check(self, name: str) -> None:
        """Raise ValueError naming the picture if sizes, focal lengths or coefficients cannot be."""
        numbers = (self.fx, self.fy, self.cx, self.cy, self.skew, *self.radial, *self.denominator, *self.tangential)
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name}: its camera holds NaN or infinity: {numbers}; solve it again")
        if self.width < 1 or self.height < 1 or not (self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"{name}: size {self.width} x {self.height} and focal length {self.fx:g}, {self.fy:g} must be positive"
            )
        if self.fx < SHORTEST * self.width or self.fy < SHORTEST * self.height:
            raise ValueError(
                f"{name}: a focal length of {self.fx:g}, {self.fy:g} px sees nearly half of the world at "
                f"{self.width} x {self.height}; give pixels, not shares of the width or millimetres"
            )
        if not (abs(self.cx / self.width - 0.5) < OFF_CENTRE and abs(self.cy / self.height - 0.5) < OFF_CENTRE):
            raise ValueError(
                f"{name}: the middle of the lens, cx {self.cx:g} and cy {self.cy:g}, is far outside of "
                f"{self.width} x {self.height} pixels; give pixels from the upper left corner"
            )

    def resized(self, width: int, height: int) -> "Lens":
        """The same view with other pixels."""
        a, b = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * a,
            cx=self.cx * a,
            skew=self.skew * a,
            fy=self.fy * b,
            cy=self.cy * b,
        )

    def distort(self, xy: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """(x, y) -> (x_d, y_d)."""
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        c = _series(self.radial, r2) / _series(self.denominator, r2)
        p1, p2 = self.tangential
        return np.stack(
            [c * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), c * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
        )

    def pixels(self, xy: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2"]:
        """Where the picture shows what is at (x, y) [px]."""
        bent = self.distort(xy)
        return np.stack(
            [self.fx * bent[..., 0] + self.skew * bent[..., 1] + self.cx, self.fy * bent[..., 1] + self.cy], -1
        )

    def directions(self, uv: Float64[np.ndarray, "*n 2"], name: str) -> Float64[np.ndarray, "*n 2"]:
        """The inverse of `pixels`, by Newton's method. Raises ValueError naming the picture where there is none."""
        y = (uv[..., 1] - self.cy) / self.fy
        start = np.stack([(uv[..., 0] - self.cx - self.skew * y) / self.fx, y], -1)
        xy = start
        with np.errstate(all="ignore"):
            for _ in range(20):
                step = np.linalg.solve(self._slope(xy), (self.pixels(xy) - uv)[..., None])[..., 0]
                xy = xy - step
            wrong = np.abs(self.pixels(xy) - uv).max()
        if not wrong < NOTHING:
            self._refuse(name)
        return xy

    def pinhole(self, name: str) -> "Lens":
        """The lens without distortion whose picture lies inside this one's; this one where nothing would move."""
        steps = np.linspace(0, 1, 33)
        grid = np.stack(np.meshgrid(steps * self.width, steps * self.height), -1)
        plain = replace(self, skew=0.0, radial=(), denominator=(), tangential=(0.0, 0.0))
        straight = (grid - (self.cx, self.cy)) / (self.fx, self.fy)
        if np.abs(self.pixels(straight) - grid).max() < NOTHING:
            return plain
        t = np.linspace(0, 1, RIM)
        zero, one = np.zeros(RIM), np.ones(RIM)
        size = (self.width, self.height)
        left, right, top, bottom = (
            self.directions(np.stack(side, -1) * size, name) for side in ((zero, t), (one, t), (t, zero), (t, one))
        )
        low = np.array([left[:, 0].max(), top[:, 1].max()])
        high = np.array([right[:, 0].min(), bottom[:, 1].min()])
        inside = np.stack(np.meshgrid(*(low + steps[:, None] * (high - low)).T), -1)
        if not (high > low).all() or not np.linalg.det(self._slope(inside)).min() > 0:
            self._refuse(name)
        f = size / (high - low)
        c = -low * f
        return replace(plain, fx=float(f[0]), fy=float(f[1]), cx=float(c[0]), cy=float(c[1]))

    def _refuse(self, name: str) -> NoReturn:
        raise ValueError(
            f"{name}: the lens distortion {self.radial} {self.denominator} {self.tangential} folds the picture over "
            "itself before its rim; solve the camera again, with fewer coefficients"
        )

    def _slope(self, xy: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 2 2"]:
        """d pixels / d (x, y), by central differences."""
        h = 1e-6
        columns = [(self.pixels(xy + e) - self.pixels(xy - e)) / (2 * h) for e in h * np.eye(2)]
        return np.stack(columns, -1)


def undistorted(
    planes: list[Float32[np.ndarray, "h w ..."]], lens: Lens, name: str
) -> tuple[list[Float32[np.ndarray, "h w ..."]], Lens]:
    """Pictures (colour, matte) taken by `lens`, in 0..255 -> the same by its pinhole, and that pinhole."""
    import cv2

    pinhole = lens.pinhole(name)
    where = _where(lens, pinhole)
    if where is None:
        return planes, pinhole
    u, v = where
    moved = [cv2.remap(p, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for p in planes]
    return [np.clip(m, 0, 255) for m in moved], pinhole  # a cubic overshoots at edges


@lru_cache(maxsize=2)
def _where(lens: Lens, pinhole: Lens) -> tuple[np.ndarray, np.ndarray] | None:
    """Where in the picture of `lens` each pixel of the pinhole's lies, OpenCV's indices; None: in the same place."""
    if replace(lens, skew=0.0, radial=(), denominator=(), tangential=(0.0, 0.0)) == pinhole:
        return None
    v, u = np.meshgrid(np.arange(pinhole.height) + 0.5, np.arange(pinhole.width) + 0.5, indexing="ij")
    xy = np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy], -1)
    uv = (lens.pixels(xy) - 0.5).astype(np.float32)
    return np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])


def _series(coefficients: tuple[float, ...], r2: np.ndarray) -> np.ndarray:
    """1 + k1 r^2 + k2 r^4 + ..."""
    total = np.zeros_like(r2)
    for k in reversed(coefficients):
        total = (total + k) * r2
    return 1 + total
