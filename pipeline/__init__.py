"""Runs the stages: command line, configuration, stored results, Prefect, MLflow."""
