"""Fixtures that all tests share."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# A busy machine is slow, which is no fault of the code: no test is timed.
settings.register_profile("calm", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("calm")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; tests that ask for it are skipped where it is absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TILESTREAM_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}: set TILESTREAM_DATA to their folder")
    return folder
