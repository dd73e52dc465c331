"""Fixes that are not what they claim: repeated while the car moved on, or far from where it can be.

The fixes are the outputs of a car at nearly constant velocity that may be lost without a word, as a stale repeat of the
fix before or as garbage, in bursts (`halfwidth.loss`). Smoothing the probability of either names the samples. A log
holds positions in steps: a repeat has probability one from a frozen receiver and (density times step) from a live one,
so the stale mode gets the standard deviation step / sqrt(2 pi). Live receivers repeat themselves too when the car
stands, so a repeat is held against one only if the car moved meanwhile, by its own speed if the log has it, else by
where the receiver is afterwards. Fixes that are off by the same for seconds and then step to where the others are show
by that step (`steps`), and are gone before the rest is judged.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halfwidth.errors import HalfwidthError
from halfwidth.loss import Markov
from halfwidth.methods.loss import GPB
from halfwidth.model import Linear
from halfwidth.noise import Gaussian
from halfwidth.record import Record
from halfwidth.spread import Normal
from halfwidth.vehicle import evidence
from halfwidth.vehicle.log import Log
from halfwidth.vehicle.steps import stepped

Floats = NDArray[np.float64]

#: Probability that the next fix is trustworthy after one that was, and that trouble goes on.
_STAY = (0.998, 0.9)

#: Candidates for the deviation of a fix, m, and the intensity of the acceleration, m^2/s^3; rows to try them on.
_FIX, _PUSH, _TRIED = (0.02, 0.05, 0.15, 0.5, 1.5, 5.0), (0.3, 1.0, 3.0, 10.0), 1500

#: A log of more fixes is smoothed with a lag, to bound the memory.
_WHOLE = 20_000

#: A jump is garbage of this many standard deviations of a fix, and of this many metres at least.
_WILD, _WILD_M = 100.0, 50.0

#: A fix jumps if it lies this far from the smoothed path: in m, in standard deviations of a fix, and in what a car can
#: have done between two fixes, m/s^2.
_FAR_M, _FAR, _HARD = 5.0, 20.0, 5.0

#: Fixes that stay away for longer are believed again, s.
_LONGEST = 2.0

#: How far a car must have moved for a repeat to be no standstill, m, and in steps of the log.
_MOVED, _MOVED_STEPS = 0.05, 3.0


@dataclass(frozen=True, eq=False)
class Distrust:
    """Which fixes of a log are not to be trusted, and why.

    Parameters
    ----------
    rows : (n,) int array
        Rows of the log.
    why : (n,) array of str
        "frozen" or "jump".
    probability : (n,) array
        That the fix is what it claims to be.
    """

    rows: NDArray[np.intp]
    why: NDArray[np.str_]
    probability: Floats

    def __len__(self) -> int:
        return int(self.rows.size)

    def of(self, why: str) -> NDArray[np.intp]:
        """Return the rows distrusted for one reason."""
        return np.asarray(self.rows[self.why == why])

    def masked(self, log: Log) -> Log:
        """Return the log without these fixes."""
        if not len(self):
            return log
        gone = np.zeros(len(log), dtype=bool)
        gone[self.rows] = True
        changed: dict[str, Any] = {
            name: np.where(gone, np.nan, getattr(log, name)) for name in ("lat_deg", "lon_deg", "alt_m", "azimuth_rad")
        }
        return replace(log, **changed)

    def words(self, log: Log) -> list[str]:
        """Say what was found, with times."""
        found = []
        for why, said in (
            ("frozen", "repeat the fix before while the car moved"),
            ("jump", "lie off the path of the others"),
        ):
            rows = self.of(why)
            if rows.size:
                fixes = np.flatnonzero(log.fixed)
                when = evidence.times_of(log.t[fixes], np.isin(fixes, rows))
                noun = "fix" if rows.size == 1 else "fixes"
                found.append(f"{rows.size} {noun} {said}, at {when}: not used")
        return found


NOTHING = Distrust(np.empty(0, dtype=np.intp), np.empty(0, dtype="<U6"), np.empty(0))


def distrusted(log: Log, *, jumps: bool = True) -> Distrust:
    """Find fixes that are frozen or far off.

    Parameters
    ----------
    log : Log
    jumps : bool
        Whether to look for jumps; without it a log in which no fix repeats another costs nothing.

    Returns
    -------
    Distrust
    """
    rows = np.flatnonzero(log.fixed)
    if rows.size < 10:
        return NOTHING
    east, north = evidence.local_metres(log.lat_deg[rows], log.lon_deg[rows])
    y, t = np.stack([east, north], axis=1), log.t[rows]
    if not jumps and not _repeats(y).any():
        return NOTHING
    step = _step(y)
    wrong = stepped(t, y) & ~_repeats(y) if jumps else np.zeros(t.size, dtype=bool)
    try:
        p, stale, far = _probabilities(t, y, step, ~wrong)
    except HalfwidthError:  # a log too strange for the model: nothing is held against it
        return NOTHING
    frozen = (stale > 0.5) & _repeats(y) & _moved(log, rows, y, step)
    jump = _short((p < 0.5) & far & ~_repeats(y) & jumps, t) | wrong
    found = np.flatnonzero(frozen | jump)
    if found.size > 0.5 * rows.size:  # then the model is wrong, not the receiver
        return NOTHING
    return Distrust(rows[found], np.where(frozen[found], "frozen", "jump"), p[found])


def _step(y: Floats) -> Floats:
    """Return the step in which each axis is written, (2,) m: the smallest difference that is not rounding."""
    found = np.empty(2)
    for i in range(2):
        hop = np.abs(np.diff(np.unique(y[:, i])))
        hop = hop[hop > 1e-6]
        found[i] = max(float(np.quantile(hop, 0.02)) if hop.size else 1e-3, 1e-4)
    return found


def _model(t: Floats, y: Floats, step: Floats, fix: float, push: float) -> tuple[Linear, Record]:
    """Return a car at nearly constant velocity whose fixes may be frozen or far off."""
    h = np.diff(t, prepend=t[0] - np.median(np.diff(t)))
    A = np.tile(np.eye(4), (t.size, 1, 1))
    A[:, 0, 1] = A[:, 2, 3] = h
    Q = np.zeros((t.size, 4, 4))
    for i in (0, 2):
        Q[:, i, i], Q[:, i + 1, i + 1] = push * h**3 / 3 + 1e-8, push * h
        Q[:, i, i + 1] = Q[:, i + 1, i] = push * h**2 / 2
    variance = fix**2 + step**2 / 12
    loss = Markov(
        *_STAY,
        start=0.999,
        kind=("stale", "garbage"),
        noise={"stale": step**2 / (2 * np.pi), "garbage": (_WILD * fix) ** 2 + np.array([_WILD_M, _WILD_M]) ** 2},
    )
    x0 = Normal([y[0, 0], 0.0, y[0, 1], 0.0], [100.0, 400.0, 100.0, 400.0])
    C = np.kron(np.eye(2), [[1.0, 0.0]])
    return Linear(A, None, C, Gaussian(Q), Gaussian(variance), x0, loss=loss, dt=float(h[0])), Record(t, y)


def _probabilities(
    t: Floats, y: Floats, step: Floats, believed: NDArray[np.bool_]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return P(received), P(stale) and whether each fix lies far from the path; 0 and False where it is not believed.

    The noise is what explains the log's first part best.
    """
    if not believed.all():
        found = np.zeros((3, t.size))
        found[:, believed] = _probabilities(t[believed], y[believed], step, np.ones(int(believed.sum()), dtype=bool))
        return found[0], found[1], found[2] > 0
    few = slice(0, min(t.size, _TRIED))
    best, most = (_FIX[0], _PUSH[0]), -np.inf
    for fix in _FIX:
        for push in _PUSH:
            model, record = _model(t[few], y[few], step, fix, push)
            loglik = GPB(1).run(model, record).loglik
            if loglik is not None and loglik > most:
                best, most = (fix, push), loglik
    model, record = _model(t, y, step, *best)
    est = (GPB(2, smooth=True) if t.size <= _WHOLE else GPB(2, lag=5)).run(model, record)
    assert est.gamma is not None
    far = np.hypot(*(y - est.x[:, [0, 2]]).T) > max(_FAR_M, _FAR * best[0], _HARD * float(np.median(np.diff(t))) ** 2)
    return est.gamma, est.info["lost_as"]["stale"], far


def _repeats(y: Floats) -> NDArray[np.bool_]:
    """Return whether each fix is exactly the one before."""
    return np.concatenate(([False], (np.diff(y, axis=0) == 0).all(axis=1)))


def _moved(log: Log, rows: NDArray[np.intp], y: Floats, step: Floats) -> NDArray[np.bool_]:
    """Return for each fix whether the car moved during the run of equal fixes that it belongs to."""
    same = _repeats(y)
    run = np.cumsum(~same) - 1
    first = np.flatnonzero(~same)
    last = np.concatenate((first[1:] - 1, [len(y) - 1]))
    t = log.t[rows]
    least = max(_MOVED, _MOVED_STEPS * float(step.max()))
    t_speed, speed = log.stream("speed_mps")
    after = np.minimum(last + 1, len(y) - 1)
    away = np.hypot(*(y[after] - y[first]).T)
    if t_speed.size > 1:
        along = evidence.integral(t_speed, np.abs(speed), t[first], t[last])
        away = np.where(np.isfinite(along), along, away)
    else:
        away = np.where(last > first, away, 0.0)
    return np.asarray((away > least)[run])


def _short(flagged: NDArray[np.bool_], t: Floats) -> NDArray[np.bool_]:
    """Return flags without the runs that last too long for a jump: then the path is where these fixes say."""
    out = flagged.copy()
    for run in evidence.spans(flagged):
        if np.ptp(t[run]) > _LONGEST:
            out[run] = False
    return out
