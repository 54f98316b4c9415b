"""Material parameters from video: roll out, render, ask the prior, step."""
