"""Physics3D: from photographs to a moving, measured 3D Gaussian model; needs torch and Warp, no Prefect or MLflow."""
