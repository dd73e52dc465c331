"""The exported names, and nothing else."""

import subprocess
import sys

import halfwidth as hw

NAMES = [
    "BadLog",
    "BadRecord",
    "BadShape",
    "BadValue",
    "Box",
    "Cloud",
    "DataQualityWarning",
    "Estimate",
    "Estimator",
    "Gaussian",
    "HalfwidthError",
    "Linear",
    "Missing",
    "Mixed",
    "Nonlinear",
    "Normal",
    "Record",
    "Recursive",
    "Refused",
    "Status",
    "Uniform",
    "Unsolved",
    "__version__",
    "estimate",
    "score",
    "simulate",
]


def test_exported_names():
    assert sorted(hw.__all__) == sorted(NAMES)
    for name in hw.__all__:
        assert getattr(hw, name) is not None
    assert set(dir(hw)) == set(hw.__all__)


def test_an_unknown_name_is_an_attribute_error():
    assert not hasattr(hw, "Kalman")


def test_importing_loads_no_optional_library():
    heavy = ["scipy", "pandas", "polars", "pyarrow", "matplotlib", "narwhals", "typer", "highspy", "piqp"]
    code = (
        f"import sys, halfwidth; halfwidth.Linear; halfwidth.estimate; print([m for m in {heavy} if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
