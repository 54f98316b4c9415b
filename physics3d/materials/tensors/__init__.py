"""Functions of 3x3 matrices that stay exact near the identity and differentiable at repeated stretches.

Every argument is a deviation from the identity (H = F - I, X = b - I), because 1 + x in float32 loses x below 6e-8.
Derivatives are those of the tensor function, never of single eigenvectors, so equal eigenvalues are nothing special:

    f(S) = Q f(l) Q^T,   adjoint of S = Q [K o (Q^T sym(A) Q)] Q^T,   K_ij = (f_i - f_j)/(l_i - l_j)   (Daleckii, Krein)

Names that take `real` are memoised factories: given wp.float32 or wp.float64 they return the Warp function. The others
take many matrices as a tensor. Higham, Functions of Matrices (2008), sec. 3.2.
"""
