"""Settings of the test run; the shared cases stand in `tests/cases.py`."""

import importlib.util
import pathlib

import hypothesis
import pytest

hypothesis.settings.register_profile(
    "ci", deadline=None, derandomize=True, print_blob=True, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("ci")

BENCHMARKS = pathlib.Path(__file__).resolve().parents[1] / "benchmarks"
DATA = pathlib.Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def data():
    """Folder of real logs, skipped where it is absent."""
    if not DATA.is_dir():
        pytest.skip("the real logs are not here")
    return DATA


@pytest.fixture(scope="session")
def bench():
    """Load a benchmark as a module; what it imports from its neighbours is found beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))

        def load(name):
            spec = importlib.util.spec_from_file_location(f"bench_{name}", BENCHMARKS / f"{name}.py")
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            return module

        yield load
