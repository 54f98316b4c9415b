"""From Gaussians on the surface to a body with an inside: particles with a volume each."""
