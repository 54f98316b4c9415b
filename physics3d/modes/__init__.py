"""The solver without a grid: vibration modes of a body that is held or floats freely and touches nothing."""
