"""Twins of core/banded_ipm.hpp and core/chain.hpp: dense matrices, no structure; and the random problems they share."""

from dataclasses import replace

import numpy as np

from halfwidth.solvers.chain import Chain

KINDS = (
    "plain", "missing", "box", "theta", "scale", "zero", "T1", "unseen", "caps", "infeasible", "E", "varying", "weights",
    "shared",
)  # fmt: skip


def dense(chain):
    """Return M (K, n + p0), b (K,), kind (K,) of all rows, states first, then seen outputs."""
    T, n = chain.bx.shape
    m, p0 = chain.by.shape[1], 0 if chain.G is None else chain.G.shape[2]
    A, C = np.broadcast_to(chain.A, (T, n, n)), np.broadcast_to(chain.C, (T, m, n))
    E = np.broadcast_to(np.eye(n) if chain.E is None else chain.E, (T, n, n))
    rows, b, kind = [], [], []
    for t in range(T):
        for i in range(n):
            row = np.zeros((T + 1) * n + p0)
            row[(t + 1) * n : (t + 2) * n] = E[t, i]
            row[t * n : (t + 1) * n] = -A[t, i]
            if p0:
                row[(T + 1) * n :] = chain.G[t, i]
            rows.append(row), b.append(chain.bx[t, i]), kind.append(i)
    for t in range(T):
        for i in np.flatnonzero(chain.seen[t]):
            row = np.zeros((T + 1) * n + p0)
            row[(t + 1) * n : (t + 2) * n] = C[t, i]
            if p0:
                row[(T + 1) * n :] = chain.G[t, n + i]
            rows.append(row), b.append(chain.by[t, i]), kind.append(n + i)
    return np.array(rows), np.array(b), np.array(kind)


def central(chain, gap=0.3, iterations=50):
    """Return (x, s, iterations) of the central point of a chain without boxes, caps and theta, by dense algebra.

    The same scaling, start, predictor, corrector and steps as the core, one matrix for everything.
    """
    M, b, kind = dense(chain)
    T, n = chain.bx.shape
    group, cost = chain.group[kind], chain.c
    kappa = cost[group] / chain.h[kind]
    A, C = np.atleast_3d(chain.A.T).T, np.atleast_3d(chain.C.T).T
    E = np.eye(n)[None] if chain.E is None else np.atleast_3d(chain.E.T).T
    k_row = cost[chain.group] / chain.h
    share = np.r_[np.ones(n), chain.seen.mean(axis=0)]
    parts = ((k_row[:n], share[:n], A), (k_row[n:], share[n:], C), (k_row[:n], share[:n], E))
    norm = sum((f[:, None] * ((k[None, :, None] * X) ** 2).mean(axis=0)).sum(axis=0) for k, f, X in parts)
    sx = np.tile(1.0 / np.sqrt(norm), T + 1)
    M = kappa[:, None] * M * sx
    b = kappa * b
    ridge = 1e-8 * np.eye(M.shape[1])
    x0 = np.linalg.solve(M.T @ M + ridge, M.T @ b)
    b = b - M @ x0
    for _ in range(3):
        if np.abs(b).max() >= 1e-4 * np.abs(x0).max():
            break
        more = np.linalg.solve(M.T @ M + ridge, M.T @ b)
        x0, b = x0 + more, b - M @ more
    S = np.abs(b).max()
    b = b / S
    ns, N = len(cost), len(b)
    U = np.zeros((N, ns))
    U[np.arange(N), group] = 1.0
    top = np.array([np.abs(b[group == j]).max(initial=0.0) for j in range(ns)])
    count = U.sum(axis=0)
    s, x = np.maximum(1.2 * top + 1e-3, chain.floor * cost / S + 1e-3), np.zeros(M.shape[1])
    # rows of pairs: s - rho, s + rho, and the floors of s
    J = np.block([[-M, U], [M, U], [np.zeros((ns, M.shape[1])), np.eye(ns)]])
    low = chain.floor * cost / S
    w = np.r_[U @ s + b, U @ s - b, s - low]
    lam = (1.0 / (2 * np.maximum(count, 1)))[group]
    lm = np.r_[lam, lam, np.zeros(ns)]
    mu = (w[: 2 * N] @ lm[: 2 * N]) / (2 * N)
    lm[2 * N :] = mu / w[2 * N :]
    c = np.r_[np.zeros(M.shape[1]), np.ones(ns)]
    for it in range(iterations):
        value = s.sum()
        if w @ lm <= gap * (abs(value) + 1e-6):
            return (sx * (x0 + S * x)).reshape(T + 1, n), S * s / cost, it
        H = J.T @ ((lm / w)[:, None] * J) + np.diag(
            np.r_[np.full(M.shape[1], 1e-9 / (T + 1)), np.full(ns, 1e-9 / (T + 1))]
        )
        step = np.linalg.solve(H, -c)
        u = J @ step / w
        v = -1 - u
        ap, ad = min(1, 1 / max(-u.min(), 1e-300)), min(1, 1 / max(-v.min(), 1e-300))
        mu, affine = w @ lm / len(w), (w * (1 + ap * u)) @ (lm * (1 + ad * v)) / len(w)
        sigma = max(min((affine / mu) ** 3, 1.0), 0.2)
        zeta = (sigma * mu + min(1.0, 2 * np.sqrt(ap * ad)) * w * lm * u * (1 + u)) / w
        step = np.linalg.solve(H, -c + J.T @ zeta)
        un = J @ step / w
        vn = -1 - un + zeta / lm
        ap, ad = min(1, 0.9 / max(-un.min(), 1e-300)), min(1, 0.9 / max(-vn.min(), 1e-300))
        x, s = x + ap * step[: M.shape[1]], s + ap * step[M.shape[1] :]
        w, lm = w * (1 + ap * un), lm * (1 + ad * vn)
    raise AssertionError("no central point")


def problem(seed):
    """Return (kind, chain, well scaled chain, factor of its objective) of a random problem."""
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    n, m, T = int(rng.integers(1, 6)), int(rng.integers(1, 4)), int(rng.integers(2, 60))
    if kind == "T1":
        T = 1
    stack = T if kind == "varying" else 1
    A = rng.standard_normal((stack, n, n))
    for t in range(stack):
        A[t] *= rng.uniform(0.3, 1.05) / max(1e-3, np.abs(np.linalg.eigvals(A[t])).max())
    C = rng.standard_normal((stack, m, n)) * (rng.random((stack, m, n)) < 0.7)
    E = np.eye(n) + np.triu(rng.uniform(-0.5, 0.5, (n, n)), 1) if kind in ("E", "theta") or rng.random() < 0.2 else None
    q, r = rng.uniform(0.05, 0.5, n), rng.uniform(0.05, 0.8, m)
    if kind == "zero":
        q, r = 0 * q, 0 * r
    bx = rng.standard_normal((T, n)) * 0.5
    x = np.zeros((T + 1, n))
    x[0] = rng.standard_normal(n)
    inverse = np.eye(n) if E is None else np.linalg.inv(E)
    y = np.zeros((T, m))
    for t in range(T):
        x[t + 1] = inverse @ (A[t % stack] @ x[t] + bx[t] + rng.uniform(-q, q))
        y[t] = C[t % stack] @ x[t + 1] + rng.uniform(-r, r)
    seen = np.ones((T, m), bool)
    if kind == "missing" or rng.random() < 0.4:
        seen = rng.random((T, m)) < rng.uniform(0.3, 0.95)
    if kind == "unseen":
        seen[:] = False
    moving = kind == "varying"
    given = {
        "A": A if moving else A[0], "C": C if moving else C[0], "bx": bx, "by": np.where(seen, y, 1e9), "seen": seen,
        "group": np.arange(n + m, dtype=np.int32), "h": np.ones(n + m), "c": np.ones(n + m), "floor": np.zeros(n + m),
        "cap": np.full(n + m, np.inf), "E": E,
    }  # fmt: skip
    if kind == "box" or rng.random() < 0.25:
        lo, hi = np.quantile(x, 0.05, axis=0), np.quantile(x, 0.95, axis=0) + 1e-3
        open_ = rng.random(n)
        lo, hi = np.where(open_ < 0.2, -np.inf, lo), np.where(open_ > 0.8, np.inf, hi)
        if rng.random() < 0.5:
            lo, hi = np.tile(lo, (T + 1, 1)), np.tile(hi, (T + 1, 1))
        given |= {"lo": lo, "hi": hi}
    if rng.random() < 0.3:
        given |= {"x0_lo": x[0] - rng.uniform(0, 0.5, n), "x0_hi": x[0] + rng.uniform(0, 0.5, n)}
        if rng.random() < 0.3:
            given |= {"x0_lo": x[0].copy(), "x0_hi": x[0].copy()}
    if kind == "theta":
        p0 = int(rng.integers(1, 4))
        G = rng.standard_normal((T, n + m, p0)) * (rng.random((1, n + m, p0)) < 0.6)
        theta = rng.uniform(-1, 1, p0)
        given |= {"bx": bx + G[:, :n] @ theta, "by": given["by"] + np.where(seen, G[:, n:] @ theta, 0), "G": G}
        given["theta_lo"] = np.where(rng.random(p0) < 0.7, -1.0, -np.inf)
        given["theta_hi"] = np.where(rng.random(p0) < 0.7, 1.0, np.inf)
        if rng.random() < 0.2:
            given["theta_lo"][0] = given["theta_hi"][0] = 0.3
    if kind == "weights":
        given |= {"c": rng.uniform(0.2, 3, n + m), "floor": rng.uniform(0, 0.3, n + m)}
    if kind == "shared":
        given |= {"group": np.zeros(n + m, np.int32), "h": np.r_[np.maximum(q, 0.01), np.maximum(r, 0.01)]}
        given |= {"c": np.ones(1), "floor": np.zeros(1), "cap": np.full(1, np.inf)}
    if kind == "caps":
        given["cap"] = np.r_[q, r] * rng.uniform(0.7, 1.5)
    if kind == "infeasible":
        given["cap"] = np.r_[q, r] * rng.uniform(0.05, 0.4)
    given = {k: np.ascontiguousarray(v) if isinstance(v, np.ndarray) else v for k, v in given.items()}
    plain = Chain(**given)
    if kind != "scale":
        return kind, plain, plain, 1.0
    # The same problem with states and outputs in units up to twelve orders apart; or, where the cost is not changed with
    # them, a problem whose costs differ by three.
    same = rng.random() < 0.5
    reach = 6 if same else 1.5
    unit, out = 10.0 ** rng.uniform(-reach, reach, n), 10.0 ** rng.uniform(-reach, reach, m)
    D, Di = np.diag(unit), np.diag(1 / unit)
    bent = replace(
        plain,
        A=D @ plain.A @ Di,
        C=np.diag(out) @ plain.C @ Di,
        bx=bx * unit,
        by=np.where(seen, y * out, 0.0),
        E=None if E is None else D @ E @ Di,
        c=np.r_[1 / unit, 1 / out] if same else np.ones(n + m),
        **{k: getattr(plain, k) * unit for k in ("lo", "hi", "x0_lo", "x0_hi") if getattr(plain, k) is not None},
    )
    cost = bent.c * np.r_[unit, out]
    return kind, bent, replace(plain, by=np.where(seen, y, 0.0), c=cost / cost.max()), cost.max()
