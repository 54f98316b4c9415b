"""What the reverse pass of a Warp kernel computes again.

Generated adjoints evaluate every function once more on each level of calls. What costs most is therefore written as one
function with one adjoint, and marked `without_replay`.
"""

import warp as wp


def without_replay(function: wp.Function) -> wp.Function:
    """`function`, not evaluated again in the reverse pass of its caller, to whom its values are then unknown: for
    functions whose results are only stored (by a function without replay as well) or added."""
    function.skip_replay = True
    return function
