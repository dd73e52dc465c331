"""Slow, obvious twins of core/noise.hpp: moments by quadrature."""

import math

import numpy as np

_NODE, _WEIGHT = np.polynomial.legendre.leggauss(24)


def truncated(mu, c, lo, hi, panels=60):
    """Return log Z, mean, variance, tilted density at lo and hi, log mean density of N(mu, c) cut to [lo, hi], c > 0."""
    sd = math.sqrt(c)
    width = hi - lo
    a, b = (lo - mu) / sd, (hi - mu) / sd
    flip = a + b < 0
    if flip:
        a, b = -b, -a
    top = max(a, 0.0)
    # where the density is above exp(-50) of its highest value
    left = max(a, -10.0)
    right = min(width / sd + a, top + 100.0 / (top + math.sqrt(top * top + 100.0)))
    t_end = min(width / sd, right - left)  # a distance from the end `a`: exact for narrow boxes far out
    start = left - a if math.isfinite(a) else 0.0
    base = left if start or not math.isfinite(a) else a
    ends = np.linspace(0.0, t_end, panels + 1)
    t = (0.5 * (ends[1:] + ends[:-1])[:, None] + 0.5 * (ends[1] - ends[0]) * _NODE).ravel()
    g = np.tile(0.5 * _WEIGHT / panels, panels)

    def density(t):
        """Over the density at `top`, at base + t."""
        return np.exp(-0.5 * (base - top) * (base + top) - base * t - 0.5 * t * t)

    f = g * density(t)
    mass = f.sum()  # times t_end
    t_mean = f @ t / mass
    var = c * (f @ (t - t_mean) ** 2 / mass)
    sign = -1.0 if flip else 1.0
    edge = (hi if flip else lo) if start == 0.0 and math.isfinite(a) else mu + sign * sd * base
    mean = edge + sign * sd * t_mean
    log_top = -0.5 * top * top - 0.5 * math.log(2 * math.pi)
    at_a = math.exp(-0.5 * (a - top) * (a + top)) if math.isfinite(a) else 0.0
    drop = (width / sd) * (a + 0.5 * width / sd) if a >= 0 else 0.5 * b * b
    at_b = math.exp(-drop)
    Z = mass * t_end
    near, away = (e / Z / sd if Z else math.inf for e in (at_a, at_b))
    if flip:
        near, away = away, near
    log_z = log_top + math.log(Z) if Z else -math.inf
    log_mean = log_top + math.log(mass) - math.log(sd)
    if width:
        log_mean += math.log(t_end * sd / width) if math.isfinite(width) else -math.inf
    return log_z, mean, var, near, away, log_mean


def grid(mu, c, log_f, lo, hi, points=400_001):
    """Return log Z, mean, variance of exp(log_f(z)) N(z; mu, c) by a fine sum over [lo, hi]."""
    z, h = np.linspace(lo, hi, points, retstep=True)
    log_p = log_f(z) - 0.5 * (z - mu) ** 2 / c - 0.5 * math.log(2 * math.pi * c)
    top = log_p.max()
    p = np.exp(log_p - top)
    p[0] *= 0.5
    p[-1] *= 0.5
    mass = p.sum()
    mean = p @ z / mass
    return top + math.log(mass * h), mean, p @ (z - mean) ** 2 / mass
