"""Forward-backward contraction of linear rows in exact rational arithmetic, the twin of core/box.hpp."""

from fractions import Fraction

INF = float("inf")


class Empty(Exception):
    """No point of the box fits a row; holds its number."""


def exact(number):
    return number if abs(number) == INF else Fraction(number)


def product(a, x):
    (al, ah), (xl, xh) = a, x
    every = [Fraction(0) if 0 in (p, q) else p * q for p in (al, ah) for q in (xl, xh)]
    return min(every), max(every)


def total(parts):
    parts = list(parts)
    return sum((p[0] for p in parts), Fraction(0)), sum((p[1] for p in parts), Fraction(0))


def row(a, b, x):
    """Contract the list x of (lo, hi) in place by sum a x in b."""
    if b == (-INF, INF):
        return True
    live = [j for j in range(len(a)) if a[j] != (0, 0)]
    terms = {j: product(a[j], x[j]) for j in live}
    lo, hi = total(terms.values())
    if lo > b[1] or hi < b[0]:
        return False
    for j in live:
        al, ah = a[j]
        if al <= 0 <= ah:
            continue
        lo, hi = total(terms[k] for k in live if k != j)
        s = (b[0] - hi, b[1] - lo)
        if ah < 0:
            s, al, ah = (-s[1], -s[0]), -ah, -al
        new = (s[0] / (ah if s[0] >= 0 else al), s[1] / (al if s[1] >= 0 else ah))
        x[j] = (max(x[j][0], new[0]), min(x[j][1], new[1]))
        if x[j][0] > x[j][1]:
            return False
    return True


def contract(E, A, C, bx, by, box, sweeps):
    """Sweep a chain; matrices [t][i][j], bx, by [t][i] and box [t][j] all hold pairs (lo, hi). The box comes back."""
    T, n = len(bx), len(box[0])
    m = len(by[0]) if T else 0
    box = [list(x) for x in box]

    def dynamics(t, two):
        for i in reversed(range(n)):
            a = [(-h, -low) for low, h in A[t][i]] + list(E[t][i])
            if not row(a, bx[t][i], two):
                raise Empty(1 + t * (n + m) + i)

    def outputs(t, x):
        for i in range(m):
            if not row(C[t][i], by[t][i], x):
                raise Empty(1 + t * (n + m) + n + i)

    if sweeps == 0:
        for t in range(T):
            two = box[t] + box[t + 1]
            for _ in range(2):
                dynamics(t, two)
                x = two[n:]
                outputs(t, x)
                two[n:] = x
            box[t + 1] = two[n:]
    for _ in range(sweeps):
        for t in range(T):
            two = box[t] + box[t + 1]
            dynamics(t, two)
            box[t], box[t + 1] = two[:n], two[n:]
            outputs(t, box[t + 1])
        for t in reversed(range(T)):
            outputs(t, box[t + 1])
            two = box[t] + box[t + 1]
            dynamics(t, two)
            box[t], box[t + 1] = two[:n], two[n:]
    return box
