"""A few smooth fields of the whole body in place of its splines: modes of vibration, free to turn and to stretch.

    u(X) = sum_j s_j(X) q_j,    q_j in R^3,    s_j: the three components of modes of vibration and of static responses

Each component is a scalar field with a vector for an amplitude. A mode phi thus brings with it every A phi, A a 3 x 3
matrix, so that a part of the body that a large motion has turned still has its modes, in its own new directions: von
Tycowicz et al. (2013), "An efficient construction of reduced deformable objects". A free body has 1, X, Y, Z as well,
and so is every rigid motion one of its motions, exactly.

Fields that the others already hold are left out: singular values below DEPENDENT in the norm
|s|^2 = int |grad s|^2 + s^2/l^2, l the size of the body.
"""

import numpy as np
from jaxtyping import Float
from scipy import linalg, sparse

DEPENDENT = 1e-4  # of the largest


def turned(
    vectors: Float[np.ndarray, "n m"], gradient: sparse.csr_matrix, weight: Float[np.ndarray, " q"]
) -> Float[np.ndarray, "f k"]:
    """Components of fields (row 3 j + i: component i of function j), each field scaled to a unit gradient."""
    fields = vectors.reshape(-1, 3, vectors.shape[1])
    slopes = gradient @ fields.reshape(len(fields), -1)
    squares = (np.repeat(weight, 3) @ slopes**2).reshape(3, -1).sum(0)
    return (fields / np.sqrt(np.maximum(squares, 1e-300))).reshape(len(fields), -1)


def independent(
    scalars: Float[np.ndarray, "f k"],
    values: sparse.csr_matrix,
    gradient: sparse.csr_matrix,
    weight: Float[np.ndarray, " q"],
    length: float,
) -> Float[np.ndarray, "f r"]:
    """Orthonormal combinations of `scalars`, fields by their coefficients, in the norm above with l = `length` [m]."""
    slopes, fields = gradient @ scalars, values @ scalars
    gram = slopes.T @ (np.repeat(weight, 3)[:, None] * slopes) + fields.T @ (weight[:, None] * fields) / length**2
    value, vector = linalg.eigh(gram)
    kept = value > DEPENDENT**2 * value.max()
    return scalars @ (vector[:, kept] / np.sqrt(value[kept]))
