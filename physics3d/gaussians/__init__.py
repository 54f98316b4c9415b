"""Gaussians: what they are, how they are drawn, fitted to photographs and carried by particles."""
