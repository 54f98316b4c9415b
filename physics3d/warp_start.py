"""The start of Warp: the same for solver, renderer and driver, whoever comes first.

Compiler flags are of the whole process and decide how a kernel rounds. Whoever launches kernels calls this first, so
that a result does not depend on what else has run in the process.
"""

import warp as wp

MULTIPLY_ADD = "-ffp-contract=fast"  # one rounding for a b + c where the processor can, on the CPU as on CUDA


def start_warp() -> None:
    """Before anything else of Warp is touched, as often as one likes. Without a banner; a quieter level stays."""
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    flags = wp.config.cpu_compiler_flags or ""
    if MULTIPLY_ADD not in flags:
        wp.config.cpu_compiler_flags = f"{flags} {MULTIPLY_ADD}".strip()
    wp.init()
