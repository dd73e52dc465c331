"""Print how many removed fixes lie in the half-widths that `fill` states, for a user who never saw them.

    python benchmarks/coverage.py [LOGS OR FOLDER ...] [--draws 16] [--simulated 16] [--bounded 0] [--method tube]

Fixes are removed at evenly spread places from a random first one on before `fill` sees the log, several gaps at a time
if they are far apart; the log is then filled as a user would, with its own choice of method and its own test of the
half-widths on what is left. The removed fixes, east and north counted apart, are inside or not; each gap counts the
same. The draws of one length begin at as many different places, so that together they go over the whole log.

Two standard errors stand beside a share. "draws" is of the share of this log: what more draws could still change of it.
"roads" is of the share on logs like it: gaps that lie over each other, or close by, are one stretch of one drive, and
each pair is weighted by how much of them is the same (Bartlett's kernel); "apart" says how many gaps of that length the
log has room for. In the line "all" each length counts the same. The score is that of Winkler (1972): the whole width,
and 2 / (1 - level) times what a fix lies beyond it; a lower one is better, and neither wide nor lucky intervals win.

Simulated drives, with errors of the fixes drawn anew for each from centimetres to metres, show the same, and beside it
how often the *truth* lies inside the stated interval, and inside the one that `Track.truth_half_m` states. The drives
of ``--bounded`` have speeds, yaw rates and fixes that are wrong by uniform noise and by nothing else.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import hidden
import numpy as np

import halfwidth as hw
from halfwidth.vehicle.frames import Frame
from halfwidth.vehicle.outage import MARGIN, MIN_SPEED

#: Fixes that are left between two gaps, s, at least; never less than the length of a gap.
APART = 60.0


def places(log, length, share):
    """Return the beginnings of gaps that one run removes: moving, with fixes on both sides, far from each other.

    They are evenly spread from the first one on, which lies a share of the way to the second: every place of the log is
    then as likely as any other.
    """
    t = log.t[log.fixed]
    east, north = Frame.of(log).to_local(log.lat_deg[log.fixed], log.lon_deg[log.fixed])
    usual = np.median(np.diff(t))
    period = length + max(APART, length)
    chosen = []
    for begin in np.arange(t[0] + MARGIN + share * period, t[-1] - MARGIN - length, period):
        a, b = np.searchsorted(t, [begin, begin + length])
        whole = b - a >= 0.8 * length / usual - 1
        # moved further than the fixes scatter
        inside = np.column_stack((east[a:b], north[a:b]))[:: max(1, round(1.0 / usual))]
        moves = inside.shape[0] > 1 and np.hypot(*np.diff(inside, axis=0).T).sum() > MIN_SPEED * length
        sides = np.searchsorted(t, begin - MARGIN) < a - 1 and np.searchsorted(t, begin + length + MARGIN) > b + 1
        if whole and moves and sides:
            chosen.append(float(begin))
    return chosen


def one_run(log, begins, length, truth=None, draw=0, drive=0, **how):
    """Remove gaps, fill, and return for each the errors and half-widths at the removed fixes, (n, 2) each."""
    track = hw.vehicle.fill(hidden.without(log, begins, length), **how)
    found = []
    for begin in begins:
        off, half, at = hidden.compared(log, track, begin, length)
        if not off.size:
            continue
        one = {"begin": begin, "length": length, "draw": draw, "drive": drive, "level": track.level}
        one |= {"off": off, "half": half, "inside": np.mean(np.abs(off) <= half)}
        if truth is not None:
            when = track.t_s[at] - truth.clock_offset  # the track is on the clock of the fixes
            one["true"] = np.column_stack(truth.error_m(when, track.lat_deg[at], track.lon_deg[at]))
            one["truth_half"] = half if track.truth_half_m is None else track.truth_half_m[at]
        found.append(one)
    return found


def weights(gaps):
    """Return how much each gap counts: the same as others of its length, and each length the same."""
    length = np.array([g["length"] for g in gaps])
    _, which, count = np.unique(length, return_inverse=True, return_counts=True)
    return 1.0 / (count[which] * count.size)


def share_and_errors(gaps):
    """Return the share inside, its standard error over draws, and over roads."""
    inside, begin, length, drive, draw = (
        np.array([g[key] for g in gaps]) for key in ("inside", "begin", "length", "drive", "draw")
    )
    weight = weights(gaps)
    share = weight @ inside
    rest = weight * (inside - share)
    middle, mean = begin + length / 2, (length[:, None] + length) / 2
    alike = (drive[:, None] == drive) * np.maximum(0.0, 1 - np.abs(middle[:, None] - middle) / (1.5 * mean))
    roads = np.sqrt(max(rest @ alike @ rest, 0.0))
    variance = 0.0
    for one in np.unique(length):
        mine = length == one
        rest = weight[mine] * (inside[mine] - inside[mine].mean())
        # the drives are the draws where each is a drive of its own
        sums = np.bincount(np.unique(draw[mine] + 1000 * drive[mine], return_inverse=True)[1], rest)
        variance += np.sum(sums**2) * sums.size / max(sums.size - 1, 1)
    return share, float(np.sqrt(variance)), float(roads)


def row(length, gaps, room, seconds, truths):
    """Print one line of the table; `length` is None for the gaps of all lengths."""
    level, weight = gaps[0]["level"], weights(gaps)
    share, draws, roads = share_and_errors(gaps)
    mean = weight @ [np.hypot(*g["off"].T).mean() for g in gaps]
    half = weight @ [g["half"].mean() for g in gaps]
    beyond = weight @ [np.maximum(np.abs(g["off"]) - g["half"], 0).mean() for g in gaps]
    said = f"{'all':>15}" if length is None else f"{length:>13g} s"
    text = f"{said}{len(gaps):>6}{room:>7.0f}{mean:>9.2f}{share:>8.3f}{draws:>8.3f}{roads:>7.3f}"
    text += f"{half:>9.2f}{2 * half + 2 / (1 - level) * beyond:>9.2f}{seconds:>8.2f}"
    if truths:
        for key in ("half", "truth_half"):
            text += f"{weight @ [np.mean(np.abs(g['true']) <= g[key]) for g in gaps]:>9.3f}"
        text += f"{weight @ [g['truth_half'].mean() for g in gaps]:>9.2f}"
    print(text, flush=True)


HEAD = f"{'':15}{'gaps':>6}{'apart':>7}{'mean m':>9}{'inside':>8}{'draws':>8}{'roads':>7}{'half m':>9}{'score m':>9}{'s':>8}"


def on_log(log, lengths, draws, seed, **how):
    """Print the table of one log."""
    print(HEAD)
    every = []
    for length in lengths:
        first = np.random.default_rng([seed, round(1000 * length)]).uniform()
        gaps, seconds = [], []
        for draw in range(draws):
            begins = places(log, length, (draw + first) / draws)
            if begins:
                clock = time.process_time()
                gaps += one_run(log, begins, length, draw=draw, **how)
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


def bounded_drives(count, seed):
    """Simulate drives whose every error is uniform: fixes, speeds and yaw rates within half-widths of their own."""
    for k in range(count):
        rng = np.random.default_rng([seed, k, 1])
        truth, log = hw.vehicle.simulate_drive(
            duration=float(rng.uniform(240, 480)),
            seed=int(rng.integers(1, 2**31)),
            rate=5.0,
            tunnels=(),
            fix_noise=0.0,
            fix_offset=0.0,
            speed_scale=float(rng.uniform(0.98, 1.02)),
            yaw_noise=0.0,
            yaw_bias=0.0,
            yaw_drift=0.0,
        )

        frame, half = Frame.of(log), 10 ** rng.uniform(np.log10([0.05, 0.02, 0.001]), np.log10([3.0, 0.3, 0.02]))
        east, north, speed, turning = rng.uniform(-1, 1, (4, len(log))) * half[[0, 0, 1, 2], None]
        there = frame.to_local(log.lat_deg, log.lon_deg)
        lat, lon = frame.to_geodetic(there[0] + east, there[1] + north)
        yield (
            truth,
            replace(
                log,
                lat_deg=lat,
                lon_deg=lon,
                speed_mps=log.speed_mps + speed,
                yaw_rate_radps=log.yaw_rate_radps + rng.uniform(-0.01, 0.01) + turning,
            ),
        )


def on_drives(made, lengths, seed, **how):
    """Print the table of simulated drives: one draw of each length on each of them."""
    print(HEAD + f"{'truth':>9}{'in t.h.':>9}{'t.h. m':>9}")
    every = []
    for length in lengths:
        gaps, seconds, room = [], [], 0.0
        for k, (truth, log) in enumerate(made):
            share = np.random.default_rng([seed, k, round(1000 * length)]).uniform()
            begins = places(log, length, share)
            clock = time.process_time()
            gaps += one_run(log, begins, length, truth, 0, k, **how) if begins else []
            seconds.append(time.process_time() - clock)
            room += np.ptp(log.t) / length
        if gaps:
            row(length, gaps, room, np.median(seconds), True)
            every += gaps
    if every:
        row(None, every, np.nan, np.nan, True)


def main():
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--draws", type=int, default=16, help="times that each length is drawn on each log")
    parser.add_argument("--simulated", type=int, default=16, help="how many drives are simulated")
    parser.add_argument("--bounded", type=int, default=0, help="how many drives with bounded noise are simulated")
    parser.add_argument("--lengths", default="5,10,20,30,60")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--method", help="of `fill`, instead of its own choice")
    asked = parser.parse_args()
    lengths = [float(length) for length in asked.lengths.split(",")]
    folder = root.parent / "shared" / "data"
    given = asked.logs or ([folder] if folder.exists() else [])
    logs = [path for one in given for path in (sorted(one.glob("*.csv*")) if one.is_dir() else [one])]
    for path in logs if asked.draws else ():
        print(f"\n=== {path.name}")
        on_log(hw.vehicle.read(path), lengths, asked.draws, asked.seed, method=asked.method)
    for count, kind, made in (
        (asked.simulated, "simulated drives", drives),
        (asked.bounded, "drives with bounded noise", bounded_drives),
    ):
        if count:
            print(f"\n=== {count} {kind}")
            on_drives(list(made(count, asked.seed)), lengths, asked.seed, method=asked.method)


if __name__ == "__main__":
    main()
