"""Where a scene comes from: files of every kind, photographs without cameras, and synthetic twins."""
