"""A page in the browser: the moving Gaussians of a run, in the colours one asks for, and a poke simulated live."""
