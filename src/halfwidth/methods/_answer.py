"""What `Posterior` makes of a chain that the core has solved: an `Estimate`, or the parts that are asked for."""

from functools import cached_property
from typing import Any

import numpy as np

import halfwidth._core as _core
from halfwidth.array import Array
from halfwidth.methods._carry import Known, Start
from halfwidth.methods._noise_parts import uniform_part
from halfwidth.methods._protocol import Estimator, typed
from halfwidth.methods._sites import Sites
from halfwidth.model import Linear
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Box, Normal, Shaped, Spread

#: Moments that agree this well, in standard deviations, are good, and good enough to be used.
_FINE, _USABLE = 0.01, 0.1
#: Fewer effective nodes than this leave an integral over half-widths rough.
_FEW = 3.0
_WIDTHS = ("mean", "sd", "lo", "hi")


class Answer:
    """A chain, what the core found of it, and what that says, each part made when it is first asked for.

    Parameters
    ----------
    method : Estimator
    model, record, chain
        What was asked.
    found, handed : EpFound, EpHanded
        What it found, and what it hands on.
    code : int
        0, or 1: not converged, 2 and 3: nothing found.
    rate : float
        The rate of outliers or losses if it is told.
    """

    def __init__(
        self, method: Estimator, model: Linear, record: Record, chain: Sites, found: _core.EpFound,
        handed: _core.EpHanded, code: int, rate: float,
    ) -> None:  # fmt: skip
        self.method, self.model, self.record, self.chain = method, model, record, chain
        self.found, self.handed, self.code, self.rate = found, handed, code, rate
        self.sound = code < 2 and found["finite"]
        bounds = model.bounds
        self.within = (bounds.lo, bounds.hi) if isinstance(bounds, Box) else None
        moments: tuple[Array, Array] = (found["x"], found["P"]) if self.sound else self._fallback()
        self.x, self.P = moments
        if self.within is not None:
            inside = self.x[1:]
            np.minimum(np.maximum(inside, self.within[0], out=inside), self.within[1], out=inside)
        # mean, sd, and ends of 90 % of the half-widths, and of the variances that are unknown, each (p,)
        self.widths: Array = found["widths"].copy() if self.sound else self._no_widths()
        self.status = self._status()

    def amended(self, estimate: Estimate) -> "Answer":
        """Return the same with another estimate, which may differ in status and message."""
        other, said = object.__new__(Answer), self.said
        if "message" in estimate.info:
            said = said | {"message": estimate.info["message"]}
        other.__dict__.update(self.__dict__, estimate=estimate, status=estimate.status, said=said)
        return other

    def _status(self) -> Status:
        found = self.found
        if not self.sound:
            return Status.INFEASIBLE if self.code >= 2 else Status.STALLED
        residual = found["residual"]
        if residual > _USABLE:
            return Status.STALLED
        few = found["effective"] < _FEW if found["nodes"] > 1 else self.code == 1 and found["mode"].size > 0
        return Status.REDUCED if residual > _FINE or few else Status.OK

    @property
    def spread(self) -> Spread:
        """Spread of the rows of the record."""
        x, P = self.x[1:], self.P[1:]
        if not self.sound or (not self.chain.frame.q and self.chain.exact):
            return Normal.of(x, P, self.within)
        return Shaped(x, P, self.found["k3"][1:], self.found["k4"][1:], self.within)

    @property
    def s(self) -> Array:
        """Means of the half-widths, (nx + ny,); NaN where a noise has none, and where nothing was found."""
        p, uniform = self.model.nx + self.model.ny, self.chain.frame.uniform
        if not self.sound:
            return np.full(p, np.nan)
        mean = self.widths[0, :p]
        return mean if self.chain.frame.bounded else np.where(uniform[:p], mean, np.nan)

    @property
    def variances(self) -> Array | None:
        """Means of the variances where some are unknown, (nx + ny,), NaN elsewhere; None if there are none."""
        p, fitted = self.model.nx + self.model.ny, self.chain.frame.fitted
        if len(fitted) == p or not self.sound:
            return None
        return np.where(fitted[p:], self.widths[0, p:], np.nan)

    @cached_property
    def said(self) -> dict[str, Any]:
        """What a row of a stream tells of its window."""
        p, frame, widths = self.model.nx + self.model.ny, self.chain.frame, self.widths
        info: dict[str, Any] = {"notes": self._notes(p) if frame.unseen else []}
        if not self.sound:
            info["message"] = (
                f"{self.status.value}, or the iteration ran away from it; "
                "states are those of a Gaussian smoother with the same variances"
            )
        if widths.shape[1] > p:
            info["variances"] = dict(zip(_WIDTHS, widths[:, p:], strict=True))
            widths = widths[:, :p]
        info["half_widths"] = dict(zip(_WIDTHS, widths, strict=True))
        return info

    def _notes(self, p: int) -> list[str]:
        frame, names = self.chain.frame, np.array([*self.model.names.x, *self.model.names.y])
        lost = (frame.uniform | frame.fitted) & (self.chain.floor < frame.cap) & (frame.count == 0)
        return [
            f"{what} not identifiable: " + ", ".join(names[part])
            for what, part in (("bound", lost[:p]), ("variance", lost[p:]))
            if part.any()
        ]

    @cached_property
    def estimate(self) -> Estimate:
        """All of it."""
        model, record, found, sound = self.model, self.record, self.found, self.sound
        nx, p, fitted = model.nx, model.nx + model.ny, self.chain.frame.fitted
        info = dict(self.said)
        if not sound:
            info["hint"] = "wider half-widths, outliers=True, or missing outputs; BatchLP() names the rows in conflict"
        gamma = None
        outliers = model.loss is None and self.with_outliers
        if outliers and not sound:
            info |= {"outliers": [], "outlier_probability": np.where(record.seen, 0.0, np.nan)}
        elif self.with_outliers:
            share = np.where(record.seen, 0.0, np.nan)
            frame = self.chain.frame
            kept = frame.output >= 0
            share[frame.row[kept], frame.output[kept]] = found["out"][kept]
            if outliers:
                info |= {"outliers": _named(share, model, record), "outlier_probability": share}
            else:
                gamma = 1.0 - np.where(record.seen, share, 0.0)
        x, mean = self.x, self.widths[0]
        info |= {
            "x0": x[0].copy(),
            "rate": found["rate"] if sound else None,
            "residual": found["residual"],
            "sweeps": found["sweeps"],
            "nodes": found["nodes"],
            "effective": found["effective"] if sound else 0.0,
        }
        return Estimate(
            record.t,
            x[1:].copy(),
            self.spread,
            self.status,
            typed(self.method),
            q=mean[:nx].copy() if sound and uniform_part(model.w) is not None else None,
            r=mean[nx:p].copy() if sound and uniform_part(model.e) is not None else None,
            Q=mean[p : p + nx].copy() if sound and fitted[p : p + nx].any() else None,
            R=mean[p + nx :].copy() if sound and fitted[p + nx :].any() else None,
            gamma=gamma,
            loglik=found["log_evidence"] - found["log_prior"] - 0.5 * found["mode"].size * _LOG_2PI if sound else None,
            names=model.names.x,
            labels=record.labels,
            info=info,
        )

    @property
    def with_outliers(self) -> bool:
        """Whether rows may be outliers or lost."""
        return self.rate > 0

    @property
    def start(self) -> Start:
        """Where the mode is, for the next evaluation of this chain or of one that begins some rows later."""
        return Start(self.found["s"], self.handed)

    @property
    def tells(self) -> bool:
        """Whether there were nodes enough for `told`."""
        return bool(self.found["tells"])

    @property
    def told(self) -> Known:
        """What its rows tell of the half-widths."""
        return Known.of(self.found["told"])

    @property
    def _unfound(self) -> Array:
        return np.where(self.chain.free, self.chain.guess, self.chain.floor)

    def _no_widths(self) -> Array:
        s = self._unfound
        value = np.where(self.chain.frame.fitted, s**2, s)
        return np.array([value, np.zeros_like(s), value, value])

    def _fallback(self) -> tuple[Array, Array]:
        """Return the moments of the chain with every uniform replaced by a Gaussian of its variance."""
        chain, s = self.chain, self._unfound
        problem = dict(chain.problem, half0=np.maximum(chain.half0, 0.0))
        s = np.ascontiguousarray(np.where(s > 0, s, 1e-9 * np.maximum(chain.scale, 1e-290))[None])
        found = _core.ep_run(problem, s, np.zeros(1), 0, 1.0, 1.0, None)
        x, P = found["x"][0], found["P"][0]
        bad = ~(np.isfinite(x).all(axis=1) & np.isfinite(P).all(axis=(1, 2)))
        if bad.any():  # nothing is known there
            x[bad] = chain.m0
            P[bad] = np.diag(1e6 * np.maximum(chain.scale[: x.shape[1]] ** 2, 1e-12 * chain.m0**2))
        return x, P


_LOG_2PI = float(np.log(2.0 * np.pi))


def _named(share: Array, model: Linear, record: Record) -> list[dict[str, Any]]:
    """Return the outputs that are outliers more likely than not, the surest first."""
    with np.errstate(invalid="ignore"):
        rows, columns = np.nonzero(share > 0.5)
    order = np.argsort(-share[rows, columns], kind="stable")
    return [
        {
            "t": float(record.t[rows[k]]),
            "row": int(rows[k]),
            "name": model.names.y[columns[k]],
            "probability": float(share[rows[k], columns[k]]),
        }
        for k in order
    ]
