"""Slow, obvious twin of `halfwidth.vehicle.chain`: all residuals of the table in one dense least-squares problem."""

import numpy as np


def chain_round(t, east, north, seen, v, w, psi, sigma, *, memory=60.0, scale_sd=0.03, bias_sd=0.01, far=100.0):
    """One round about the azimuths psi: mean (T, 7), covariance (7T, 7T) and the new scales (5,).

    Each row of the table is written down as it stands, divided by its standard deviation; the covariance is the
    inverse of the normal matrix. Sensors are never silent here.
    """
    T = t.size
    rows, values, sds, group = [], [], [], []

    def add(entries, value, sd, g=None):
        row = np.zeros(7 * T)
        for (k, i), a in entries.items():
            row[7 * k + i] += a
        rows.append(row)
        values.append(value)
        sds.append(sd)
        group.append(g)

    first = int(np.argmax(seen))
    e0, n0 = east[first], north[first]
    S0, C0 = np.sin(psi[0]), np.cos(psi[0])
    prior = [0.0, 0.0, np.arctan2(S0, C0), 0.0, 0.0, 1.0, 0.0]
    slow = np.sqrt(0.5 * memory) * sigma[3]
    for i, sd in enumerate([far, far, np.sqrt(10.0), slow, slow, scale_sd, bias_sd]):
        add({(0, i): 1.0}, prior[i], sd)
    for k in range(1, T):
        h = t[k] - t[k - 1]
        middle = 0.5 * (psi[k] + psi[k - 1])
        S, C, vh, pace = np.sin(middle), np.cos(middle), v[k] * h, abs(v[k])
        ahead = {(k, 0): S, (k - 1, 0): -S, (k, 1): C, (k - 1, 1): -C}
        aside = {(k, 0): C, (k - 1, 0): -C, (k, 1): -S, (k - 1, 1): S}
        # the scale that holds over a step is the one at its beginning, and the bias too
        add(ahead | {(k - 1, 5): -vh}, 0.0, sigma[0] * np.sqrt(h * max(min(1.0, pace), 0.02)), 0)
        add(aside | {(k, 2): -vh / 2, (k - 1, 2): -vh / 2}, -vh * middle, sigma[1] * np.sqrt(h) * max(pace, 0.05), 1)
        slowly = 0.1 if pace < 0.1 else 1.0
        add({(k, 2): 1.0, (k - 1, 2): -1.0, (k - 1, 6): -h}, -h * w[k], sigma[2] * np.sqrt(h) * slowly, 2)
        for i in (3, 4):
            add({(k, i): 1.0, (k - 1, i): -np.exp(-h / memory)}, 0.0, sigma[3] * np.sqrt(h), 3)
        add({(k, 5): 1.0, (k - 1, 5): -1.0}, 0.0, 1e-4 * np.sqrt(h))
        add({(k, 6): 1.0, (k - 1, 6): -1.0}, 0.0, 1e-5 * np.sqrt(h))
    for k in np.flatnonzero(seen):
        add({(k, 0): 1.0, (k, 3): 1.0}, east[k] - e0, sigma[4], 4)
        add({(k, 1): 1.0, (k, 4): 1.0}, north[k] - n0, sigma[4], 4)
    J, b, sd, group = np.array(rows), np.array(values), np.array(sds), np.array([-1 if g is None else g for g in group])
    A, c = J / sd[:, None], b / sd
    z = np.linalg.lstsq(A, c, rcond=None)[0]
    P = np.linalg.inv(A.T @ A)
    square = (A @ z - c) ** 2 + np.einsum("ri,ij,rj->r", A, P, A)  # in units of the present scales
    new = []
    for g in range(5):
        mine = square[group == g]
        per_row = 2 if g >= 3 else 1  # both axes share a row of the core
        n = mine.size / per_row
        new.append(sigma[g] * np.sqrt((mine.sum() / per_row + 1.0) / (n + 1.0)))
    z = z.reshape(T, 7)
    z[:, 0] += e0
    z[:, 1] += n0
    return z, P, np.array(new)
