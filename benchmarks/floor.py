"""Print how much of the error across gaps of real logs is that of the hidden fixes themselves.

    python benchmarks/floor.py [FOLDER OF LOGS] [--starts 100] [--seed 7] [--draws 10]

A filled gap is compared with the fixes that were hidden in it, and they are wrong as well. The chain is given all fixes
of the log; what is left between them and its path is their error. A method that knows the path perfectly, and the
fixes' error before and after the gap, still has to guess how that error goes in between, and a straight line is the
guess. So

    floor  is the error of that straight line: nothing that a method did wrong is in it;
    told   is the same with a hint that nobody has: how far the error of the fixes moves from each hidden fix to the
           next, though not in which direction.

It is no strict bound: how the fixes' error moves at the edges of the gap is known as well, and a method that uses that
may come out a little below.

A jump is a step of the fixes' error of more than ten times the usual one (the median of the log): the last columns leave
out the outages with one. The path of the chain bends a little towards the fixes that it is given, which makes the floor
too low, and what is wrong with the sensors and looks like an error of the fixes makes it too high: so beside it stands
the floor by reckoning, where the path in the gap is nothing but measured speed along the azimuth.

The second table draws the twenty random starts of the protocol again and again (seeds 1, 2, ...), since the numbers asked
come from one such draw: the median of the cells, and the share of the draws that meet what was asked, of the method and
of the floor. All numbers are mean / mean of maxima, m.
"""

import argparse
from pathlib import Path

import numpy as np
from accuracy import ASKED

import halfwidth as hw
from halfwidth.vehicle import chain
from halfwidth.vehicle.align import calibrated
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.stamps import restamped

#: A jump of the fixes' error is a step this many times the median one; starts of a draw.
JUMP, DRAW = 10.0, 20


class Fixes:
    """Fixes of a log and how wrong they are: by the path of the chain, and by speed along its azimuth."""

    def __init__(self, log):
        log = restamped(log)[0]
        drive = sampled(log, sensors=calibrated(log))
        z = chain.solve([drive])[0].z
        azimuth = np.concatenate((z[:1, chain.AZIMUTH], 0.5 * (z[1:, chain.AZIMUTH] + z[:-1, chain.AZIMUTH])))
        way = z[:, chain.SCALE] * drive.speed * drive.h
        reckoned = np.cumsum(way[:, None] * np.column_stack((np.sin(azimuth), np.cos(azimuth))), axis=0)
        fixes = np.column_stack((drive.east, drive.north))
        self.t = drive.t[drive.seen]
        self.error = (fixes - z[:, [chain.E, chain.N]])[drive.seen]
        self.reckoned = (fixes - reckoned)[drive.seen]

    def hidden(self, start, length):
        """Return the rows of the hidden fixes with one before and one after."""
        inside = np.flatnonzero((self.t >= start) & (self.t <= start + length))
        return np.arange(inside[0] - 1, inside[-1] + 2)

    def jumps(self, starts, length):
        """Return which outages have a jump of the fixes' error inside."""
        step = _steps(self.error)
        usual = np.median(step[1:])
        return np.array([step[self.hidden(start, length)[1:]].max() > JUMP * usual for start in starts])

    def cell(self, starts, length, error=None, told=False):
        """Return means, maxima and counts of the distance to a straight course of the fixes' error, (n,) each."""
        error = self.error if error is None else error
        clock = np.cumsum(_steps(error) + 1e-9) if told else self.t
        found = []
        for start in starts:
            rows = self.hidden(start, length)
            share = ((clock[rows] - clock[rows[0]]) / (clock[rows[-1]] - clock[rows[0]]))[:, None]
            off = error[rows] - (1.0 - share) * error[rows[0]] - share * error[rows[-1]]
            distance = np.hypot(*off[1:-1].T)
            found.append((distance.mean(), distance.max(), distance.size))
        return np.array(found).T


def _steps(error):
    return np.hypot(*np.diff(error, axis=0, prepend=error[:1]).T)


def both(means, maxima, counts):
    return np.average(means, weights=counts), np.mean(maxima)


def pair(numbers):
    return f"{numbers[0]:.3f} / {numbers[1]:.3f}"


def floors(fixes, found, rows):
    """Print for each length what was asked, the method, and the floor on the same starts."""
    print(
        f"{'':6}{'asked':>13}{'em':>15}{'s.e.':>15}{'floor':>15}{'reckoned':>15}{'told':>15}{'jumps':>7}"
        f"{'em without':>15}{'floor without':>15}"
    )
    for length, (wanted, _) in rows.items():
        em = found.cell("em", length)
        floor = fixes.cell(em.start, length)
        calm = ~fixes.jumps(em.start, length)
        own = np.array((em.mean_error, em.max_error, em.n_fixes))
        without = [pair(both(*cell[:, calm])) if calm.sum() > 1 else "" for cell in (own, floor)]
        print(
            f"{length:>4g} s{f'{wanted[0]:g} / {wanted[1]:g}':>13}{pair((em.mean, em.max)):>15}"
            f"{pair((em.mean_se, em.max_se)):>15}{pair(both(*floor)):>15}"
            f"{pair(both(*fixes.cell(em.start, length, fixes.reckoned))):>15}"
            f"{pair(both(*fixes.cell(em.start, length, told=True))):>15}{100 * (1 - calm.mean()):>5.0f} %"
            f"{without[0]:>15}{without[1]:>15}",
            flush=True,
        )


def drawn(log, fixes, rows, draws):
    """Print how cells of twenty starts scatter from draw to draw."""
    lengths = tuple(rows)
    tables = [hw.vehicle.outages(log, lengths, DRAW, seed, ("em",)) for seed in range(1, draws + 1)]
    print(
        f"\n{draws} draws of {DRAW} starts: median of the cells, range of their means; share that meets: mean, max, both"
    )
    for length, (wanted, _) in rows.items():
        cells = [table.cell("em", length) for table in tables]
        em = np.array([(cell.mean, cell.max) for cell in cells])
        floor = np.array([both(*fixes.cell(cell.start, length)) for cell in cells])
        words = [f"{length:>4g} s  asked {f'{wanted[0]:g} / {wanted[1]:g}':>11}"]
        for name, values in (("em", em), ("floor", floor)):
            met = values <= wanted
            shares = " ".join(f"{100 * share:3.0f}" for share in (*met.mean(axis=0), met.all(axis=1).mean()))
            low, high = values[:, 0].min(), values[:, 0].max()
            words.append(f"{name} {pair(np.median(values, axis=0))} ({low:.2f} to {high:.2f}) {shares} %")
        print("    ".join(words), flush=True)


def main():
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=root.parent / "shared" / "data")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--draws", type=int, default=10)
    asked = parser.parse_args()
    for path in sorted(asked.folder.glob("*.csv*")):
        rows = next((rows for start, rows in ASKED.items() if path.name.startswith(start)), None)
        if rows is None:
            continue
        log = hw.vehicle.read(path)
        fixes = Fixes(log)
        found = hw.vehicle.outages(log, tuple(rows), asked.starts, asked.seed, ("em",))
        print(f"\n=== {path.name}: {asked.starts} starts, seed {asked.seed}")
        step = _steps(fixes.error)[1:]
        print(f"error of the fixes, from one to the next: usually {np.median(step):.3f} m, at most {step.max():.2f} m")
        floors(fixes, found, rows)
        if asked.draws:
            drawn(log, fixes, rows, asked.draws)


if __name__ == "__main__":
    main()
