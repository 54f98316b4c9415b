"""What leaves the project: the moving Gaussians as files that other programs read, one format per file, and a film."""
