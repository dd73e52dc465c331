"""The chain with noise that is partly bounded, by its posterior: half-widths by evidence, integrated over.

The model is that of `halfwidth.vehicle.chain`, in axes that turn with the car. Each residual is the sum of a uniform
and a Gaussian part: the Gaussian one has a share of the standard deviation that the chain has learnt, the half-width of
the uniform one is unknown, one for each kind of residual. `halfwidth.Posterior` finds the half-widths by the evidence
of the whole drive, integrates over what is not known of them and over all states, and so gives the position a mean and
a variance (Minka 2001; Pavelková and Kárný 2013 for the model). Shares are compared by evidence.

Expectation propagation on a window of a real drive is only as good as where it starts. What makes it reliable here:

- it starts from the Gaussian chain: its azimuths to linearise about, its scales as units, so that every half-width is
  sought between 0 and `most` of its own standard deviations;
- a Gaussian part in every residual, so that no factor has an edge that a step of the iteration can fall over;
- it goes on from its own sites and half-widths when it linearises again.

Where it does not settle nevertheless, the path is that of the Gaussian chain, and ``path.info["notes"]`` says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from halfwidth.methods import load
from halfwidth.model import Linear
from halfwidth.noise import Gaussian, Uniform
from halfwidth.record import Record
from halfwidth.result import Estimate, Status
from halfwidth.spread import Normal
from halfwidth.vehicle import chain
from halfwidth.vehicle.grid import Grid
from halfwidth.vehicle.path import Path
from halfwidth.vehicle.pointing import with_speed

Floats = NDArray[np.float64]

#: Names of the half-widths, in the order of the states of the model; scale and bias have none.
KINDS: tuple[str, ...] = (
    "along", "across", "azimuth", "", "", "offset_east", "offset_north", "drift_east", "drift_north",
)  # fmt: skip

#: Those of the states, then those of the fixes.
_NAMES = (*KINDS, "fix_east", "fix_north")

#: Rounds in which the Gaussian chain is solved again with hidden fixes, its scales kept.
_AGAIN = 3

ALONG, ACROSS, AZIMUTH, SCALE, BIAS, OFFSET_E, OFFSET_N, DRIFT_E, DRIFT_N = range(9)


@dataclass(frozen=True)
class Credible:
    """Settings of the posterior of the chain; none of them is tuned to a log.

    Parameters
    ----------
    shares : tuple of float
        Gaussian parts that are compared, in standard deviations of the chain.
    most : float
        Largest half-width, in standard deviations of the chain.
    nodes : int
        Points over which half-widths are integrated, of `halfwidth.Posterior`.
    rounds : int
        Linearisations beyond the Gaussian chain's, of the share that is taken.
    base : Chain
        Settings of the Gaussian chain.
    """

    shares: tuple[float, ...] = (0.15, 0.4, 0.8)
    most: float = 6.0
    nodes: int = 16
    rounds: int = 1
    base: chain.Chain = field(default_factory=chain.Chain)


def solve(drives: Sequence[Grid], settings: Credible = Credible()) -> list[Path]:
    """Return the posterior of the chain for each drive.

    Parameters
    ----------
    drives : sequence of Grid
        Each with at least two nodes and one fix.
    settings : Credible

    Returns
    -------
    list of Path
        ``info`` has the half-widths with their standard deviations in units of the chain's, the Gaussian share, the
        log evidence of each share, speed scale and yaw bias, and the fit of the Gaussian chain.
    """
    given = [with_speed(drive) for drive in drives]
    fits = chain.solve(given, settings.base)
    return [_solved(drive, fit, settings) for drive, fit in zip(given, fits, strict=True)]


def again(drives: Sequence[Grid], paths: Sequence[Path], settings: Credible = Credible()) -> list[Path]:
    """Return the posterior for drives of which fixes were hidden, with the half-widths that were learnt with all fixes.

    Parameters
    ----------
    drives : sequence of Grid
    paths : sequence of Path
        What `solve` found for each with all fixes.
    settings : Credible

    Returns
    -------
    list of Path
    """
    given = [with_speed(drive) for drive in drives]
    known = [path.info["chain"] for path in paths]
    fits = chain.solve(
        given,
        replace(settings.base, rounds=_AGAIN),
        sigma=np.array([fit.sigma for fit in known]),
        azimuth=[fit.z[:, chain.AZIMUTH] for fit in known],
        weight=[fit.weight for fit in known],
        learn=False,
    )
    return [_again(drive, fit, path, settings) for drive, fit, path in zip(given, fits, paths, strict=True)]


def _again(drive: Grid, fit: chain.Fit, path: Path, settings: Credible) -> Path:
    if fit.path.status is Status.STALLED or "half_widths" not in path.info:
        return fit.path
    known = np.array([path.info["half_widths"].get(name, 0.0) for name in _NAMES])
    share = path.info["gaussian_share"]
    problem = _problem(drive, fit, fit.z[:, chain.AZIMUTH], share, settings, known)
    answer = load("Posterior")(nodes=1).answer(problem.model, problem.record)
    if not answer.estimate.status.good:
        return fit.path
    return problem.path(answer.estimate, fit, share, known, np.zeros(known.size))


def _solved(drive: Grid, fit: chain.Fit, settings: Credible) -> Path:
    if fit.path.status is Status.STALLED:
        return replace(fit.path, info={**fit.path.info, "chain": fit})
    quick = load("Posterior")(nodes=1)
    psi = fit.z[:, chain.AZIMUTH]
    tried = []
    for share in settings.shares:
        problem = _problem(drive, fit, psi, share, settings)
        answer = quick.answer(problem.model, problem.record)
        if answer.estimate.status.good:
            tried.append((float(answer.estimate.loglik), share, problem, answer))
    if tried:
        _, share, problem, answer = max(tried, key=lambda one: one[0])
        whole = load("Posterior")(nodes=settings.nodes)
        for _ in range(settings.rounds):
            problem = _problem(drive, fit, problem.azimuth(answer.estimate.x), share, settings)
            answer = whole.answer(problem.model, problem.record, start=answer.start)
            if not answer.estimate.status.good:
                break
        if answer.estimate.status.good:
            half = answer.estimate.info["half_widths"]
            path = problem.path(answer.estimate, fit, share, half["mean"], half["sd"])
            evidence = {one[1]: one[0] for one in tried}
            return replace(path, info={**path.info, "evidence": evidence})
    words = "the posterior of partly bounded noise did not settle: the path of the Gaussian chain"
    return replace(fit.path, status=Status.REDUCED, info={**fit.path.info, "chain": fit, "notes": [words]})


@dataclass(frozen=True, eq=False)
class _Problem:
    """A drive as a linear model, every state in units of its own noise of the row: x = unit * z.

    Parameters
    ----------
    model, record
        What `halfwidth.Posterior` takes.
    unit : (T, 9) array
    out : (T, 2, 9) array
        From z to where the receiver sees the vehicle, m.
    origin : (2,) array
        What that is about.
    drive : Grid
    """

    model: Linear
    record: Record
    unit: Floats
    out: Floats
    origin: Floats
    drive: Grid

    def azimuth(self, z: Floats) -> Floats:
        """Return the azimuths (T,) of states z."""
        return z[:, AZIMUTH] * self.unit[:, AZIMUTH]

    def path(self, est: Estimate, fit: chain.Fit, share: float, half: Floats, sd: Floats) -> Path:
        """Return an estimate as a path; half-widths (11,) with their standard deviations, in units of the chain's."""
        drive = self.drive
        place = np.einsum("tij,tj->ti", self.out, est.x) + self.origin
        variance = np.einsum("tij,tjk,tik->ti", self.out, np.asarray(est.P), self.out)
        # the bounded part of a fix error: its expected square, half-widths integrated over
        bounded = float(np.mean(half[-2:] ** 2 + sd[-2:] ** 2)) / 3.0
        at_node = 0.5 * (drive.speed + np.concatenate((drive.speed[1:], drive.speed[-1:])))
        scale, bias = (est.x[:, k] * self.unit[:, k] for k in (SCALE, BIAS))
        return Path(
            drive.t,
            place[:, 0],
            place[:, 1],
            self.azimuth(est.x),
            scale * at_node,
            np.maximum(variance, 0.0),
            (share**2 + bounded) * float(fit.sigma[chain.FIX]) ** 2,
            est.status,
            {
                "half_widths": {n: float(m) for n, m in zip(_NAMES, half, strict=True) if n},
                "half_width_sds": {n: float(m) for n, m in zip(_NAMES, sd, strict=True) if n},
                "gaussian_share": share,
                "chain": fit,
                "sigma": fit.path.info["sigma"],
                "slow_sd": fit.path.info["slow_sd"],
                "speed_scale": float(np.mean(scale)),
                "yaw_bias": float(np.mean(bias)),
            },
        )


def _problem(
    drive: Grid, fit: chain.Fit, psi: Floats, share: float, settings: Credible, known: Floats | None = None
) -> _Problem:
    """Return the model of a drive about the azimuths psi, with this share of Gaussian noise.

    Half-widths are sought, or `known` (11,), in units of the chain's scales.
    """
    unit, extra, start = chain.learnt_noise(drive, fit, settings.base)
    h, vh, w = drive.h, drive.speed * drive.h, drive.yaw_rate
    T, n = h.size, len(KINDS)
    middle = psi.copy()
    middle[1:] = 0.5 * (psi[1:] + psi[:-1])
    S, C = np.sin(middle), np.cos(middle)
    turn = np.empty((T, 2, 2))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = S, C, C, -S  # east, north of along, across
    A = np.zeros((T, n, n))
    A[:, range(n), range(n)] = 1.0
    A[1:, :2, :2] = turn[1:].transpose(0, 2, 1) @ turn[:-1]
    # across: v h times what the middle azimuth is off the one linearised about, half of it from either end of the step
    A[:, ALONG, SCALE], A[:, ACROSS, AZIMUTH], A[:, AZIMUTH, BIAS] = vh, 0.5 * vh, h
    fade, drift_fade = np.exp(-h / settings.base.memory), np.exp(-h / settings.base.drift_memory)
    A[:, OFFSET_E, OFFSET_E] = A[:, OFFSET_N, OFFSET_N] = fade
    A[:, OFFSET_E, DRIFT_E] = A[:, OFFSET_N, DRIFT_N] = h
    A[:, DRIFT_E, DRIFT_E] = A[:, DRIFT_N, DRIFT_N] = drift_fade
    before = np.tile(np.eye(n), (T, 1, 1))
    before[:, ACROSS, AZIMUTH] = -0.5 * vh
    u = np.column_stack((-vh * middle, -h * w))
    B = np.zeros((T, n, 2))
    B[:, ACROSS, 0] = B[:, AZIMUTH, 1] = 1.0
    A[0], before[0], u[0] = np.eye(n), np.eye(n), 0.0
    out = np.zeros((T, 2, n))
    out[:, :, :2] = turn
    out[:, 0, OFFSET_E] = out[:, 1, OFFSET_N] = 1.0
    # every state in units of the noise that enters it in that row: half-widths are then one number for the whole drive
    of = np.concatenate((unit[:1], unit[:-1]))
    fix = float(fit.sigma[chain.FIX])
    out = out * unit[:, None, :]
    bounded = np.array([name != "" for name in KINDS])
    if not settings.base.slow:
        bounded[OFFSET_E:] = False
    Q = np.zeros((T, n, n))
    Q[:, range(n), range(n)] = np.where(bounded, share**2, 1.0)
    Q[:, range(3), range(3)] += extra / unit[:, :3] ** 2
    origin = np.array([drive.east, drive.north])[:, int(np.argmax(drive.seen))]
    y = np.column_stack((drive.east, drive.north)) - origin
    y[~drive.seen] = np.nan
    first = np.zeros(n)
    first[AZIMUTH], first[SCALE] = psi[0], 1.0
    model = Linear(
        A * of[:, None, :] / unit[:, :, None],
        B / unit[:, :, None],
        out / fix,
        (Uniform.unknown(0.0, np.where(bounded, settings.most, 0.0)) if known is None else Uniform(known[:n]))
        + Gaussian(Q),
        (Uniform.unknown(0.0, settings.most) if known is None else Uniform(known[n:])) + Gaussian(np.full(2, share**2)),
        Normal(first / unit[0], start / unit[0] ** 2),
        E=before * unit[:, None, :] / unit[:, :, None],
    )
    return _Problem(model, Record(drive.t, y / fix, u), unit, out, origin, drive)
