"""One Prefect server and one empty MLflow database for all whole runs of the tests.

All of them run behind a proxy that answers nobody: whatever talks to this machine must go round it.
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.server import server
from pipeline.tracking import database

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent


@pytest.fixture(scope="session")
def prefect(tmp_path_factory) -> Iterator[dict[str, str]]:
    """One Prefect server for all runs: what they need in their environment."""
    before = dict(os.environ)
    os.environ |= dict.fromkeys(("http_proxy", "HTTP_PROXY", "https_proxy", "HTTPS_PROXY"), "http://127.0.0.1:9")
    os.environ |= {"no_proxy": "example.org", "NO_PROXY": ""}
    with server(tmp_path_factory.mktemp("prefect"), meanwhile=lambda: None):
        yield {**os.environ, "PYTHONPATH": f"{ROOT}:{HERE}", "OMP_NUM_THREADS": "1"}
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture(scope="session")
def empty_record(tmp_path_factory) -> Path:
    """An MLflow database with nothing in it: copying it is quicker than having each run make its own."""
    from mlflow.tracking import MlflowClient

    folder = tmp_path_factory.mktemp("mlflow")
    MlflowClient(database(folder)).search_experiments()
    return folder / "mlflow.db"


@pytest.fixture
def folder(tmp_path, empty_record) -> Path:
    shutil.copy(empty_record, tmp_path)
    return tmp_path
