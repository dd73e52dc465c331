"""Textbook twin of core/drive.hpp: the residuals solved for the new state, the smoother of `naive`, squares by hand."""

import numpy as np
from tests import naive

SCALES = ("along", "aside", "yaw", "q_offset", "q_drift")


def residuals(a, t, size):
    """Rows (size, size) on z[t] and on z[t-1], what they lack, and their variances, all of row t of one drive."""
    h, d, S, C = (a[name][t] for name in ("h", "d", "S", "C"))
    new, old, lacks, var = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size), np.zeros(size)
    # along: S dE + C dN - scale d
    new[0, :2], old[0, :2], old[0, 5], var[0] = (S, C), (-S, -C), -d, a["along"][t]
    # aside: the way goes along the mean of both azimuths
    new[1, :2], old[1, :2], var[1] = (C, -S), (-C, S), a["aside"][t]
    new[1, 2], old[1, 2], lacks[1] = -d / 2, -d / 2, d * a["middle"][t]
    # yaw: d azimuth - h (bias - size turn) + h w
    new[2, 2], old[2, 2], old[2, 6], lacks[2], var[2] = 1.0, -1.0, -h, h * a["w"][t], a["yaw"][t]
    for row, state, drift in ((3, 3, 7), (4, 4, 8)):
        new[row, state], old[row, state], old[row, drift], var[row] = 1.0, -a["keep"][t], -h, a["q_offset"][t]
        new[row + 4, drift], old[row + 4, drift], var[row + 4] = 1.0, -a["fade"][t], a["q_drift"][t]
    for row, walk in ((5, "scale_walk"), (6, "bias_walk")):
        new[row, row], old[row, row], var[row] = 1.0, -1.0, a[walk] * h
    if size > 9:
        old[2, 9] = h * a["turn"][t]
        new[9, 9], old[9, 9], var[9] = 1.0, -a["stay"][t], a["q_turn"][t]
    return new, old, lacks, var


def smooth(a):
    """One drive: x, P, squares, spread, misfit, unsure, counted, loglik; arguments as those of `_core.drive_smooth`, by name."""
    T, size = len(a["h"]), a["x0"].size
    A, Q, b = np.tile(np.eye(size), (T, 1, 1)), np.zeros((T, size, size)), np.zeros((T, size))
    rows = {t: residuals(a, t, size) for t in range(1, T)}
    for t, (new, old, lacks, var) in rows.items():
        back = np.linalg.inv(new)
        A[t], Q[t], b[t] = -back @ old, back @ np.diag(var) @ back.T, -back @ lacks
    C = np.zeros((2, size))
    C[0, [0, 3]] = C[1, [1, 4]] = 1.0
    R, P0 = a["r"] * np.eye(2), np.diag(a["P0"])
    seen = np.column_stack((a["seen"], a["seen"]))
    x, P, xp, Pp, ll = naive.kf(A, None, C, Q, R, a["y"], seen, a["x0"], P0, b=b)
    x, P, _, _, lag = naive.rts(A, Q, x, P, xp, Pp, a["x0"], P0)
    squares, spread = np.zeros((T, 5)), np.zeros((T, 5))
    for t, (new, old, lacks, _) in rows.items():
        off = new @ x[t] + old @ x[t - 1] + lacks
        cross = new @ lag[t] @ old.T
        variance = np.diag(new @ P[t] @ new.T + old @ P[t - 1] @ old.T + cross + cross.T)
        for to, every in ((squares, off**2), (spread, variance)):
            to[t] = *every[:3], every[3] + every[4], every[7] + every[8]
    return {
        "x": x,
        "P": P,
        "squares": squares,
        "spread": spread,
        "misfit": float(np.sum((a["y"] - x @ C.T)[a["seen"]] ** 2)),
        "unsure": float(np.einsum("ij,tjk,ik->", C, P[a["seen"]], C)),
        "counted": a["seen"].sum(),
        "loglik": ll.sum(),
    }
