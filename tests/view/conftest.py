"""What tests of the page that is pulled at have in common."""

import pytest


@pytest.fixture(autouse=True)
def unhurried(monkeypatch):
    """However busy this machine is: what a call has no time for it leaves out, and the body lags behind the clock."""
    monkeypatch.setattr("physics3d.view.live.LONGEST", 1e9)
