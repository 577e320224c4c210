"""Shared fixtures: where the real recordings are."""

import os
from pathlib import Path

import numba
import pytest
from hypothesis import HealthCheck, settings

# The quick profile draws the same examples in every run; the thorough one draws new ones:
# HYPOTHESIS_PROFILE=thorough make test
settings.register_profile(
    "quick", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("thorough", max_examples=500, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Two test processes share two cores; what several threads do is asked for where it matters."""
    numba.set_num_threads(1)


_BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of real recordings, from CELLQUANT_DATA or the shared folder beside the project."""
    folder = Path(os.environ.get("CELLQUANT_DATA", _BESIDE))
    if not folder.is_dir():
        pytest.skip(f"no real recordings: {folder} does not exist; set CELLQUANT_DATA")
    return folder
