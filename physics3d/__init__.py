"""Physics3D: from photographs to a moving, measured 3D Gaussian model. Needs torch and Warp, not Prefect, Hydra or MLflow."""
