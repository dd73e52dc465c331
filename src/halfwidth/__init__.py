"""State estimation for the real world: bounded noise, unknown half-widths, missing measurements.

The model, everywhere: ``E x[t] = A x[t-1] + B u[t] + w[t]``,  ``F y[t] = C x[t] + e[t]``, for the rows t of a record;
x0 is the state one step before the first row. Times are in seconds, angles in radians, everything else in the units of
the user. NaN in y is a missing entry.

`estimate(model, record, method)` is the one front door; every answer is an `Estimate` with a `Status`.
"""

from typing import TYPE_CHECKING

from halfwidth.lazy import lazy
from halfwidth.methods import ESTIMATORS

__version__ = "0.1.0"

#: Public names and the module of each, loaded when first used: importing the package stays fast.
_HOME: dict[str, str] = {
    "Uniform": "noise",
    "Gaussian": "noise",
    "Mixed": "noise",
    "Box": "spread",
    "Halfspaces": "spread",
    "Normal": "spread",
    "Both": "spread",
    "Cloud": "spread",
    "Shaped": "spread",
    "Bernoulli": "loss",
    "Markov": "loss",
    "Linear": "model",
    "Nonlinear": "model",
    "Record": "record",
    "Estimate": "result",
    "Status": "result",
    "from_continuous": "continuous",
    "estimate": "estimate",
    "simulate": "simulate",
    "score": "score",
    "coverage": "coverage",
    "Coverage": "coverage",
    "ranks": "coverage",
    "Ranks": "coverage",
    "stream": "stream",
    "resume": "stream",
    "forecast": "forecast",
    "ensemble_interval": "methods.window",
    "bound": "bound",
    "Bound": "methods._functional",
    "choose_memory": "methods.memory",
    "MemoryChoice": "methods.memory",
    "compare": "methods.choose",
    "Comparison": "methods.choose",
    "learn": "learn",
    "Learned": "methods._likelihood",
    "HalfwidthError": "errors",
    "BadShape": "errors",
    "BadValue": "errors",
    "BadRecord": "errors",
    "BadLog": "errors",
    "LogTooBig": "errors",
    "Refused": "errors",
    "Missing": "errors",
    "Unsolved": "errors",
    "DataQualityWarning": "errors",
    "Estimator": "methods._protocol",
    "Recursive": "methods._protocol",
} | {name: f"methods.{module}" for name, module in ESTIMATORS.items()}

__all__ = ["__version__", *sorted(_HOME)]

if TYPE_CHECKING:
    from halfwidth.bound import bound as bound
    from halfwidth.continuous import from_continuous as from_continuous
    from halfwidth.coverage import Coverage as Coverage
    from halfwidth.coverage import Ranks as Ranks
    from halfwidth.coverage import coverage as coverage
    from halfwidth.coverage import ranks as ranks
    from halfwidth.errors import BadLog as BadLog
    from halfwidth.errors import BadRecord as BadRecord
    from halfwidth.errors import BadShape as BadShape
    from halfwidth.errors import BadValue as BadValue
    from halfwidth.errors import DataQualityWarning as DataQualityWarning
    from halfwidth.errors import HalfwidthError as HalfwidthError
    from halfwidth.errors import LogTooBig as LogTooBig
    from halfwidth.errors import Missing as Missing
    from halfwidth.errors import Refused as Refused
    from halfwidth.errors import Unsolved as Unsolved
    from halfwidth.estimate import estimate as estimate
    from halfwidth.forecast import forecast as forecast
    from halfwidth.learn import learn as learn
    from halfwidth.loss import Bernoulli as Bernoulli
    from halfwidth.loss import Markov as Markov
    from halfwidth.methods._functional import Bound as Bound
    from halfwidth.methods._likelihood import Learned as Learned
    from halfwidth.methods._protocol import Estimator as Estimator
    from halfwidth.methods._protocol import Recursive as Recursive
    from halfwidth.methods.choose import Comparison as Comparison
    from halfwidth.methods.choose import compare as compare
    from halfwidth.methods.constrain import Constrained as Constrained
    from halfwidth.methods.hull import Hull as Hull
    from halfwidth.methods.kalman import KalmanFilter as KalmanFilter
    from halfwidth.methods.kalman import KalmanSmoother as KalmanSmoother
    from halfwidth.methods.loss import BKF1 as BKF1
    from halfwidth.methods.loss import BKF2 as BKF2
    from halfwidth.methods.loss import GPB as GPB
    from halfwidth.methods.loss import RBPF as RBPF
    from halfwidth.methods.loss import BeamSearch as BeamSearch
    from halfwidth.methods.loss import FearnheadClifford as FearnheadClifford
    from halfwidth.methods.loss import Runnalls as Runnalls
    from halfwidth.methods.map import BatchLP as BatchLP
    from halfwidth.methods.memory import MemoryChoice as MemoryChoice
    from halfwidth.methods.memory import choose_memory as choose_memory
    from halfwidth.methods.mixed import MixedFilter as MixedFilter
    from halfwidth.methods.mixed_window import MixedWindow as MixedWindow
    from halfwidth.methods.nonlinear import ExtendedKalman as ExtendedKalman
    from halfwidth.methods.nonlinear import UnscentedKalman as UnscentedKalman
    from halfwidth.methods.particle import ParticleFilter as ParticleFilter
    from halfwidth.methods.posterior import Posterior as Posterior
    from halfwidth.methods.sequential import SequentialLP as SequentialLP
    from halfwidth.methods.sets import ConstrainedZonotopeFilter as ConstrainedZonotopeFilter
    from halfwidth.methods.sets import EllipsoidFilter as EllipsoidFilter
    from halfwidth.methods.sets import IntervalFilter as IntervalFilter
    from halfwidth.methods.sets import ZonotopeFilter as ZonotopeFilter
    from halfwidth.methods.window import Window as Window
    from halfwidth.methods.window import ensemble_interval as ensemble_interval
    from halfwidth.model import Linear as Linear
    from halfwidth.model import Nonlinear as Nonlinear
    from halfwidth.noise import Gaussian as Gaussian
    from halfwidth.noise import Mixed as Mixed
    from halfwidth.noise import Uniform as Uniform
    from halfwidth.record import Record as Record
    from halfwidth.result import Estimate as Estimate
    from halfwidth.result import Status as Status
    from halfwidth.score import score as score
    from halfwidth.simulate import simulate as simulate
    from halfwidth.spread import Both as Both
    from halfwidth.spread import Box as Box
    from halfwidth.spread import Cloud as Cloud
    from halfwidth.spread import Halfspaces as Halfspaces
    from halfwidth.spread import Normal as Normal
    from halfwidth.spread import Shaped as Shaped
    from halfwidth.stream import resume as resume
    from halfwidth.stream import stream as stream

lazy(__name__, _HOME | {"vehicle": "vehicle", "fusion": "fusion"})
