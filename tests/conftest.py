"""Settings of the test run; the shared cases stand in `tests/cases.py`."""

import pathlib

import hypothesis
import pytest

hypothesis.settings.register_profile(
    "ci", deadline=None, derandomize=True, print_blob=True, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("ci")

DATA = pathlib.Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def data():
    """Folder of real logs, skipped where it is absent."""
    if not DATA.is_dir():
        pytest.skip("the real logs are not here")
    return DATA
