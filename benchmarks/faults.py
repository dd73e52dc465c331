"""Spoil simulated drives in random ways, several at once, and print what `fill` makes of them.

    python benchmarks/faults.py [--drives 40] [--seed 1] [--faults 2] [--only NAME,NAME]
    python benchmarks/faults.py --healthy [--drives 40] [--seed 1]

Each drive differs in its receiver, its sensors and its rates, has two gaps, and gets up to `--faults` faults whose size,
time and direction are drawn anew. Printed are the largest error against the truth in the gaps without and with the
faults, that of straight lines on the spoiled log, the share of the truth in the half-widths about it, and which
faults no message names. A drive is marked `*` where the faults make the error more than twice as large and a metre;
where they take a sensor away, where it is worse than straight lines, too. A drive that breaks `fill` is marked `!`, and
one that takes more than ten seconds of CPU `t`. With `--healthy` the drives are left as they are, and what `check` and
`fill` hold against them is printed.
"""

import argparse
import time
from dataclasses import replace

import numpy as np

import halfwidth as hw
from halfwidth.vehicle.log import STREAMS, Log

#: Where each gap begins and how long it lasts at least and at most, s.
GAPS = ((70.0, 12.0, 35.0), (170.0, 8.0, 25.0))


#: A drive of some minutes takes no longer, s.
SLOW = 10.0


def fixes(log, first, last):
    """Return the rows with a fix in (first, last]."""
    return np.flatnonzero(log.fixed & (log.t > first) & (log.t <= last))


def moved(log, rows, metres, toward):
    """Move fixes by so many metres (one number, or one each) in a direction."""
    lat, lon = log.lat_deg.copy(), log.lon_deg.copy()
    lat[rows] += metres * np.cos(toward) / 111_229
    lon[rows] += metres * np.sin(toward) / (111_320 * np.cos(np.radians(50.09)))
    return replace(log, lat_deg=lat, lon_deg=lon)


def scaled(name, factor):
    def fault(_rng, log, _gaps):
        return replace(log, **{name: factor * getattr(log, name)}), f"{factor:.3g}"

    return fault


def absent(name):
    def fault(_rng, log, _gaps):
        return replace(log, **{name: np.full(len(log), np.nan)}), ""

    return fault


def freeze(rng, log, _gaps):
    begin, length = rng.uniform(110, 140), rng.uniform(1.5, 20)
    rows = fixes(log, begin, begin + length)
    lat, lon = log.lat_deg.copy(), log.lon_deg.copy()
    lat[rows], lon[rows] = lat[rows[0]], lon[rows[0]]
    return replace(log, lat_deg=lat, lon_deg=lon), f"{length:.1f} s"


def jump(rng, log, _gaps):
    begin, length, metres = rng.uniform(110, 150), rng.uniform(0.1, 5), 10 ** rng.uniform(1, 2.5)
    rows = fixes(log, begin, begin + max(length, 1.1))
    return moved(log, rows, metres, rng.uniform(0, 6.3)), f"{metres:.0f} m {length:.1f} s"


def first_fixes(rng, log, gaps):
    length, metres = rng.uniform(0.1, 8), 10 ** rng.uniform(0.7, 2)
    for _, last in gaps:
        log = moved(log, fixes(log, last, last + max(length, 1.1)), metres, rng.uniform(0, 6.3))
    return log, f"{metres:.0f} m {length:.1f} s"


def multipath(rng, log, gaps):
    fades, metres = rng.uniform(1, 6), 10 ** rng.uniform(0.7, 1.6)
    for _, last in gaps:
        rows = fixes(log, last, last + 8 * fades)
        log = moved(log, rows, metres * np.exp(-(log.t[rows] - last) / fades), rng.uniform(0, 6.3))
    return log, f"{metres:.0f} m, {fades:.1f} s"


def sensor_clock(rng, log, _gaps):
    """Let speed and yaw rate come late from some time on."""
    when, late = rng.uniform(50, 200), rng.uniform(0.15, 0.8)
    changed = {}
    for name in ("speed_mps", "yaw_rate_radps"):
        values = getattr(log, name)
        changed[name] = np.where(log.t > when, np.interp(log.t - late, log.t, values), values)
    return replace(log, **changed), f"{late:.2f} s at {when:.0f} s"


def clock_step(rng, log, gaps):
    """Let the clock of everything leap in the second gap."""
    step, when = rng.uniform(0.5, 5), gaps[1][1] + rng.uniform(5, 20)
    return replace(log, t=np.where(log.t > when, log.t + step, log.t)), f"{step:.1f} s"


def hang(rng, log, _gaps):
    """Let the logger hang and work off what waits."""
    begin, most, recovery = rng.uniform(40, 150), rng.uniform(0.5, 2), rng.uniform(5, 15)
    late = np.where(log.t < begin, 0, np.clip(most * (1 - (log.t - begin) / recovery), 0, most))
    return replace(log, t=log.t + late), f"{most:.1f} s at {begin:.0f} s"


def spikes(rng, log, _gaps):
    speed, yaw = log.speed_mps.copy(), log.yaw_rate_radps.copy()
    speed[rng.integers(10, len(log) - 10, 4)] = rng.uniform(60, 400, 4)
    yaw[rng.integers(10, len(log) - 10, 3)] = rng.uniform(3, 20, 3)
    return replace(log, speed_mps=speed, yaw_rate_radps=yaw), ""


def stuck(rng, log, gaps):
    """Let the speed repeat itself in the first gap."""
    begin, length = gaps[0][0] + rng.uniform(1, 5), rng.uniform(3, 12)
    rows = np.flatnonzero((log.t > begin) & (log.t <= begin + length))
    speed = log.speed_mps.copy()
    speed[rows] = speed[rows[0]]
    off = abs(speed[rows[0]] - log.speed_mps[min(rows[-1] + 1, len(log) - 1)])
    return replace(log, speed_mps=speed), f"{length:.0f} s, then {off:.1f} m/s"


def silent(_rng, log, gaps):
    """Let the yaw rate be silent in the first gap."""
    rows = (log.t > gaps[0][0] + 3) & (log.t < gaps[0][1] - 3)
    return replace(log, yaw_rate_radps=np.where(rows, np.nan, log.yaw_rate_radps)), ""


def drop(rng, log, gaps):
    """Let the speed drop to 0 while the car drives, for a while, in the first gap or among fixes."""
    begin, length = (gaps[0][0] + 2 if rng.uniform() < 0.5 else rng.uniform(110, 150)), rng.uniform(3, 20)
    rows = (log.t > begin) & (log.t < begin + length)
    moves = float(np.nanmax(np.where(rows, log.speed_mps, 0.0)))
    return replace(
        log, speed_mps=np.where(rows, 0.0, log.speed_mps)
    ), f"{length:.0f} s at {begin:.0f} s, {moves:.0f} m/s"


def from_some_time_on(name, factors):
    def fault(rng, log, _gaps):
        when, factor = rng.uniform(60, 200), float(rng.choice(factors))
        return times(log, name, factor, when), f"{factor:.3g} at {when:.0f} s"

    return fault


def times(log, name, factor, when):
    values = getattr(log, name)
    return replace(log, **{name: np.where(log.t > when, factor * values, values)})


def far_clock(rng, log, _gaps):
    """Stamp speed and yaw rate by a clock that is seconds to minutes off."""
    late = float(rng.choice([-1, 1]) * 10 ** rng.uniform(0.5, 2.2))
    changed = {}
    for name in ("speed_mps", "yaw_rate_radps"):
        t, values = log.stream(name)
        changed[name] = np.interp(log.t - late, t, values, left=np.nan, right=np.nan)
    return replace(log, **changed), f"{late:.1f} s"


def slow(_rng, log, _gaps):
    """Keep one row a second."""
    every = max(1, round(1.0 / float(np.median(np.diff(log.t)))))
    return Log(**{name: getattr(log, name)[::every] for name in ("t", "lat_deg", "lon_deg", *rest())}), ""


def rest():
    return [name for name in STREAMS if name not in ("position", "lat_deg", "lon_deg")]


#: Faults, and what a message says where they are found; None where they need no word.
FAULTS = {
    "sign": (scaled("yaw_rate_radps", -1.0), "positive to the right"),
    "degrees": (scaled("yaw_rate_radps", 180 / np.pi), "in deg/s"),
    "km/h": (scaled("speed_mps", 3.6), "km/h"),
    "mph": (scaled("speed_mps", 2.2369), "mph"),
    "scale": (scaled("speed_mps", 1.08), "speed scale"),
    "no speed": (absent("speed_mps"), "no speed"),
    "no yaw rate": (absent("yaw_rate_radps"), "no yaw rate"),
    "freeze": (freeze, "repeat the fix before"),
    "jump": (jump, ("cannot have been", "off the path", "far from where")),
    "first fixes": (first_fixes, ("cannot have been", "off the path", "far from where")),
    "multipath": (multipath, ("cannot have been", "off the path", "far from where")),
    "sensor clock": (sensor_clock, (" s, then ", " s to ")),
    "clock step": (clock_step, "clock leaps"),
    "hang": (hang, "late"),
    "spikes": (spikes, "no car can have had"),
    "stuck": (stuck, None),
    "silent": (silent, "without yaw rate"),
    "1 Hz": (slow, None),
}
#: Faults that are drawn where they are asked for by name only, so that older seeds stay what they were.
ASKED = {
    "drop": (drop, ("says 0", "stuck")),
    "unit changes": (from_some_time_on("speed_mps", (3.6, 2.2369, 1 / 3.6)), "put right"),
    "sign changes": (from_some_time_on("yaw_rate_radps", (-1.0, 180 / np.pi)), "put right"),
    "far clock": (far_clock, "of the same moment"),
}
#: Faults that exclude each other.
ALIKE = [
    {"sign", "degrees", "no yaw rate", "silent"},
    {"km/h", "mph", "scale", "no speed", "stuck"},
    {"spikes", "no speed", "no yaw rate"},
    {"sensor clock", "no speed", "no yaw rate", "hang"},
    {"first fixes", "multipath"},
    {"far clock", "no speed", "no yaw rate", "sensor clock", "clock step", "hang"},
    {"unit changes", "drop", "no speed", "km/h", "mph", "scale", "stuck"},
    {"sign changes", "sign", "degrees", "no yaw rate", "silent"},
]


def made(seed, k):
    """Draw a drive with two gaps."""
    rng = np.random.default_rng([seed, k])
    gaps = tuple((a, a + rng.uniform(low, high)) for a, low, high in GAPS)
    rate = float(rng.choice([5.0, 10.0, 20.0]))
    grade = rng.uniform()
    drive = hw.vehicle.simulate_drive(
        duration=float(rng.uniform(260, 360)),
        seed=int(rng.integers(1, 2**31)),
        rate=rate,
        fix_rate=min(rate, float(rng.choice([1.0, 5.0, 10.0]))),
        outages=gaps,
        fix_noise=10 ** (-1.5 + 1.4 * grade),
        fix_offset=10 ** (-1.3 + 1.5 * grade),
        clock_offset=float(rng.uniform(-0.1, 0.25)),
        speed_scale=float(rng.uniform(0.98, 1.02)),
        yaw_noise=float(10 ** rng.uniform(-3, -2)),
        yaw_bias=float(rng.uniform(0, 0.006)),
    )
    return rng, gaps, *drive


def spoiled(rng, log, gaps, most, only):
    """Draw faults and put them into a log."""
    names = []
    for name in rng.permutation(only or list(FAULTS)):
        if len(names) < most and not any(name in kind and set(names) & kind for kind in ALIKE):
            names.append(str(name))
    words = []
    for name in sorted(names, key=list(FAULTS | ASKED).index):
        log, size = (FAULTS | ASKED)[name][0](rng, log, gaps)
        words.append(f"{name} {size}".strip())
    return log, names, ", ".join(words)


def judged(truth, track, gaps, to_true):
    """Return the largest error in the gaps, m, and the share of the truth in the half-widths about it."""
    when = to_true(track.t_s)
    inside = np.zeros(when.size, dtype=bool)
    for first, last in gaps:
        inside |= (when > first) & (when < last)
    when = when - truth.clock_offset
    off = np.column_stack(truth.error_m(when[inside], track.lat_deg[inside], track.lon_deg[inside]))
    half = (
        np.column_stack((track.east_half_m, track.north_half_m)) if track.truth_half_m is None else track.truth_half_m
    )
    return float(np.hypot(*off.T).max()), float(np.mean(np.abs(off) <= half[inside]))


def unnamed(names, messages):
    """Return the faults that no message names."""
    said = " ".join(messages)
    found = []
    for name in names:
        words = (FAULTS | ASKED)[name][1]
        words = (words,) if isinstance(words, str) else words
        if words is not None and not any(word in said for word in words):
            found.append(name)
    return found


def accused(log, messages):
    """Return what is held against a log: points of `check` that are not ok, and messages that leave samples out."""
    wrong = [item for item in hw.vehicle.check(log).items if item.verdict in ("bad", "warn")]
    # each drive has its own clock offset: only a clock that changes is none of its own
    wrong = [item for item in wrong if not item.name.startswith("clock") or item.evidence.get("change")]
    found = [f"{item.name}: {item.sentence}" for item in wrong]
    words = [word for _, named in FAULTS.values() if named for word in ((named,) if isinstance(named, str) else named)]
    return found + [message for message in messages if any(word in message for word in words if word != "speed scale")]


def healthy(seed, first, drives):
    """Print what is held against drives in which nothing is wrong."""
    bad = 0
    for k in range(first, first + drives):
        log = made(seed, k)[-1]
        found = accused(log, hw.vehicle.fill(log).messages)
        bad += bool(found)
        for words in found:
            print(f"{k:>3}  {words}", flush=True)
    print(f"{bad} of {drives} healthy drives are accused of something")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="number of the first drive")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--faults", type=int, default=2, help="faults of a drive, at most")
    parser.add_argument("--only", help=f"draw from these faults alone; drawn only so: {', '.join(ASKED)}")
    parser.add_argument("--healthy", action="store_true", help="no faults: what is held against the drives?")
    asked = parser.parse_args()
    if asked.healthy:
        healthy(asked.seed, asked.first, asked.drives)
        return
    only = asked.only.split(",") if asked.only else None
    print(f"{'':>4} {'clean':>7} {'spoiled':>8} {'linear':>7} {'inside':>7}  faults")
    bad, shares = 0, []
    for k in range(asked.first, asked.first + asked.drives):
        rng, gaps, truth, log = made(asked.seed, k)
        wrong, names, words = spoiled(rng, log, gaps, int(rng.integers(1, asked.faults + 1)), only)
        every = max(1, round(len(log) / len(wrong)))  # which rows are left

        def to_true(t, written=wrong.t, then=log.t[::every]):
            return np.interp(t, written, then)

        clean, _ = judged(truth, hw.vehicle.fill(log), gaps, lambda t: t)
        began = time.process_time()
        try:
            track = hw.vehicle.fill(wrong)
        except Exception as error:  # the table goes on
            print(f"{k:>3}! {words}: {error!r}", flush=True)
            bad += 1
            continue
        took = time.process_time() - began
        worst, share = judged(truth, track, gaps, to_true)
        straight, _ = judged(truth, hw.vehicle.fill(wrong, method="linear"), gaps, to_true)
        whole = not ({"no speed", "no yaw rate", "silent", "stuck", "drop", "far clock"} & set(names))
        poor = worst > 2 * clean + 1 and (whole or worst > straight + 1)
        bad += poor
        shares.append(share)
        missing = unnamed(names, track.messages)
        note = f"  | not named: {', '.join(missing)}" if missing else ""
        mark = "*" if poor else "t" if took > SLOW else ""
        print(f"{k:>3}{mark:1} {clean:>7.2f} {worst:>8.2f} {straight:>7.1f} {share:>7.2f}  {words}{note}", flush=True)
    print(f"{bad} of {asked.drives} drives are marked; {np.mean(shares):.3f} of the truth inside")


if __name__ == "__main__":
    main()
