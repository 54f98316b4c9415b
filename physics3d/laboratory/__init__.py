"""Material parameters from tables of a test machine: reading, fit, intervals, page."""
