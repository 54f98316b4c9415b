"""The solver on a grid: explicit and implicit MLS-MPM with its exact adjoint."""
