"""The two simulations of the estimator for mixed bounded and Gaussian noise, and what it stands on.

A constant 12 is measured a thousand times, always with the same bounded error (figure 1), or with bounded errors and
noise that differ from measurement to measurement (figure 2). The paper shows one run of each as a figure and states the
limit of the first; here many runs stand beside it. The print has lost several formulas; `halfwidth.fusion` derives them
anew, and the tables of borders and of the Gaussian sum check them.

References
----------
Hanebeck, Horn and Schmidt, On combining statistical and set theoretic estimation, sections 6 and 7.
"""

import pathlib
from typing import NamedTuple

import numpy as np

from halfwidth import fusion
from halfwidth.array import Array
from halfwidth.fusion import Fused, Source, fuse
from halfwidth.reproduce import Table, canvas, saved

Z = 12.0
N = 1000
#: Example 1: E, sigma and the error e that the estimator does not know.
SAME = (1.0, 3.0, -0.5)
ROWS = (1, 10, 100, 1000)


class Run(NamedTuple):
    """Measurements (n, runs) with their squared half-widths and variances, and what the estimator makes of them."""

    y: Array
    found: Fused


def same_source(runs: int, n: int = N, seed: int = 1, kappa: float = 3.0) -> Run:
    """Sample one source again and again, section 7.1."""
    E, sigma, e = SAME
    y = Z + e + sigma * np.random.default_rng(seed).standard_normal((n, runs))
    return Run(y, fusion.recursion(y, E, sigma**2, kappa=kappa))


def different_sources(runs: int, n: int = N, seed: int = 2, kappa: float = 3.0) -> Run:
    """Sample sources that differ, section 7.2: e = sqrt(E) R1, E = .25 + .75 R2, sigma = sqrt(1 + 8 R3)."""
    rng = np.random.default_rng(seed)
    R = rng.random((3, n, runs))
    E, S = 0.25 + 0.75 * R[1], 1 + 8 * R[2]
    y = Z + np.sqrt(E) * R[0] + np.sqrt(S) * rng.standard_normal((n, runs))
    return Run(y, fusion.recursion(y, E, S, kappa=kappa))


def example_one(*, quick: bool = False) -> Table:
    """Figure 1 as numbers, beside what the text states."""
    run = same_source(6 if quick else 40)
    rows = []
    for k in ROWS:
        one = Fused(*(getattr(run.found, name)[k - 1] for name in ("m", "E", "S", "lam")))
        lo, hi = one.interval()
        wide = 9 / np.sqrt(k)
        rows.append(
            (
                k, _mean(one.m), _mean(np.sqrt(one.E)), _mean(np.sqrt(one.S)), round(3 / np.sqrt(k), 4), _mean(lo),
                _mean(hi), f"[{10.5 - wide:.2f}, {12.5 + wide:.2f}]", round(float(np.mean((lo <= Z) & (hi >= Z))), 4),
            )
        )  # fmt: skip
    lo, hi = run.found.interval()
    inside = float(np.mean((lo <= Z) & (hi >= Z)))
    return Table(
        f"Example 1, figure 1: the same source sampled (E = 1, sigma = 3, z = 12, e = -.5), {run.y.shape[1]} runs",
        ("k", "m", "sqrt E", "sigma", "3/sqrt k", "lower", "upper", "limit -+ 9/sqrt k", "inside"),
        tuple(rows),
        (
            "The paper states the limit of the interval, [10.5, 12.5]; its figure shows one run.",
            f"Of all k and runs the interval holds z in {100 * inside:.2f} %.",
            "Equal bounds: the set keeps its half-width 1 for every lambda, which then only weighs the noise.",
        ),
    )


def example_two(*, quick: bool = False) -> Table:
    """Figure 2 as numbers."""
    run = different_sources(6 if quick else 40)
    rows = []
    for k in ROWS:
        one = Fused(*(getattr(run.found, name)[k - 1] for name in ("m", "E", "S", "lam")))
        lo, hi = one.interval()
        inside = round(float(np.mean((lo <= Z) & (hi >= Z))), 4)
        rows.append((k, *(_mean(v) for v in (one.m, np.sqrt(one.E), np.sqrt(one.S), lo, hi)), inside))
    return Table(
        f"Example 2, figure 2: different sources (E = .25 + .75 R2, sigma^2 = 1 + 8 R3), mean of {run.y.shape[1]} runs",
        ("k", "m", "sqrt E", "sigma", "lower", "upper", "inside"),
        tuple(rows),
        (
            "The paper shows one run and states no number. Its bounded error sqrt(E) R1 is never negative, so m settles"
            " above 12; that is what a bounded error may do, and the interval holds 12 all the same.",
        ),
    )


def choices(*, quick: bool = False) -> Table:
    """Compare what lambda may be chosen by: the measures that the paper allows beside (32)."""
    rows = []
    for name, draw in (("same source", same_source), ("different sources", different_sources)):
        y = draw(1, 200 if quick else N).y
        rng = np.random.default_rng(2)
        R = rng.random((3, *y.shape))
        E, S = (SAME[0], SAME[1] ** 2) if name == "same source" else (0.25 + 0.75 * R[1], 1 + 8 * R[2])
        for measure in ("width", "square", "set", "variance"):
            found = fusion.recursion(y, E, S, measure=measure)
            half, sd = float(np.sqrt(found.E[-1, 0])), float(np.sqrt(found.S[-1, 0]))
            rows.append((name, measure, round(half, 4), round(sd, 4), round(half + 3 * sd, 4)))
    return Table(
        f"What lambda is chosen by, one run, k = {200 if quick else N}",
        ("example", "measure", "sqrt E", "sigma", "sqrt E + 3 sigma"),
        tuple(rows),
        ('"width" is eq. (32), sqrt(E) + 3 sigma; "square" E + 9 S; "set" E alone; "variance" S alone.',),
    )


def sums(*, quick: bool = False) -> Table:
    """How close the Gaussian sum of section 4 comes to the exact density, and what is left of it in a recursion."""
    cases = [
        (Source(0.0, 1.0, 0.1), Source(1.0, 0.5, 0.1), 0.1), (Source(0.0, 0.2, 1.0), Source(1.5, 0.3, 0.5), -0.3),
        (Source(0.0, 1.0, 0.02), Source(1.8, 1.0, 0.02), 0.4),
    ]  # fmt: skip
    rows: list[tuple[object, ...]] = []
    for L in (3, 10, 40) if quick else (3, 10, 40, 160):
        worst, off_m, off_s = 0.0, 0.0, 0.0
        for x, y, lam in cases:
            exact, near = fuse(x, y, lam), fusion.fuse_sums(x, y, lam, L=L)
            sd = float(np.sqrt(exact.S))
            z, h = np.linspace(exact.m - 14 * sd, exact.m + 14 * sd, 20_001, retstep=True)
            distance = 0.5 * float(np.abs(near.density(z) - fusion.density(x, y, lam, z)).sum()) * h
            worst = max(worst, distance)
            off_m = max(off_m, abs(near.mean - float(exact.m)) / sd)
            off_s = max(off_s, abs(near.variance / float(exact.S) - 1))
        rows.append((f"{2 * L + 1} terms", round(fusion.best_spread(L), 3), worst, off_m, off_s))
    both: Source = Source(0.3, 0.5, 1.0)
    every = few = fusion.GaussianSum.of(both)
    rng = np.random.default_rng(0)
    for _ in range(3):
        y = Source(rng.normal(0, 0.7), 0.4, 0.6)
        every, few = fusion.fuse_sums(every, y, 0.1, L=6), fusion.fuse_sums(few, y, 0.1, L=6, terms=40)
        both = fuse(both, y, 0.1)
    sd = np.sqrt(every.variance)
    for name, m, S in (
        ("mean and variance alone", float(both.m), float(both.S)),
        ("40 heaviest kept", few.mean, few.variance),
    ):
        rows.append((f"3 steps, {name}", None, None, abs(m - every.mean) / sd, abs(S / every.variance - 1)))
    return Table(
        "Sections 4 and 5: the constraint as a sum of Gaussians against the exact density, worst of three cases",
        ("", "c", "total variation", "mean off / sd", "variance off"),
        tuple(rows),
        (
            "The steps are compared with all 13^3 terms. Keeping the heaviest, as the paper proposes for a recursion,"
            " drops the tails and a fifth of the variance; its mean and variance alone stay within a thousandth.",
        ),
    )


def borders(*, quick: bool = False) -> Table:  # noqa: ARG001
    """Check the limits of section 6.2: largest difference over lambda."""
    lam = np.linspace(-0.5, 0.5, 21)
    x, y = (0.7, 0.5), (-1.1, 2.0)
    rows: list[tuple[object, ...]] = []
    for tiny in (0.0, 1e-28, 1e-20):
        found = fuse(Source(x[0], tiny, x[1]), Source(y[0], tiny, y[1]), lam)
        m, S = (y[1] * x[0] + x[1] * y[0]) / (x[1] + y[1]), 1 / (1 / x[1] + 1 / y[1])
        rows.append(
            (f"sets of half-width {np.sqrt(tiny):g}: Kalman filter", _most(found.m - m), _most(found.S - S), None)
        )
    for tiny in (0.0, 1e-28, 1e-20):
        one, two = Source(0.7, 1.0, tiny), Source(-0.4, 0.5, tiny)
        found, w = fuse(one, two, lam), fusion.weights(one.E, two.E, lam)
        rows.append(
            (f"noise of deviation {np.sqrt(tiny):g}: set estimator", _most(found.m - w.x * 0.7 + w.y * 0.4),
             _most(found.S), _most(found.E - 1 / ((0.5 - lam) / 1.0 + (0.5 + lam) / 0.5)))
        )  # fmt: skip
    return Table("Section 6.2: border cases, eqs. (33) to (38)", ("limit", "m", "S", "E"), tuple(rows))


def tables(*, quick: bool = False) -> tuple[Table, ...]:
    """Return both examples, the choice of lambda, the Gaussian sum and the border cases."""
    return tuple(part(quick=quick) for part in (example_one, example_two, choices, sums, borders))


def figures(folder: str | pathlib.Path, *, quick: bool = False) -> list[pathlib.Path]:
    """Draw both figures of the paper into a folder; returns the files."""
    plt, folder = canvas(folder)
    files = []
    n = 200 if quick else N
    for number, (name, run) in enumerate(
        {"the same source": same_source(1, n), "different sources": different_sources(1, n)}.items(), start=1
    ):
        found, k = run.found, np.arange(1, n + 1)
        lo, hi = found.interval()
        figure, axes = plt.subplots(3, 1, figsize=(6, 7), sharex=True, constrained_layout=True)
        axes[0].plot(k, run.y[:, 0], ".", ms=1, color="0.7", label="measurements")
        axes[0].fill_between(k, lo[:, 0], hi[:, 0], color="C0", alpha=0.25, lw=0, label="m -+ (sqrt E + 3 sigma)")
        axes[0].plot(k, found.m[:, 0], color="C0", label="m")
        axes[0].axhline(Z, color="k", lw=0.8, ls="--")
        if number == 1:
            axes[0].axhspan(10.5, 12.5, color="C1", alpha=0.15, label="limit [10.5, 12.5]")
        axes[0].set(ylim=(6, 18), title=f"Figure {number}: {name}")
        axes[0].legend(fontsize=7, loc="upper right")
        axes[1].plot(k, np.sqrt(found.E[:, 0]))
        axes[1].set(ylabel="sqrt E", ylim=(0, 1.2))
        axes[2].plot(k, np.sqrt(found.S[:, 0]))
        axes[2].set(ylabel="sigma", xlabel="k", ylim=(0, 1.5))
        files.append(saved(figure, folder / f"paper004_figure{number}.png"))
    return files


def _mean(values: Array) -> float:
    return round(float(np.mean(values)), 4)


def _most(values: Array) -> float:
    return float(np.abs(values).max())
