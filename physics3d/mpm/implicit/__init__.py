"""An implicit step of the grid: its equations, Newton, linear solvers, and its exact adjoint."""
