"""What others have published of the same things, for the page of `make compare`. Numbers only, with their source.

PAPER are the means that Physics3D (Liu et al. 2024, arXiv:2406.04338) prints for its real scenes. PANELS are ours, by
the measures of this project, of the comparison that the paper shows on its page (liuff19.github.io/Physics3D): each
method's video against the recorded one, frame by frame, as published, beside the first recorded frame, frozen.
"""

MEASURES = ("PSNR", "SSIM", "MS-SSIM", "VMAF")
PAPER = {
    "PhysDreamer": (13.89, 0.55, 0.37, 0.52),
    "PhysGaussian": (13.86, 0.57, 0.39, 0.59),
    "Physics3D": (14.72, 0.59, 0.49, 0.59),
    "Physics3D without the viscoelastic branch": (14.13, 0.53, 0.36, 0.52),
    "Physics3D without the elastoplastic branch": (13.53, 0.55, 0.41, 0.50),
}
PANELS = {  # method -> carnation, telephone
    "first frame, frozen": ((20.35, 0.872, 0.856, 0.47), (25.77, 0.820, 0.942, 0.68)),
    "DreamGaussian4D": ((22.21, 0.770, 0.867, 0.32), (22.36, 0.619, 0.852, 0.10)),
    "PhysDreamer": ((18.06, 0.562, 0.681, 0.06), (22.24, 0.645, 0.855, 0.14)),
    "PhysGaussian": ((17.12, 0.587, 0.691, 0.07), (21.52, 0.605, 0.831, 0.09)),
    "Physics3D": ((12.20, 0.427, 0.284, 0.00), (14.92, 0.494, 0.545, 0.00)),
}


def published() -> list[str]:
    """Lines of a page."""
    heads = [f"{thing}: {measure}" for thing in ("carnation", "telephone") for measure in MEASURES]
    numbers = lambda of: " | ".join(f"{value:g}" for value in of)
    return [
        "",
        "## What others have published",
        "",
        "No number of these tables compares with one above: theirs are of whole videos of a motion that was tuned or",
        "made up, seen by another camera than the recording's, ours of frames that nobody saw. In Physics3D's paper",
        "(Liu et al. 2024), means over its real scenes:",
        "",
        f"| method | {' | '.join(MEASURES)} |",
        "|---" * (len(MEASURES) + 1) + "|",
        *(f"| {method} | {numbers(of)} |" for method, of in PAPER.items()),
        "",
        "The videos that the paper's page shows beside the recorded ones, measured as everything here, without moving",
        "one onto the other:",
        "",
        f"| method | {' | '.join(heads)} |",
        "|---" * (len(heads) + 1) + "|",
        *(f"| {method} | {' | '.join(map(numbers, both))} |" for method, both in PANELS.items()),
        "",
        "A still picture is ahead of every published motion but one on PSNR, and of all on VMAF: of a motion these",
        "measures say little where pictures are not aligned.",
    ]
