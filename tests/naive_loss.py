"""Textbook twins of the loss filters: a plain mixture of Kalman filters, and every history enumerated."""

import itertools

import numpy as np


def uniforms(seed):
    """The kernel's random numbers (splitmix64), in [0, 1)."""
    mask = (1 << 64) - 1
    state = seed
    while True:
        state = (state + 0x9E3779B97F4A7C15) & mask
        z = state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        yield ((z ^ (z >> 31)) >> 11) * 2.0**-53


def logsumexp(a):
    a = np.asarray(a)
    m = a.max()
    return m if m == -np.inf else m + np.log(np.exp(a - m).sum())


def predict(A, b, Q, x, P):
    return A @ x + b, A @ P @ A.T + Q


def correct(C, d, R, x, P, y, seen):
    """Joint correction by the seen entries; returns log density, mean, covariance."""
    i = np.flatnonzero(seen)
    if len(i) == 0:
        return 0.0, x, P
    C, R, e = C[i], R[np.ix_(i, i)], y[i] - d[i] - C[i] @ x
    S = C @ P @ C.T + R
    K = np.linalg.solve(S, C @ P).T
    IKC = np.eye(len(x)) - K @ C
    ll = -0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(S)[1] + len(i) * np.log(2 * np.pi))
    P = IKC @ P @ IKC.T + K @ R @ K.T
    return ll, x + K @ e, 0.5 * (P + P.T)


def moments(w, xs, Ps, spread=True):
    w = np.asarray(w) / np.sum(w)
    x = np.einsum("k,ki->i", w, xs)
    P = np.einsum("k,kij->ij", w, Ps)
    if spread:
        D = np.asarray(xs) - x
        P = P + np.einsum("k,ki,kj->ij", w, D, D)
    return x, P


def row(M, t):
    """The part of a (1 or T, ...) array that belongs to row t."""
    return M[t if len(M) > 1 else 0]


class Mix:
    """A mixture of Kalman filters; `rule` brings the children (newest mode, component, logw, x, P) down again."""

    def __init__(self, p, rule, *, first, out_before=True, spread=True):
        self.p, self.rule, self.out_before, self.spread = p, rule, out_before, spread
        self.parts = first  # list of (history, logw, x, P)

    def run(self):
        p = self.p
        T, M = len(p["y"]), p["C"].shape[1]
        xs, Ps, modes, lls = [], [], [], []
        with np.errstate(divide="ignore"):
            prior = np.log(p["pi0"])
        self.mix = None
        for t in range(T):
            with np.errstate(divide="ignore"):
                logPi = np.log(row(p["Pi"], t))
            children = []
            for history, lw, x, P in self.parts:
                if t or not p.get("prior_predicted"):
                    x, P = predict(row(p["A"], t), row(p["b"], t), row(p["Q"], t), x, P)
                for s in range(M):
                    if t == 0:
                        lp = prior[s]
                    elif self.mix is not None:
                        with np.errstate(divide="ignore"):
                            lp = np.log(self.mix @ np.exp(logPi[:, s]))
                    else:
                        lp = logPi[history[-1], s]
                    ll, xc, Pc = correct(
                        row(p["C"], t)[s], row(p["d"], t)[s], row(p["R"], t)[s], x, P, p["y"][t], p["seen"][t]
                    )
                    children.append((history + (s,), lw + lp + ll, xc, Pc))
            total = logsumexp([c[1] for c in children])
            children = [(h, lw - total, x, P) for h, lw, x, P in children]
            lls.append(total)
            self.t = t
            self.parts = self.rule(self, children)
            source = children if self.out_before else self.parts
            w = np.exp([c[1] for c in source])
            x, P = moments(w, [c[2] for c in source], [c[3] for c in source], self.spread)
            xs.append(x)
            Ps.append(P)
            modes.append([w[[c[0][-1] == s for c in source]].sum() / w.sum() for s in range(M)])
        return {"x": np.array(xs), "P": np.array(Ps), "modes": np.array(modes), "loglik": np.array(lls)}


def start(p):
    return [((), 0.0, np.array(p["x0"]), np.array(p["P0"]))]


def gpb(p, depth, spread=True):
    """Children with the same last `depth` modes become one Gaussian."""

    def rule(mix, children):
        groups = {}
        for c in children:
            groups.setdefault(c[0][-depth:] if depth else (), []).append(c)
        out = []
        for key in sorted(groups):
            part = groups[key]
            lw = logsumexp([c[1] for c in part])
            if lw == -np.inf:
                continue
            w = np.exp(np.array([c[1] for c in part]) - lw)
            out.append((key, lw, *moments(w, [c[2] for c in part], [c[3] for c in part], spread)))
        if depth == 0:
            M = p["C"].shape[1]
            mode = [c[0][-1] for c in children]
            mix.mix = np.array(
                [sum(np.exp(c[1]) for c, m in zip(children, mode, strict=True) if m == s) for s in range(M)]
            )
        return out

    return Mix(p, rule, first=start(p), spread=spread).run()


def beam(p, width):
    """Keep the likeliest children."""

    def rule(mix, children):
        keep = sorted(children, key=lambda c: (-c[1], c[0][-1]))[:width]
        keep = [c for c in keep if c[1] > -np.inf]
        total = logsumexp([c[1] for c in keep])
        return [(h, lw - total, x, P) for h, lw, x, P in keep]

    return Mix(p, rule, first=start(p), out_before=False).run()


def rbpf(p, particles, seed, threshold=0.5):
    """Optimal proposal, answer before the draw, systematic resampling."""
    u = uniforms(seed)
    M = p["C"].shape[1]

    def rule(mix, children):
        new = []
        draws = [next(u) for _ in range(-(-particles // 4) * 4)]  # the kernel draws for whole blocks
        for i in range(0, len(children), M):
            lw = np.array([c[1] for c in children[i : i + M]])
            w = np.exp(lw)
            starts = np.concatenate([[0.0], np.cumsum(w)[:-1]])
            s = max(np.flatnonzero((starts <= w.sum() * draws[i // M]) & (w > 0)), default=0)
            h, _, x, P = children[i + s]
            new.append((h, logsumexp(lw), x, P))
        W = np.exp([c[1] for c in new])
        if W.sum() ** 2 >= threshold * len(new) * (W**2).sum() and np.all(W > 0):
            return new
        edges = np.cumsum(W)
        first = next(u)
        at = np.searchsorted(edges, (np.arange(particles) + first) / particles * W.sum(), side="right")
        return [(new[i][0], -np.log(particles), new[i][2], new[i][3]) for i in np.minimum(at, particles - 1)]

    first = [((), -np.log(particles), np.array(p["x0"]), np.array(p["P0"]))] * particles
    return Mix(p, rule, first=first).run()


def fearnhead_clifford(p, particles, seed):
    """Optimal resampling of all children."""
    u = uniforms(seed)

    def rule(mix, children):
        # the kernel numbers children by mode first
        M = p["C"].shape[1]
        children = [children[i * M + s] for s in range(M) for i in range(len(children) // M)]
        w = np.exp([c[1] for c in children])
        alive = [i for i in range(len(w)) if w[i] > 1e-14 * w.max()]
        if len(alive) <= particles:
            new = [children[i] for i in alive]
        else:
            order = sorted(alive, key=lambda i: (-w[i], i))
            rest = w[order].sum()
            sure = 0
            while sure < particles - 1 and w[order[sure]] * (particles - sure) >= rest:
                rest -= w[order[sure]]
                sure += 1
            c = rest / (particles - sure)
            new = []
            left = c * next(u)
            for i in alive:
                if len(new) == particles:
                    break
                h, lw, x, P = children[i]
                if w[i] < c:
                    left -= w[i]
                    if left >= 0:
                        continue
                    left += c
                    lw = np.log(c)
                new.append((h, lw, x, P))
        total = logsumexp([c[1] for c in new])
        return [(h, lw - total, x, P) for h, lw, x, P in new]

    return Mix(p, rule, first=start(p)).run()


def runnalls(p, components):
    """Merge the pair with the least bound until few enough are left."""
    Pi = p["Pi"]
    independent = bool(np.all(Pi == Pi[:, :1]))

    def rule(mix, children):
        w = np.exp([c[1] for c in children])
        parts = [[c[0][-1], wi, c[2], c[3]] for c, wi in zip(children, w, strict=True) if wi > 1e-8 * w.max()]
        while len(parts) > components:
            best = None
            for i, j in itertools.combinations(range(len(parts)), 2):
                a, b = parts[i], parts[j]
                if not independent and a[0] != b[0]:
                    continue
                _, P = moments([a[1], b[1]], [a[2], b[2]], [a[3], b[3]])
                logdet = [np.linalg.slogdet(m)[1] for m in (P, a[3], b[3])]
                cost = 0.5 * ((a[1] + b[1]) * logdet[0] - a[1] * logdet[1] - b[1] * logdet[2])
                if best is None or cost < best[0]:
                    best = (cost, i, j)
            _, i, j = best
            a, b = parts[i], parts[j]
            x, P = moments([a[1], b[1]], [a[2], b[2]], [a[3], b[3]])
            parts[i] = [a[0], a[1] + b[1], x, P]
            del parts[j]
        total = sum(c[1] for c in parts)
        return [((m,), np.log(wi / total), x, P) for m, wi, x, P in parts]

    return Mix(p, rule, first=start(p)).run()


def imm(p):
    """Interacting multiple models: one filter a mode, mixed before each prediction."""
    T, M = len(p["y"]), p["C"].shape[1]
    x, P = [np.array(p["x0"])] * M, [np.array(p["P0"])] * M
    mu = np.array(p["pi0"])
    xs, Ps, modes = [], [], []
    for t in range(T):
        if t == 0:
            c, w = mu, np.tile(mu[:, None], (1, M)) * 0 + 1.0 / M
        else:
            Pi = row(p["Pi"], t)
            c = mu @ Pi
            w = mu[:, None] * Pi / np.maximum(c, 1e-300)
        mixed = [moments(w[:, j], x, P) for j in range(M)]
        ll = np.empty(M)
        x, P = list(x), list(P)
        for j in range(M):
            xj, Pj = mixed[j]
            if t or not p.get("prior_predicted"):
                xj, Pj = predict(row(p["A"], t), row(p["b"], t), row(p["Q"], t), xj, Pj)
            ll[j], x[j], P[j] = correct(
                row(p["C"], t)[j], row(p["d"], t)[j], row(p["R"], t)[j], xj, Pj, p["y"][t], p["seen"][t]
            )
        a = np.log(c) + ll
        mu = np.exp(a - logsumexp(a))
        X, V = moments(mu, x, P)
        xs.append(X)
        Ps.append(V)
        modes.append(mu)
    return {"x": np.array(xs), "P": np.array(Ps), "modes": np.array(modes)}


def enumerate_all(p, smooth=False):
    """Every history of modes, exactly: filter, or smoother, with P(mode) and log-likelihood."""
    T, M = len(p["y"]), p["C"].shape[1]
    parts = [((), 0.0, np.array(p["x0"]), np.array(p["P0"]), [])]
    xs, Ps, modes, lls = [], [], [], []
    for t in range(T):
        with np.errstate(divide="ignore"):
            logPi, first = np.log(row(p["Pi"], t)), np.log(p["pi0"])
        new = []
        for h, lw, x, P, past in parts:
            if t or not p.get("prior_predicted"):
                x, P = predict(row(p["A"], t), row(p["b"], t), row(p["Q"], t), x, P)
            for s in range(M):
                lp = first[s] if t == 0 else logPi[h[-1], s]
                if lp == -np.inf:
                    continue
                ll, xc, Pc = correct(
                    row(p["C"], t)[s], row(p["d"], t)[s], row(p["R"], t)[s], x, P, p["y"][t], p["seen"][t]
                )
                new.append((h + (s,), lw + lp + ll, xc, Pc, [*past, (xc, Pc)] if smooth else past))
        parts = new
        lw = np.array([c[1] for c in parts])
        total = logsumexp(lw)
        w = np.exp(lw - total)
        lls.append(total)
        if not smooth:
            x, P = moments(w, [c[2] for c in parts], [c[3] for c in parts])
            xs.append(x)
            Ps.append(P)
            last = np.array([c[0][-1] for c in parts])
            modes.append([w[last == s].sum() for s in range(M)])
    loglik = np.diff(lls, prepend=0.0)
    if not smooth:
        return {"x": np.array(xs), "P": np.array(Ps), "modes": np.array(modes), "loglik": loglik}
    H = np.array([c[0] for c in parts])
    X = np.array([[f[0] for f in c[4]] for c in parts])
    V = np.array([[f[1] for f in c[4]] for c in parts])
    Xs, Vs = X.copy(), V.copy()
    for t in range(T - 2, -1, -1):
        A, b, Q = row(p["A"], t + 1), row(p["b"], t + 1), row(p["Q"], t + 1)
        Pm = A @ V[:, t] @ A.T + Q
        J = np.swapaxes(np.linalg.solve(Pm, A @ V[:, t]), 1, 2)
        Xs[:, t] = X[:, t] + np.einsum("kij,kj->ki", J, Xs[:, t + 1] - X[:, t] @ A.T - b)
        Vs[:, t] = V[:, t] + J @ (Vs[:, t + 1] - Pm) @ np.swapaxes(J, 1, 2)
    for t in range(T):
        x, P = moments(w, Xs[:, t], Vs[:, t])
        xs.append(x)
        Ps.append(P)
        modes.append([w[H[:, t] == s].sum() for s in range(M)])
    pairs = np.array(
        [[sum(w[(H[:, t - 1] == i) & (H[:, t] == j)].sum() for t in range(1, T)) for j in range(M)] for i in range(M)]
    )
    return {"x": np.array(xs), "P": np.array(Ps), "modes": np.array(modes), "loglik": loglik, "pairs": pairs}


def kim(p, depth):
    """Depth-d smoother: cells that remember the last depth + 1 modes, histories as dictionary keys."""
    T, M = len(p["y"]), p["C"].shape[1]
    store = []

    def rule(mix, children):
        groups = {}
        cells = []
        for c in children:
            cells.append(((c[0])[-depth - 1 :], c[1], c[2], c[3]))
            groups.setdefault(c[0][-depth:] if depth else (), []).append(c)
        store.append(cells)
        out = []
        for key in sorted(groups):
            part = groups[key]
            lw = logsumexp([c[1] for c in part])
            if lw == -np.inf:
                continue
            w = np.exp(np.array([c[1] for c in part]) - lw)
            out.append((key, lw, *moments(w, [c[2] for c in part], [c[3] for c in part])))
        if depth == 0:
            mix.mix = np.array([sum(np.exp(c[1]) for c in children if c[0][-1] == s) for s in range(M)])
        return out

    Mix(p, rule, first=start(p)).run()
    cells = [(k, np.exp(lw), x, P) for k, lw, x, P in store[-1]]
    xs, Ps, modes = [None] * T, [None] * T, [None] * T
    for t in range(T - 1, -1, -1):
        if t < T - 1:
            A, b, Q = row(p["A"], t + 1), row(p["b"], t + 1), row(p["Q"], t + 1)
            parents = {}
            for c in cells:
                parents.setdefault(c[0][:-1], []).append(c)
            parents = {
                k: (sum(c[1] for c in part), *moments([c[1] for c in part], [c[2] for c in part], [c[3] for c in part]))
                for k, part in parents.items()
                if sum(c[1] for c in part) > 0
            }
            new = []
            for k, lw, x, P in store[t]:
                key = k[-depth:] if depth else ()
                if key not in parents:
                    continue
                if lw == -np.inf:
                    continue
                siblings = logsumexp([c[1] for c in store[t] if (c[0][-depth:] if depth else ()) == key])
                W, xp, Pp = parents[key]
                xm, Pm = predict(A, b, Q, x, P)
                J = np.linalg.solve(Pm, A @ P).T
                new.append((k, W * np.exp(lw - siblings), x + J @ (xp - xm), P + J @ (Pp - Pm) @ J.T))
            cells = new
        w = np.array([c[1] for c in cells])
        xs[t], Ps[t] = moments(w, [c[2] for c in cells], [c[3] for c in cells])
        modes[t] = [w[[c[0][-1] == s for c in cells]].sum() / w.sum() for s in range(M)]
    return {"x": np.array(xs), "P": np.array(Ps), "modes": np.array(modes)}
