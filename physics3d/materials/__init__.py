"""Constitutive models: deformation and its history in, stress out; one per file, of no solver."""
