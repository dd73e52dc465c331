"""The demonstration: a simulated drive with tunnels, filled, and scored against what really happened.

The car has the usual faults (`FAULTS`). The drive is written as a log and read back from that file, so that what is
shown is what the command line does with anybody's log; only the score knows the truth. Each tunnel is compared with
the straight line between the fixes at its ends, which is what a map draws without an estimator.
"""

import os
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from halfwidth.vehicle.drive import Truth, length_m, simulate_drive
from halfwidth.vehicle.track import Track
from halfwidth.vehicle.write import write_log

#: What is wrong with the car besides noise: its bus is late and its odometer counts too much. `fill` has to find out.
FAULTS: Mapping[str, float] = MappingProxyType({"speed_delay": 0.15, "yaw_delay": 0.1, "speed_scale": 1.01})


@dataclass(frozen=True)
class Tunnel:
    """One outage, filled and compared with the truth.

    Parameters
    ----------
    start, stop : float
        First and last time without a fix, in seconds.
    distance_m : float
        Distance driven in it, in metres.
    mean_error_m, max_error_m : float
        Mean and largest distance between track and truth, in metres.
    half_m : float
        Largest stated half-width, in metres.
    inside : float
        Share of the rows whose true position lies within the half-widths about the truth (`Track.truth_half_m`, where
        the fixes' slow error is known), east and north both.
    line_error_m : float
        Largest distance between the straight line across the tunnel and the truth, in metres.
    """

    start: float
    stop: float
    distance_m: float
    mean_error_m: float
    max_error_m: float
    half_m: float
    inside: float
    line_error_m: float

    @property
    def length_s(self) -> float:
        """How long the tunnel lasts, in seconds."""
        return self.stop - self.start


@dataclass(frozen=True)
class Demo:
    """What the demonstration found, and where it put its files.

    Parameters
    ----------
    tunnels : tuple of Tunnel
        In the order of the drive.
    track : Track
        The filled track.
    log, output, report : Path
        The simulated log, the track and the report.
    fix_error_m : float
        Median distance between the fixes and the truth, in metres.
    seed : int
        Seed of the drive.
    seconds : float
        Wall time of everything, in seconds.
    """

    tunnels: tuple[Tunnel, ...]
    track: Track
    log: Path
    output: Path
    report: Path
    fix_error_m: float
    seed: int
    seconds: float

    def summary(self) -> str:
        """Give the score as text, and say where the files are."""
        track = self.track
        head = ("tunnel", "length", "distance", "mean error", "max error", "stated", "inside", "straight line")
        body = [
            (
                f"{number}",
                f"{tunnel.length_s:.0f} s",
                f"{tunnel.distance_m:.0f} m",
                f"{tunnel.mean_error_m:.2f} m",
                f"{tunnel.max_error_m:.2f} m",
                f"±{tunnel.half_m:.2f} m",
                f"{100 * tunnel.inside:.0f} %",
                f"{tunnel.line_error_m:.1f} m",
            )
            for number, tunnel in enumerate(self.tunnels, start=1)
        ]
        widths = [max(len(row[k]) for row in (head, *body)) for k in range(len(head))]
        lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *body)]
        again = ["halfwidth", "fill", str(self.log), "-o", str(self.output), "--report", str(self.report), "--force"]
        return "\n".join(
            [
                f"A simulated drive of {track.t_s[-1] - track.t_s[0]:.0f} s with {len(self.tunnels)} tunnels; its fixes"
                f" are {self.fix_error_m:.2f} m off in the median.",
                f"Filled by {track.method}, compared with the truth, which only this score knows:",
                "",
                *lines,
                "",
                f"stated: the largest half-width at level {track.level:g}, east or north, of where the receiver would",
                "have seen the vehicle. inside: true positions within `truth_half_m`, which adds its slow error.",
                "",
                f"log     {self.log}",
                f"track   {self.output}",
                f"report  {self.report}   (open it in a browser)",
                f"again   {shlex.join(again)}",
                f"took    {self.seconds:.1f} s",
                "",
            ]
        )

    def to_dict(self) -> dict[str, Any]:
        """Give the score as plain data."""
        return {
            "seed": self.seed,
            "method": self.track.method,
            "level": self.track.level,
            "fix_error_m": self.fix_error_m,
            "tunnels": [
                {
                    "start_s": tunnel.start,
                    "stop_s": tunnel.stop,
                    "length_s": tunnel.length_s,
                    "distance_m": tunnel.distance_m,
                    "mean_error_m": tunnel.mean_error_m,
                    "max_error_m": tunnel.max_error_m,
                    "half_m": tunnel.half_m,
                    "inside": tunnel.inside,
                    "line_error_m": tunnel.line_error_m,
                }
                for tunnel in self.tunnels
            ],
            "log": str(self.log),
            "track": str(self.output),
            "report": str(self.report),
            "seconds": self.seconds,
        }


def run(
    out: "str | os.PathLike[str]",
    *,
    seed: int = 1,
    duration: float = 600.0,
    tunnels: Sequence[float] = (10.0, 25.0, 45.0),
    fix_offset: float = 0.4,
    level: float = 0.9,
) -> Demo:
    """Simulate a drive with tunnels, fill it, score it and write log, track and report.

    Parameters
    ----------
    out : str or path
        Folder for ``drive.csv``, ``track.gpx`` and ``report.html``; made if it is not there. Files of these names are
        replaced.
    seed : int
        Seed of the drive.
    duration : float
        Length of the drive in seconds.
    tunnels : sequence of float
        Length of each tunnel in seconds.
    fix_offset : float
        Standard deviation of the slowly varying part of the receiver's error in metres, each axis. No method sees it in
        the log alone, as all fixes share it, so half-widths are about where the receiver would put the vehicle.
    level : float
        Probability of the stated half-widths.

    Returns
    -------
    Demo
        The score; `Demo.summary` is its text.

    Raises
    ------
    BadValue
        If the tunnels do not fit into the drive.
    OSError
        If the files cannot be written.
    """
    from halfwidth.vehicle.fill import fill

    began = time.perf_counter()
    folder = Path(out)
    truth, simulated = simulate_drive(
        duration=duration,
        seed=seed,
        tunnels=tunnels,
        fix_offset=fix_offset,
        speed_delay=FAULTS["speed_delay"],
        yaw_delay=FAULTS["yaw_delay"],
        speed_scale=FAULTS["speed_scale"],
    )
    folder.mkdir(parents=True, exist_ok=True)
    log, output, report = folder / "drive.csv", folder / "track.gpx", folder / "report.html"
    write_log(simulated, log)
    track = fill(log, level=level)
    again = ["halfwidth", "fill", str(log), "-o", str(output), "--report", str(report), "--level", f"{level:g}"]
    track.report(report, command=shlex.join(again))
    track.write(output)
    seen = simulated.fixed
    off = truth.error_m(simulated.t[seen], simulated.lat_deg[seen], simulated.lon_deg[seen])
    return Demo(
        tunnels=tuple(_tunnel(truth, track, first, last) for first, last in truth.outages),
        track=track,
        log=log,
        output=output,
        report=report,
        fix_error_m=float(np.median(np.hypot(*off))),
        seed=seed,
        seconds=time.perf_counter() - began,
    )


def _tunnel(truth: Truth, track: Track, first: float, last: float) -> Tunnel:
    """Compare a track with the truth in one tunnel."""
    inside = (track.t_s >= first) & (track.t_s <= last)
    t = track.t_s[inside]
    east, north = truth.error_m(t, track.lat_deg[inside], track.lon_deg[inside])
    half = track.truth_half_m
    if half is None:
        half = np.column_stack((track.east_half_m, track.north_half_m))
    held = (np.abs(np.column_stack((east, north))) <= half[inside]).all(axis=1)
    # the straight line between the rows at both ends
    ends = np.flatnonzero(inside)[[0, -1]] + np.array([-1, 1])
    ends = np.clip(ends, 0, len(track) - 1)
    straight = (np.interp(t, track.t_s[ends], values[ends]) for values in (track.lat_deg, track.lon_deg))
    error = np.hypot(east, north)
    return Tunnel(
        start=first,
        stop=last,
        distance_m=length_m(truth, first, last),
        mean_error_m=float(error.mean()),
        max_error_m=float(error.max()),
        half_m=float(track.half_m[inside].max()),
        inside=float(held.mean()),
        line_error_m=float(np.hypot(*truth.error_m(t, *straight)).max()),
    )
