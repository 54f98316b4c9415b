"""Boundary conditions: what holds, stops, pushes or moves a body; one per file, of no solver."""
