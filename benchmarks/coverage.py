"""Print how many removed fixes lie in the half-widths that `fill` states, for a user who never saw them.

    python benchmarks/coverage.py [LOGS OR FOLDER ...] [--simulated 8] [--lengths 5,10,20,30,60] [--gaps 40] [--seed 1]
                                  [--method tube]

Fixes are removed at evenly spread places from a random first one on before `fill` sees the log, several gaps at a time if they are far apart; the log is
then filled as a user would, with its own choice of method and its own test of the half-widths on what is left. The
removed fixes, east and north counted apart, are inside or not. Gaps drawn at random overlap each other, so the standard
error beside the share weighs each pair of gaps by how much of them is the same stretch of the log (Bartlett's kernel);
"apart" says how many gaps of that length the log has room for. The line "all" is over every gap of the log, each
counting the same. The score is that of Winkler (1972): the whole width, and 2 / (1 - level) times what a fix lies
beyond it; a lower one is better, and neither wide nor lucky intervals win.

Simulated drives, with errors of the fixes drawn anew for each, show the same, and beside it how often the *truth* lies
inside the stated interval, and inside the one that `Track.truth_half_m` states.
"""

import argparse
import time
from pathlib import Path

import hidden
import numpy as np

import halfwidth as hw
from halfwidth.vehicle.frames import Frame
from halfwidth.vehicle.outage import MARGIN, MIN_SPEED

#: Fixes that are left between two gaps, s, at least; never less than the length of a gap.
APART = 60.0


def places(log, length, rng):
    """Draw the beginnings of gaps that one run removes: moving, with fixes on both sides, far from each other.

    They are evenly spread from a random first one on, so that every place of the log is as likely as any other: gaps
    drawn one by one, each far from those before, crowd at the ends.
    """
    t = log.t[log.fixed]
    east, north = Frame.of(log).to_local(log.lat_deg[log.fixed], log.lon_deg[log.fixed])
    usual = np.median(np.diff(t))
    period = length + max(APART, length)
    chosen = []
    for begin in np.arange(t[0] + MARGIN + rng.uniform(0, period), t[-1] - MARGIN - length, period):
        a, b = np.searchsorted(t, [begin, begin + length])
        whole = b - a >= 0.8 * length / usual - 1
        # moved further than the fixes scatter
        inside = np.column_stack((east[a:b], north[a:b]))[:: max(1, round(1.0 / usual))]
        moves = inside.shape[0] > 1 and np.hypot(*np.diff(inside, axis=0).T).sum() > MIN_SPEED * length
        sides = np.searchsorted(t, begin - MARGIN) < a - 1 and np.searchsorted(t, begin + length + MARGIN) > b + 1
        if whole and moves and sides:
            chosen.append(float(begin))
    return chosen


def one_run(log, begins, length, truth=None, drive=0, **how):
    """Remove gaps, fill, and return for each the errors and half-widths at the removed fixes, (n, 2) each."""
    track = hw.vehicle.fill(hidden.without(log, begins, length), **how)
    found = []
    for begin in begins:
        off, half, at = hidden.compared(log, track, begin, length)
        if not off.size:
            continue
        one = {"begin": begin, "length": length, "drive": drive, "off": off, "half": half, "level": track.level}
        if truth is not None:
            when = track.t_s[at] - truth.clock_offset  # the track is on the clock of the fixes
            one["true"] = np.column_stack(truth.error_m(when, track.lat_deg[at], track.lon_deg[at]))
            one["truth_half"] = half if track.truth_half_m is None else track.truth_half_m[at]
        found.append(one)
    return found


def share_and_error(inside, begin, length, drive):
    """Return the mean share inside and its standard error; gaps of one drive that overlap are not independent."""
    inside, begin, length, drive = (np.asarray(v) for v in (inside, begin, length, drive))
    rest = inside - inside.mean()
    middle, mean = begin + length / 2, (length[:, None] + length) / 2
    alike = (drive[:, None] == drive) * np.maximum(0.0, 1 - np.abs(middle[:, None] - middle) / (1.5 * mean))
    return inside.mean(), float(np.sqrt(max(rest @ alike @ rest, 0.0)) / inside.size)


def row(length, gaps, room, seconds, truths):
    """Print one line of the table; `length` is None for the gaps of all lengths."""
    level = gaps[0]["level"]
    inside = [np.mean(np.abs(g["off"]) <= g["half"]) for g in gaps]
    share, error = share_and_error(inside, *([g[key] for g in gaps] for key in ("begin", "length", "drive")))
    mean = np.mean([np.hypot(*g["off"].T).mean() for g in gaps])
    off, half = (np.concatenate([g[key] for g in gaps]).ravel() for key in ("off", "half"))
    score = np.mean(2 * half + 2 / (1 - level) * np.maximum(np.abs(off) - half, 0))
    said = f"{'all':>15}" if length is None else f"{length:>13g} s"
    text = f"{said}{len(gaps):>6}{room:>7.0f}{mean:>9.2f}{share:>8.3f} +- {error:.3f}"
    text += f"{np.median(half):>9.2f}{score:>9.2f}{seconds:>8.2f}"
    if truths:
        for key in ("half", "truth_half"):
            text += f"{np.mean([np.mean(np.abs(g['true']) <= g[key]) for g in gaps]):>9.3f}"
        text += f"{np.median(np.concatenate([g['truth_half'] for g in gaps])):>9.2f}"
    print(text, flush=True)


HEAD = f"{'':15}{'gaps':>6}{'apart':>7}{'mean m':>9}{'inside':>8}    s.e.{'half m':>9}{'score m':>9}{'s':>8}"


def on_log(log, lengths, wanted, seed, **how):
    """Print the table of one log."""
    print(HEAD)
    every = []
    for length in lengths:
        rng = np.random.default_rng([seed, round(1000 * length)])
        gaps, seconds, empty = [], [], 0
        while len(gaps) < wanted:
            begins = places(log, length, rng)
            if not begins:
                empty += 1
                if empty == 20:
                    break
                continue
            clock = time.process_time()
            gaps += one_run(log, begins, length, **how)
            seconds.append(time.process_time() - clock)
        if gaps:
            row(length, gaps, np.ptp(log.t[log.fixed]) / length, np.median(seconds), False)
            every += gaps
    if every:
        row(None, every, np.nan, np.nan, False)


def drives(count, seed):
    """Simulate drives whose receivers and sensors differ: from centimetres to metres, white to slow."""
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        white, slow = 10 ** rng.uniform(-2, 0.2), 10 ** rng.uniform(-2, 0.7)
        yield hw.vehicle.simulate_drive(
            duration=float(rng.uniform(240, 900)),
            seed=int(rng.integers(1, 2**31)),
            rate=10.0,
            fix_rate=float(rng.choice([1.0, 5.0, 10.0])),
            tunnels=(),
            fix_noise=white,
            fix_offset=slow,
            fix_offset_time=float(10 ** rng.uniform(1, 2.3)),
            clock_offset=float(rng.uniform(-0.2, 0.3)),
            speed_scale=float(rng.uniform(0.98, 1.02)),
            yaw_noise=float(10 ** rng.uniform(-3, -1.7)),
            yaw_bias=float(rng.uniform(0, 0.01)),
        )


def on_drives(count, lengths, wanted, seed, **how):
    """Print the table of simulated drives, each length over all of them."""
    print(HEAD + f"{'truth':>9}{'in t.h.':>9}{'t.h. m':>9}")
    made, every = list(drives(count, seed)), []
    for length in lengths:
        gaps, seconds, room = [], [], 0.0
        for k, (truth, log) in enumerate(made):
            rng = np.random.default_rng([seed, k, round(1000 * length)])
            begins = rng.permutation(places(log, length, rng))[: max(1, round(wanted / count))].tolist()
            clock = time.process_time()
            gaps += one_run(log, begins, length, truth, k, **how) if begins else []
            seconds.append(time.process_time() - clock)
            room += np.ptp(log.t) / length
        row(length, gaps, room, np.median(seconds), True)
        every += gaps
    row(None, every, np.nan, np.nan, True)


def main():
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--simulated", type=int, default=8, help="how many drives are simulated")
    parser.add_argument("--gaps", type=int, default=40, help="gaps of each length")
    parser.add_argument("--lengths", default="5,10,20,30,60")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--method", help="of `fill`, instead of its own choice")
    asked = parser.parse_args()
    lengths = [float(length) for length in asked.lengths.split(",")]
    folder = root.parent / "shared" / "data"
    given = asked.logs or ([folder] if folder.exists() else [])
    logs = [path for one in given for path in (sorted(one.glob("*.csv*")) if one.is_dir() else [one])]
    for path in logs:
        print(f"\n=== {path.name}")
        on_log(hw.vehicle.read(path), lengths, asked.gaps, asked.seed, method=asked.method)
    if asked.simulated:
        print(f"\n=== {asked.simulated} simulated drives")
        on_drives(asked.simulated, lengths, asked.gaps, asked.seed, method=asked.method)


if __name__ == "__main__":
    main()
