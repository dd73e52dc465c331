"""The estimators, one file a family. To export one, add its name and file here; the laws then run over it."""

import importlib
from typing import Any

#: Exported estimators and the module of each; loaded when first used.
ESTIMATORS: dict[str, str] = {
    "KalmanFilter": "kalman",
    "KalmanSmoother": "kalman",
    "ExtendedKalman": "nonlinear",
    "UnscentedKalman": "nonlinear",
    "ParticleFilter": "particle",
    "BKF1": "loss",
    "BKF2": "loss",
    "GPB": "loss",
    "RBPF": "loss",
    "FearnheadClifford": "loss",
    "Runnalls": "loss",
    "BeamSearch": "loss",
    "BatchLP": "map",
    "SequentialLP": "sequential",
    "Window": "window",
    "Hull": "hull",
    "Posterior": "posterior",
    "Constrained": "constrain",
    "MixedFilter": "mixed",
    "MixedWindow": "mixed_window",
    "IntervalFilter": "sets",
    "ZonotopeFilter": "sets",
    "ConstrainedZonotopeFilter": "sets",
    "EllipsoidFilter": "sets",
}


def load(name: str) -> Any:
    """Return the class of an exported estimator."""
    return getattr(importlib.import_module(f"halfwidth.methods.{ESTIMATORS[name]}"), name)
