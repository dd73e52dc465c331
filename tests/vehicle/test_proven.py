"""The band of declared half-widths: it holds, it stands apart, and it says when it cannot be."""

import csv
import json

import numpy as np
import pytest
from scipy.optimize import linprog
from tests.vehicle.drives import drive, save

import halfwidth as hw
from halfwidth.shells import cli
from halfwidth.vehicle import fill, read, simulate_drive
from halfwidth.vehicle.proven import COLUMNS, band
from halfwidth.vehicle.track import radii_m


def made(seed, *, q=3.0, r=2.0, T=900, h=0.1, every=10):
    """A motion of piecewise constant acceleration at its bound, fixes at the corners of their box."""
    rng = np.random.default_rng(seed)
    p, v = np.zeros((T, 2)), rng.uniform(-15, 15, 2)
    for k in range(1, T):
        a = np.where(np.abs(v) > 20, -np.sign(v), rng.choice([-1.0, 1.0], 2)) * q * (1 - 1e-9)
        p[k], v = p[k - 1] + h * v + h * h / 2 * a, v + h * a
    fixes = p + rng.choice([-1.0, 1.0], p.shape) * r * (1 - 1e-9)
    fixes[np.arange(T) % every != 0] = np.nan
    fixes[:25] = fixes[300:420] = fixes[600:640] = fixes[-30:] = np.nan
    return np.arange(T) * h, p, fixes


@pytest.mark.parametrize("seed", range(3))
def test_the_truth_is_inside(seed):
    t, p, fixes = made(seed)
    lo, hi = band(t, fixes, 3.0, 2.0)
    assert np.all((lo <= p) & (p <= hi))
    assert np.isfinite(hi - lo).all()
    seen = np.isfinite(fixes)
    assert np.all((hi - lo)[seen] <= 4.0 * (1 + 1e-9))
    far = band(t + 1e5, fixes + 4e6, 3.0, 2.0)
    np.testing.assert_allclose(far[1] - far[0], hi - lo, rtol=1e-4, atol=1e-6)


def test_the_widest_point_of_a_gap_is_that_of_all_motions():
    """Against a program over motions whose acceleration is constant in fine steps, which are some of all motions."""
    q, r, h = 2.0, 1.0, 0.25
    t = np.arange(0, 30, h)
    fixes = np.full((t.size, 2), np.nan)
    known = (t <= 10) | (t >= 20)
    fixes[known & (np.arange(t.size) % 4 == 0)] = 0.0
    lo, hi = band(t, fixes, q, r)
    n, middle = t.size, int(np.argmin(np.abs(t - 15)))
    # p_k as a linear function of (p0, v0, a_1 .. a_n)
    P = np.zeros((n, 2 + n))
    V = np.zeros((n, 2 + n))
    P[0, 0] = V[0, 1] = 1.0
    for k in range(1, n):
        P[k], V[k] = P[k - 1] + h * V[k - 1], V[k - 1]
        P[k, 2 + k] += h * h / 2
        V[k, 2 + k] += h
    rows = P[np.isfinite(fixes[:, 0])]
    bounds = [(None, None)] * 2 + [(-q, q)] * n
    widest = -linprog(-P[middle], np.vstack((rows, -rows)), np.full(2 * len(rows), r), bounds=bounds).fun
    assert hi[middle, 0] >= widest - 1e-7
    assert hi[middle, 0] <= 1.15 * widest  # a and b of a step are bounded one by one
    np.testing.assert_allclose(-lo[middle], hi[middle], rtol=1e-4)


def test_numbers_that_the_fixes_contradict_are_named():
    t, _, fixes = made(0)
    words = band(t, fixes, 3.0, 0.5)
    assert isinstance(words, str)
    assert "no trajectory fits" in words


def test_fixes_that_contradict_are_named_where_there_is_no_gap_too():
    t = np.arange(0, 60, 0.5)
    fixes = np.column_stack((12.0 * t, 0.0 * t))
    assert not isinstance(band(t, fixes, 1.0, 0.5), str)
    fixes[70, 1] += 5.0
    words = band(t, fixes, 1.0, 0.5)
    assert isinstance(words, str)
    assert words.startswith("north: no trajectory fits")
    assert "t = 35 s" in words
    assert "grow" in words


def test_a_drive_is_inside_and_its_half_widths_are_not_touched(tmp_path):
    truth, log = simulate_drive(seed=3, duration=200.0)
    plain, track = fill(log), fill(log, guaranteed=(4.0, 4.0))
    for name in ("lat_deg", "lon_deg", "east_half_m", "north_half_m"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(track, name))
    assert plain.proven is None
    assert plain.guarantee == track.guarantee
    assert not set(COLUMNS) & set(plain.frame().columns)
    rows = np.searchsorted(truth.t, track.t_s)
    m, n = radii_m(np.radians(track.lat_deg))
    north = np.radians(truth.lat_deg[rows] - track.lat_deg) * m
    east = np.radians(truth.lon_deg[rows] - track.lon_deg) * n * np.cos(np.radians(track.lat_deg))
    p = track.proven
    assert np.all((-p.proven_west_m <= east) & (east <= p.proven_east_m))
    assert np.all((-p.proven_south_m <= north) & (north <= p.proven_north_m))
    frame = track.frame()
    assert list(frame.columns[-4:]) == list(COLUMNS)
    track.write(tmp_path / "track.csv")
    with open(tmp_path / "track.csv") as file:
        written = [[float(row[name]) for name in COLUMNS] for row in csv.DictReader(file)]
    exact = np.column_stack([getattr(p, name) for name in COLUMNS])
    assert np.all(np.array(written) >= exact)
    assert np.all(np.array(written) <= exact + 2e-3)
    track.report(tmp_path / "report.html")
    assert f"guaranteed band, half-width at most {p.half_m.max():.1f} m: holds while" in track.summary()
    assert len(track.summary().splitlines()) <= 12
    assert "guaranteed band" not in plain.summary()
    page = (tmp_path / "report.html").read_text()
    assert "Guaranteed band" in page
    assert "within 4 m/s² and every fix within 4 m" in page
    plain.report(tmp_path / "plain.html")
    assert "Guaranteed band" not in (tmp_path / "plain.html").read_text()


@pytest.mark.parametrize("wrong", [(4.0,), (0.0, 1.0), (1.0, float("nan")), "fast", 4.0])
def test_other_than_two_positive_numbers_is_refused(wrong, tmp_path):
    log = read(save(tmp_path / "log.csv", drive(60, dt=0.2)))
    with pytest.raises(hw.BadValue, match="guaranteed"):
        fill(log, guaranteed=wrong)


def test_the_command_takes_both_half_widths(tmp_path, capsys):
    columns = drive(200, dt=0.2)
    dark = (columns["t_s"] > 20) & (columns["t_s"] < 28)
    for name in ("lat_deg", "lon_deg"):
        columns[name] = np.where(dark, np.nan, columns[name])
    log = save(tmp_path / "log.csv", columns)
    out = tmp_path / "track.csv"
    assert cli.run(["fill", str(log), "-o", str(out), "--guaranteed", "6", "5", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["guaranteed"]["acceleration"] == 6.0
    assert told["guaranteed"]["fix"] == 5.0
    assert "proven_west_m" in out.read_text().splitlines()[0]
    assert cli.run(["fill", str(log), "-o", str(out), "--force", "--guaranteed", "-1", "5"]) == 2
    assert cli.run(["fill", str(log), "-o", str(out), "--force", "--guaranteed", "0.001", "0.001"]) == 0
    assert "no guaranteed band" in capsys.readouterr().err
    assert "proven_west_m" not in out.read_text().splitlines()[0]
