"""Slow, obvious twin of `halfwidth.vehicle.chain`: all residuals of the table in one dense least-squares problem."""

import numpy as np

N = 9


def chain_round(
    t, east, north, seen, v, w, psi, sigma, *, memory=60.0, drift=10.0, scale_sd=0.03, bias_sd=0.01, far=100.0
):
    """One round about the azimuths psi, all tails Gaussian: mean (T, 9), covariance (9T, 9T) and scales (7,) a step on.

    Each row of the table is written down as it stands, divided by its standard deviation; the covariance is the
    inverse of the normal matrix. Sensors are never silent here.
    """
    T = t.size
    rows, values, sds, group, slips = [], [], [], [], []

    def add(entries, value, sd, g=None, slip=0.0):
        row = np.zeros(N * T)
        for (k, i), a in entries.items():
            row[N * k + i] += a
        rows.append(row)
        values.append(value)
        sds.append(sd)
        group.append(g)
        slips.append(slip)

    first = int(np.argmax(seen))
    e0, n0 = east[first], north[first]
    S0, C0 = np.sin(psi[0]), np.cos(psi[0])
    prior = [0.0, 0.0, np.arctan2(S0, C0), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    d2 = 0.5 * drift * sigma[5] ** 2
    slow, moving = np.sqrt(0.5 * memory * sigma[4] ** 2 + d2 * memory**2 * drift / (memory + drift)), np.sqrt(d2)
    for i, sd in enumerate([far, far, np.sqrt(10.0), slow, slow, scale_sd, bias_sd, moving, moving]):
        add({(0, i): 1.0}, prior[i], sd)
    for k in range(1, T):
        h = t[k] - t[k - 1]
        middle = 0.5 * (psi[k] + psi[k - 1])
        S, C, vh, pace = np.sin(middle), np.cos(middle), v[k] * h, abs(v[k])
        ahead = {(k, 0): S, (k - 1, 0): -S, (k, 1): C, (k - 1, 1): -C}
        aside = {(k, 0): C, (k - 1, 0): -C, (k, 1): -S, (k - 1, 1): S}
        # the scale that holds over a step is the one at its beginning, and the bias too
        add(ahead | {(k - 1, 5): -vh}, 0.0, sigma[0] * np.sqrt(h * max(min(1.0, pace), 0.02)), 0)
        plain, turning = sigma[1] ** 2 * h * max(pace, 0.05) ** 2, sigma[2] ** 2 * h * (pace * w[k]) ** 2
        both = np.sqrt(plain + turning)
        add(aside | {(k, 2): -vh / 2, (k - 1, 2): -vh / 2}, -vh * middle, both, 1, turning / both**2)
        slowly = 0.1 if pace < 0.1 else 1.0
        add({(k, 2): 1.0, (k - 1, 2): -1.0, (k - 1, 6): -h}, -h * w[k], sigma[3] * np.sqrt(h) * slowly, 3)
        for i, d in ((3, 7), (4, 8)):
            offset = {(k, i): 1.0, (k - 1, i): -np.exp(-h / memory), (k - 1, d): -h}
            add(offset, 0.0, sigma[4] * np.sqrt(h), 4)
            add({(k, d): 1.0, (k - 1, d): -np.exp(-h / drift)}, 0.0, sigma[5] * np.sqrt(h), 5)
        add({(k, 5): 1.0, (k - 1, 5): -1.0}, 0.0, 1e-4 * np.sqrt(h))
        add({(k, 6): 1.0, (k - 1, 6): -1.0}, 0.0, 1e-5 * np.sqrt(h))
    for k in np.flatnonzero(seen):
        add({(k, 0): 1.0, (k, 3): 1.0}, east[k] - e0, sigma[6], 6)
        add({(k, 1): 1.0, (k, 4): 1.0}, north[k] - n0, sigma[6], 6)
    J, b, sd, group = np.array(rows), np.array(values), np.array(sds), np.array([-1 if g is None else g for g in group])
    A, c = J / sd[:, None], b / sd
    z = np.linalg.lstsq(A, c, rcond=None)[0]
    P = np.linalg.inv(A.T @ A)
    square, told = (A @ z - c) ** 2, 1.0 - np.einsum("ri,ij,rj->r", A, P, A)  # in units of the present scales
    slips = np.array(slips)
    new = []
    for g in range(7):
        count = {1: np.where(group == 1, 1 - slips, 0.0), 2: np.where(group == 1, slips, 0.0)}.get(
            g, 1.0 * (group == g)
        )
        per_row = 2 if g >= 4 else 1  # both axes share a row of the core
        new.append(sigma[g] * ((count @ square / per_row + 1.0) / (count @ told / per_row + 1.0)) ** 0.5)
    z = z.reshape(T, N)
    z[:, 0] += e0
    z[:, 1] += n0
    return z, P, np.array(new)
