"""The exported names, and nothing else."""

import pathlib
import subprocess
import sys

import halfwidth as hw

NAMES = """
BKF1 BKF2 BadLog BadRecord BadShape BadValue BatchLP BeamSearch Bernoulli Both Bound Box Cloud Comparison
Constrained ConstrainedZonotopeFilter Coverage DataQualityWarning EllipsoidFilter Estimate Estimator ExtendedKalman
FearnheadClifford GPB Gaussian Halfspaces HalfwidthError Hull IntervalFilter KalmanFilter KalmanSmoother Learned
Linear LogTooBig Markov MemoryChoice Missing Mixed MixedFilter MixedWindow Nonlinear Normal ParticleFilter Posterior
RBPF Ranks Record Recursive Refused Runnalls SequentialLP Shaped Status Uniform UnscentedKalman Unsolved Window
ZonotopeFilter __version__ bound choose_memory compare coverage ensemble_interval estimate forecast from_continuous learn
ranks resume score simulate stream
"""


def test_exported_names():
    assert sorted(hw.__all__) == sorted(NAMES.split())
    for name in hw.__all__:
        assert getattr(hw, name) is not None
    assert set(dir(hw)) == set(hw.__all__)


def test_an_unknown_name_is_an_attribute_error():
    assert not hasattr(hw, "Kalman")


def test_importing_loads_no_optional_library():
    heavy = ["scipy", "pandas", "polars", "pyarrow", "matplotlib", "narwhals", "typer", "highspy", "piqp", "clarabel"]
    code = (
        f"import sys, halfwidth; halfwidth.Linear; halfwidth.estimate; print([m for m in {heavy} if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_functions_keep_their_names_whatever_was_imported_first():
    code = "import halfwidth.estimate, halfwidth.learn, halfwidth.score, halfwidth as hw; print(callable(hw.estimate), callable(hw.learn))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["True", "True"]


def test_type_checkers_see_every_public_name():
    for package in (hw, hw.vehicle):
        source = pathlib.Path(package.__file__).read_text()
        for name in package.__all__:
            assert name == "__version__" or f"import {name} as {name}\n" in source, name


def test_the_reference_has_every_public_name():
    reference = (pathlib.Path(__file__).parents[1] / "docs" / "reference.md").read_text().split()
    for package in (hw, hw.vehicle):
        for name in package.__all__:
            module = getattr(getattr(package, name), "__module__", None)
            assert module is None or {module, f"{module}.{name}"} & set(reference), f"{module}.{name}"
