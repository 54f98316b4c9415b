"""Photographs out of a video: the sharpest frame (variance of the Laplacian) of each of so many equal stretches.

Frames come turned as the video's rotation says. Browsers and pipes write no number of frames into the header (webm,
mkv), so that they are counted first.
"""

from pathlib import Path

import numpy as np

VIDEOS = (
    ".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp", ".wmv", ".ogv",
)  # fmt: skip


def sharpest_frames(video: Path, target: Path, count: int, longest_side: int, log) -> None:
    """Write up to `count` frames into `target`, reduced to `longest_side` [px]. Raises ValueError naming the video."""
    import cv2

    if not video.is_file():
        raise ValueError(f"no video at {video}; give it: make run SCENE=photos DATA=<folder or video>")
    reader = cv2.VideoCapture(str(video.absolute()))  # no name is then a protocol
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    if total <= 0 and reader.isOpened():
        total = _counted(video)
    best: dict[int, float] = {}
    read = 0
    for i in log.progress(range(total), "choosing frames"):
        good, frame = reader.read()
        if not good:
            break
        read = i + 1
        factor = longest_side / max(frame.shape[:2])
        if factor < 1:
            frame = cv2.resize(frame, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        stretch = i * min(count, total) // total
        sharp = float(np.var(cv2.Laplacian(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), cv2.CV_32F)))
        if sharp > best.get(stretch, -1.0):
            best[stretch] = sharp
            _write(target / f"frame_{stretch:04d}.jpg", frame)
    reader.release()
    if not best:
        raise ValueError(f"cannot read a frame of {video}; convert it to MP4 (H.264), or extract photographs")
    if read < 0.9 * total:
        log.warn(f"{video} ends after {read} of the {total} frames that it says it has; it may be cut short")


def _counted(video: Path) -> int:
    """Frames of a video whose header does not say, by decoding it; 0 where it cannot be decoded."""
    import imageio_ffmpeg

    try:
        return imageio_ffmpeg.count_frames_and_secs(str(video.absolute()))[0]
    except RuntimeError:
        return 0


def _write(path: Path, frame: np.ndarray) -> None:
    import cv2

    if not cv2.imwrite(str(path), frame, [cv2.IMWRITE_JPEG_QUALITY, 97]):
        raise OSError(f"cannot write {path}; is the disk full?")
