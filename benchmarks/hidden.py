"""Hide fixes of a log, and compare a track with them: what the benchmarks of `fill` share."""

from dataclasses import replace

import numpy as np

from halfwidth.vehicle.frames import Frame

#: Fixes left between two stretches that are hidden at once, s.
APART = 40.0


def without(log, begins, length, silent=()):
    """Return a log without the fixes of some stretches of one length, nor what the named streams say there."""
    for begin in begins:
        log = log.without(begin, begin + length)
        inside = (log.t >= begin) & (log.t <= begin + length)
        log = replace(log, **{name: np.where(inside, np.nan, getattr(log, name)) for name in silent})
    return log


def groups(begins, length):
    """Divide stretches into groups that can be hidden at once: none is nearer to another than `APART`."""
    divided = []
    for begin in begins:
        room = (group for group in divided if all(abs(begin - other) >= length + APART for other in group))
        group = next(room, None)
        if group is None:
            divided.append([begin])
        else:
            group.append(begin)
    return divided


def compared(log, track, begin, length, times=None):
    """Return errors and half-widths (n, 2), m, of a track at the fixes hidden in one stretch, and its rows there.

    `times` says which fixes count, all if absent. A hidden row that is no gap of its own has no row in the track.
    """
    times = log.t[log.fixed] if times is None else times
    rows = np.searchsorted(log.t, times[(times >= begin) & (times <= begin + length)])
    at = np.searchsorted(track.t_s, log.t[rows])
    there = (at < len(track)) & (track.t_s[np.minimum(at, len(track) - 1)] == log.t[rows])
    rows, at = rows[there], at[there]
    frame = Frame.of(log)
    off = np.column_stack(frame.to_local(track.lat_deg[at], track.lon_deg[at]))
    off -= np.column_stack(frame.to_local(log.lat_deg[rows], log.lon_deg[rows]))
    return off, np.column_stack((track.east_half_m[at], track.north_half_m[at])), at
