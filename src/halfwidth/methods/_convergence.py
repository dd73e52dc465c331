"""Whether chains of draws agree, and how many independent draws they are worth.

References
----------
R-hat and effective sample size: Vehtari, Gelman, Simpson, Carpenter and Bürkner (2021), Bayesian Analysis 16(2),
eqs. (4), (9)-(13), (14).
"""

import numpy as np

from halfwidth.array import Array


def convergence(v: Array) -> tuple[float, float]:
    """Return the rank-normalised split R-hat and the bulk effective sample size of draws (chains, draws).

    The larger R-hat of the ranks and of the ranks of distances from the median is returned, so that chains which agree
    in place but not in spread are found too.
    """
    half = v.shape[1] // 2
    split = np.concatenate([v[:, :half], v[:, -half:]])
    rhat = max(_rhat(_normal_scores(split)), _rhat(_normal_scores(np.abs(split - np.median(split)))))
    return rhat, _effective(_normal_scores(split))


def _normal_scores(v: Array) -> Array:
    from scipy.special import ndtri
    from scipy.stats import rankdata

    rank = rankdata(v, method="average").reshape(v.shape)
    return np.asarray(ndtri((rank - 0.375) / (v.size + 0.25)))


def _rhat(z: Array) -> float:
    n = z.shape[1]
    within = float(z.var(axis=1, ddof=1).mean())
    between = n * float(z.mean(axis=1).var(ddof=1))
    if within <= 0:
        return 1.0 if between <= 0 else float("inf")
    return float(np.sqrt((n - 1) / n + between / (n * within)))


def _effective(z: Array) -> float:
    """Return the effective sample size of chains (m, n) by Geyer's initial monotone sequence."""
    m, n = z.shape
    size = 2 ** int(np.ceil(np.log2(2 * n)))
    spectrum = np.fft.rfft(z - z.mean(axis=1, keepdims=True), size, axis=1)
    auto = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, :n] / n
    within = float(auto[:, 0].mean()) * n / (n - 1)
    total = within * (n - 1) / n + float(z.mean(axis=1).var(ddof=1) if m > 1 else 0.0)
    if total <= 0:
        return float(m * n)
    rho = 1.0 - (within - auto.mean(axis=0) * n / (n - 1)) / total
    rho[0] = 1.0
    pairs = rho[: n // 2 * 2].reshape(-1, 2).sum(axis=1)
    below = np.flatnonzero(pairs < 0)
    pairs = np.minimum.accumulate(pairs[: below[0]] if below.size else pairs)
    tau = max(2.0 * float(pairs.sum()) - 1.0, 1.0 / np.log10(max(m * n, 10)))
    return float(m * n / tau)
