"""The answer: one frozen type for every estimator, with an honest status."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from halfwidth.array import Array, real
from halfwidth.errors import BadShape, Refused, Unsolved
from halfwidth.record import Labels
from halfwidth.spread import Normal, Shaped, Spread


class Status(enum.Enum):
    """How an estimate ended; the value is the message for the user."""

    OK = "solved"
    REDUCED = "solved with reduced accuracy"
    INFEASIBLE = "no trajectory fits the bounds"
    STALLED = "the iteration stopped before it converged"
    COLLAPSED = "the belief collapsed: nothing left explains the data"

    @property
    def good(self) -> bool:
        """Whether the numbers can be used."""
        return self in (Status.OK, Status.REDUCED)


@dataclass(frozen=True, eq=False)
class Estimate:
    """What an estimator found. Row k of everything is time ``t[k]``; what a method cannot know is None.

    Parameters
    ----------
    t : (T,) array
        Times of the record, s.
    x : (T, nx) array
        Point estimate of the state.
    spread : Box, Normal, Shaped, Both or Cloud, or None
        What is known beside the point.
    status : Status
    method : str
        The estimator with its settings, as it would be typed.
    q, r : (nx,) and (ny,) arrays or None
        Half-widths of the noise of state and output.
    Q, R : (nx,) and (ny,) arrays or None
        Variances of their Gaussian parts, where they were unknown.
    theta : (n_theta,) array or None
        Unknown entries of the model, in the order of ``model.theta_entries``.
    gamma : (T,) or (T, ny) array or None
        Probability that y was received.
    loglik : float or None
        Log-likelihood of the seen outputs, natural logarithm.
    names : tuple of str
        Names of the states.
    labels : Labels
        Where the record came from.
    info : mapping
        Details: iterations, residuals, seed, message, and what the method adds.
    """

    t: Array
    x: Array
    spread: Spread | None
    status: Status
    method: str
    q: Array | None = None
    r: Array | None = None
    theta: Array | None = None
    gamma: Array | None = None
    loglik: float | None = None
    names: tuple[str, ...] = ()
    labels: Labels = field(default_factory=Labels, repr=False)
    info: Mapping[str, Any] = field(default_factory=dict, repr=False)
    Q: Array | None = None
    R: Array | None = None

    @property
    def guaranteed(self) -> bool:
        """Whether the interval is proved to contain the state."""
        return self.spread is not None and self.spread.guaranteed

    @property
    def P(self) -> NDArray[np.float64] | None:
        """Covariance of the state (T, nx, nx) where the spread has one, else None."""
        return self.spread.P if isinstance(self.spread, Normal | Shaped) else None

    def interval(self, level: float = 0.9, *, of: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return ``(lo, hi)``, each (T, nx), that holds the state with probability `level`.

        A guaranteed box is the same at every level.

        Parameters
        ----------
        level : float
        of : (k, nx) or (nx,) array_like, optional
            Linear functionals of the state, one a row: the ends are then those of ``of @ x``, each (T, k).

        Raises
        ------
        Refused
            If the method gives a point only.
        BadShape
            If `of` does not fit the state.
        """
        if self.spread is None:
            raise Refused(f"`{self.method}` gives a point without a spread, so there is no interval")
        if of is None:
            return self.spread.interval(level)
        D = np.atleast_2d(real(of, "of"))
        if D.ndim != 2 or D.shape[1] != self.x.shape[1]:
            raise BadShape(f"`of` has shape {np.shape(of)}, (k, {self.x.shape[1]}) was expected: one functional a row")
        return self.spread.through(D).interval(level)

    def check(self) -> "Estimate":
        """Return the estimate itself.

        Raises
        ------
        Unsolved
            If the status is not good.
        """
        if not self.status.good:
            raise Unsolved(f"Status.{self.status.name}: {self.message}", hint=self.info.get("hint"))
        return self

    @property
    def message(self) -> str:
        """The status in words, with what the method had to say."""
        return str(self.info.get("message") or self.status.value)

    def to_frame(self, level: float | None = 0.9) -> Any:
        """Return a frame of the library the record came from: time, states, and their interval.

        Parameters
        ----------
        level : float or None
            Level of the columns ``<state>_lo`` and ``<state>_hi``; None leaves them away.

        Raises
        ------
        Missing
            If the record came as arrays and no frame library is installed.
        """
        from halfwidth.frame import write_frame

        return write_frame(self, level)

    def summary(self, level: float = 0.9) -> str:
        """Return a few lines of text: status, span, and each state's range and half-width."""
        from halfwidth.show import summary

        return summary(self, level)

    def plot(self, truth: Any = None, *, states: Any = None, level: float = 0.9, ax: Any = None) -> Any:
        """Draw each state with its band against time and return the matplotlib axes.

        Parameters
        ----------
        truth : (T, nx) array, Truth or None
        states : sequence of str or int, optional
            Which states; the first four if absent.
        level : float
            Level of the band.
        ax : axes or sequence of axes, optional

        Raises
        ------
        Missing
            If matplotlib is not installed.
        """
        from halfwidth.show import plot

        return plot(self, truth, states=states, level=level, ax=ax)

    def _repr_html_(self) -> str:
        from halfwidth.show import estimate_html

        return estimate_html(self)

    def __repr__(self) -> str:
        span = f"t = {self.t[0]:g} to {self.t[-1]:g} s" if len(self.t) else "no rows"
        return (
            f"Estimate({self.method}, {len(self.t)} rows, {span}, nx={self.x.shape[-1]}, "
            f"status={self.status.name}{', guaranteed' if self.guaranteed else ''})"
        )


class Newest(Estimate):
    """The newest row of a stream, an `Estimate` with T = 1 whose fields are built when they are asked for.

    ``_belief`` is the kernel's own object with t, x, P, loglik and code; building everything at each push would cost
    more than the push.
    """

    __slots__ = ("_belief",)
    _belief: Any
    method = "stream"
    names: tuple[str, ...] = ()
    labels = Labels()

    @cached_property
    def t(self) -> Array:
        """Time, (1,) s."""
        return np.array([self._belief.t])

    @cached_property
    def x(self) -> Array:
        """State, (1, nx)."""
        return np.asarray(self._belief.x)[None]

    @cached_property
    def spread(self) -> Spread | None:
        """Gaussian spread of the state."""
        return Normal.of(self.x, np.asarray(self._belief.P)[None], getattr(self._belief, "within", None))

    @property
    def status(self) -> Status:
        """Whether the push went well: code 2 contradicts a certainty, 3 left the range of floats, 4 fits no bounds."""
        code = self._belief.code
        return Status.OK if code < 2 else {2: Status.REDUCED, 4: Status.INFEASIBLE}.get(code, Status.COLLAPSED)

    @property
    def loglik(self) -> float | None:
        """Log-likelihood of everything pushed so far."""
        return float(self._belief.loglik)

    @property
    def gamma(self) -> Array | None:
        """Probability that y was received, where the stream's method knows it."""
        found = getattr(self._belief, "gamma", None)
        return None if found is None else np.atleast_1d(np.asarray(found))

    def __reduce__(self) -> Any:
        """Copy and pickle as a plain estimate, which holds no object of the kernel."""
        return Estimate, tuple(getattr(self, one.name) for one in fields(Estimate))

    @property
    def info(self) -> Mapping[str, Any]:
        """Number of rows pushed so far, and what the method has to say of the newest."""
        said = getattr(self._belief, "message", None)
        return {"rows": self._belief.rows} | ({} if said is None else {"message": said})
