"""What a video should look like: denoisers, and score distillation from them."""
