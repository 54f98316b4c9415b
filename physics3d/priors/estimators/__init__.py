"""What a video is pulled to, given a prior: estimators of the gradient of distillation."""
