"""Settings of the test run; the shared cases stand in `tests/cases.py`."""

import importlib.util
import pathlib

import hypothesis
import pytest

hypothesis.settings.register_profile(
    "ci", deadline=None, derandomize=True, print_blob=True, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("ci")

DATA = pathlib.Path(__file__).resolve().parents[2] / "shared" / "data"
BENCHMARKS = pathlib.Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(scope="session")
def data():
    """Folder of real logs, skipped where it is absent."""
    if not DATA.is_dir():
        pytest.skip("the real logs are not here")
    return DATA


@pytest.fixture(scope="module")
def benchmark_named():
    """Return a benchmark as a module; what it imports from its neighbours is found beside it."""

    def loaded(name):
        spec = importlib.util.spec_from_file_location(f"bench_{name}", BENCHMARKS / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield loaded
