"""The hull of a window in exact rational arithmetic: the dual bound of any multipliers, and the program itself."""

from fractions import Fraction

from tests.naive_box import INF, exact


def window_rows(E, A, C, bx, by, K, n, m):
    """Return dense exact rows [(coefficients as pairs, lo, hi)] of a window, time by time, dynamics first.

    E, A, C are pairs of ends (lower, upper), (rows, n) or (K, rows, n); bx, by pairs of (K, .) arrays.
    """

    def at(pair, t):
        return [end if end.ndim == 2 else end[t] for end in pair]

    rows = []
    for t in range(K):
        e, a, c = at(E, t), at(A, t), at(C, t)
        for i in range(n + m):
            row = [(Fraction(0), Fraction(0))] * ((K + 1) * n)
            for j in range(n):
                if i < n:
                    row[t * n + j] = (-exact(a[1][i][j]), -exact(a[0][i][j]))
                    row[(t + 1) * n + j] = (exact(e[0][i][j]), exact(e[1][i][j]))
                else:
                    row[(t + 1) * n + j] = (exact(c[0][i - n][j]), exact(c[1][i - n][j]))
            ends = (bx[0][t][i], bx[1][t][i]) if i < n else (by[0][t][i - n], by[1][t][i - n])
            rows.append((row, exact(ends[0]), exact(ends[1])))
    return rows


def dual_bound(rows, lo, hi, cost, y):
    """Return the exact bound of cost'x that multipliers y give, rows with interval entries widened over the box."""
    lo, hi = [exact(v) for v in lo], [exact(v) for v in hi]
    d, total = [Fraction(c) for c in cost], Fraction(0)
    for (row, b_lo, b_hi), weight in zip(rows, y, strict=True):
        w = Fraction(weight)
        if w == 0:
            continue
        widening = Fraction(0)
        for j, (a, b) in enumerate(row):
            if (a, b) != (0, 0):
                mid = a if a == b else exact(0.5 * float(a) + 0.5 * float(b))
                if a != b:
                    widening += max(b - mid, mid - a) * max(abs(lo[j]), abs(hi[j]))
                d[j] -= w * mid
        end = b_hi + widening if w > 0 else b_lo - widening
        if abs(end) == INF:
            d = [x + w * (row[j][0]) for j, x in enumerate(d)]
            continue
        total += w * end
    for j, x in enumerate(d):
        if x != 0:
            total += x * (hi[j] if x > 0 else lo[j])
    return total


def largest(rows, lo, hi, cost):
    """Return the exact maximum of cost'x over rows without interval entries and finite boxes, or None if there is no x.

    Dense two-phase simplex with Bland's rule on x = lo + s, 0 <= s <= hi - lo.
    """
    lo, hi = [exact(v) for v in lo], [exact(v) for v in hi]
    size = len(lo)
    G, h = [], []
    for j in range(size):
        G.append([Fraction(int(k == j)) for k in range(size)])
        h.append(hi[j] - lo[j])
    for row, b_lo, b_hi in rows:
        a = [p[0] for p in row]
        at = sum(x * v for x, v in zip(a, lo, strict=True))
        if b_hi != INF:
            G.append(a)
            h.append(b_hi - at)
        if b_lo != -INF:
            G.append([-x for x in a])
            h.append(at - b_lo)
    best = _simplex(G, h, [Fraction(c) for c in cost])
    return None if best is None else best + sum(Fraction(c) * v for c, v in zip(cost, lo, strict=True))


def _simplex(G, h, c):
    """Return max c's over G s <= h, s >= 0, or None if there is no s: dictionary form with one artificial variable."""
    m, n = len(G), len(c)
    # x_B[i] = b[i] - sum D[i][j] x_N[j]; column n is the artificial variable
    D = [[*row, Fraction(-1)] for row in G]
    b = list(h)
    basis, free = [n + 1 + i for i in range(m)], [*range(n), n]

    def pivot(i, j, costs):
        p = D[i][j]
        D[i] = [v / p for v in D[i]]
        D[i][j] = 1 / p
        b[i] /= p
        for k in range(m):
            f = D[k][j]
            if k != i and f != 0:
                b[k] -= f * b[i]
                row = D[i]
                D[k] = [v - f * w if q != j else -f / p for q, (v, w) in enumerate(zip(D[k], row, strict=True))]
        for cost in costs:
            f = cost[0][j]
            if f != 0:
                cost[1] += f * b[i]
                cost[0] = [v - f * w if q != j else -f / p for q, (v, w) in enumerate(zip(cost[0], D[i], strict=True))]
        basis[i], free[j] = free[j], basis[i]

    def run(cost, costs):
        while True:
            enter = [j for j in range(len(free)) if cost[0][j] > 0 and free[j] not in barred]
            if not enter:
                return
            j = min(enter, key=lambda q: free[q])
            ratio = [(b[i] / D[i][j], basis[i], i) for i in range(m) if D[i][j] > 0]
            pivot(min(ratio)[2], j, costs)

    barred = set()
    goal = [[*c, Fraction(0)], Fraction(0)]
    first = [[Fraction(0)] * n + [Fraction(-1)], Fraction(0)]
    if min(b) < 0:
        i = min(range(m), key=lambda k: b[k])
        pivot(i, n, [goal, first])
        run(first, [goal, first])
        if first[1] < 0:
            return None
        if n in basis:
            i = basis.index(n)
            j = next(q for q in range(len(free)) if D[i][q] != 0)
            pivot(i, j, [goal, first])
    barred.add(n)
    run(goal, [goal])
    return goal[1]
