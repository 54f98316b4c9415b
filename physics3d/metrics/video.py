"""VMAF (Netflix, v0.6.1): perceived quality of a whole clip, by the libvmaf inside ffmpeg, on a 0..1 scale.

Identical clips give about 0.998. It looks at luma and at differences between consecutive frames, so it punishes
motion that is not the reference's; like the others it can be fooled by a still where little moves.
"""

import json
import tempfile
from pathlib import Path

from jaxtyping import UInt8
from torch import Tensor

from physics3d.metrics.image import check_pair
from physics3d.video import run_ffmpeg

SMALLEST = 32  # [px]


def vmaf(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> tuple[float | None, str]:
    """(mean over frames / 100, "") or (None, reason) where not supported. ValueError for unequal shapes."""
    check_pair(video, reference)
    h, w = video.shape[1:3]
    if min(h, w) < SMALLEST:
        return None, f"VMAF needs both sides >= {SMALLEST} px, the pictures are {w} x {h}"
    with tempfile.TemporaryDirectory() as folder:
        command = []
        for name, frames in (("distorted", video), ("reference", reference)):  # libvmaf wants them in this order
            (Path(folder) / name).write_bytes(frames.contiguous().numpy().tobytes())
            command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{w}x{h}", "-r", "25", "-i", name]
        graph = (
            "[0:v]format=yuv444p[d];[1:v]format=yuv444p[r];[d][r]libvmaf=log_fmt=json:log_path=vmaf.json:n_threads=2"
        )
        command += ["-lavfi", graph, "-f", "null", "-"]
        try:
            run_ffmpeg(command, folder=Path(folder))
        except RuntimeError as error:
            return None, f"VMAF: {error}; its libvmaf may be missing"
        pooled = json.loads((Path(folder) / "vmaf.json").read_text())["pooled_metrics"]
    return float(pooled["vmaf"]["mean"]) / 100, ""
