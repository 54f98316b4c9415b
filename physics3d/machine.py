"""The machine and the versions behind a measurement, in one line."""

import os
import platform
from pathlib import Path


def machine(device: str) -> str:
    """E.g. "AMD EPYC, 2 cores, Python 3.11.7, torch 2.14.1, warp 1.19.0"; the GPU's name where the device is one."""
    import torch
    import warp as wp

    where = torch.cuda.get_device_name() if device.startswith("cuda") else f"{_cpu()}, {os.cpu_count()} cores"
    return f"{where}, Python {platform.python_version()}, torch {torch.__version__}, warp {wp.__version__}"


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
