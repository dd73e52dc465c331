import dataclasses

import numpy as np
import pytest
from tests.naive_vehicle import chain_round
from tests.vehicle.known import known

from halfwidth.result import Status
from halfwidth.vehicle import chain
from halfwidth.vehicle.grid import sampled
from halfwidth.vehicle.pointing import _smooth, azimuth_of

GAUSSIAN = {"tail": np.inf}
SIGMA = np.array([0.1, 0.05, 0.1, 0.01, 0.3, 0.1, 0.3])


def noisy(**change):
    return known(**({"noise": 0.2, "speed_noise": 0.1, "yaw_noise": 0.01, "offset": 0.5} | change))


def test_one_round_is_dense_least_squares_over_the_rows_of_the_table():
    drive = sampled(noisy(duration=5.0, scale=1.02, bias=0.01).log).without(2.0, 3.0)
    psi = azimuth_of(drive)
    for sigma in (SIGMA, np.array([0.02, 0.2, 0.3, 0.05, 0.1, 0.3, 1.0])):
        z, P, _ = chain_round(
            drive.t, drive.east, drive.north, drive.seen, drive.speed, drive.yaw_rate, psi, sigma, far=100.0
        )
        fit = chain.solve([drive], chain.Chain(rounds=1, **GAUSSIAN), sigma=sigma)[0]
        np.testing.assert_allclose(fit.z, z, atol=2e-6)
        T = len(drive)
        blocks = P.reshape(T, 9, T, 9)[range(T), :, range(T)]
        np.testing.assert_allclose(fit.P, blocks, atol=1e-6 * np.abs(blocks).max(axis=0).max(), rtol=1e-4)


def test_the_step_of_the_scales_is_that_of_dense_squares():
    drive = sampled(noisy(duration=5.0).log).without(2.0, 3.0)
    *_, new = chain_round(
        drive.t, drive.east, drive.north, drive.seen, drive.speed, drive.yaw_rate, azimuth_of(drive), SIGMA
    )
    fit = chain.solve([drive], chain.Chain(rounds=2, **GAUSSIAN), sigma=SIGMA)[0]
    np.testing.assert_allclose(fit.sigma, new, rtol=2e-3)


def likelihood(drive, sigma, azimuth):
    fits = chain.solve([drive], chain.Chain(rounds=1, **GAUSSIAN), sigma=sigma, azimuth=[azimuth], learn=False)
    return fits[0].loglik


@pytest.mark.parametrize("start", [0.1, 1.0, 5.0])
def test_the_likelihood_is_at_its_maximum_wherever_learning_starts(start):
    drive = sampled(noisy(duration=100.0).log).without(40.0, 60.0)
    fit = chain.solve([drive], chain.Chain(**GAUSSIAN), sigma=start * SIGMA)[0]
    assert abs(fit.gained) < 0.1
    found = fit.z[:, chain.AZIMUTH]
    best = likelihood(drive, fit.sigma, found)
    for g in range(len(chain.GROUPS)):
        for factor in (0.7, 1.4):
            other = fit.sigma.copy()
            other[g] *= factor
            assert likelihood(drive, other, found) < best + 0.5


def test_a_step_that_lowers_the_likelihood_is_cut_in_half(monkeypatch):
    drive = sampled(noisy(duration=100.0).log).without(40.0, 60.0)
    best = chain.solve([drive], chain.Chain(**GAUSSIAN))[0].loglik
    right = chain._learnt
    monkeypatch.setattr(chain, "_learnt", lambda *given: right(*given) ** 2.5)
    fit = chain.solve([drive], chain.Chain(rounds=60, **GAUSSIAN))[0]
    assert fit.loglik > best - 1.0


def test_learning_that_loses_its_way_leaves_the_best_it_had(monkeypatch):
    drive = sampled(noisy(duration=100.0).log).without(40.0, 60.0)
    best = chain.solve([drive], chain.Chain(**GAUSSIAN))[0].loglik
    right, calls = chain._learnt, []

    def lost(*given):
        calls.append(given)
        return right(*given) * (1.0 if len(calls) < 18 else 1e4)

    monkeypatch.setattr(chain, "_learnt", lost)
    assert chain.solve([drive], chain.Chain(**GAUSSIAN))[0].loglik > best - 1.0


def test_learning_raises_the_likelihood():
    drive = sampled(noisy(duration=100.0).log).without(40.0, 60.0)
    loglik = [chain.solve([drive], chain.Chain(rounds=n, **GAUSSIAN))[0].loglik for n in (1, 3, 8, 24)]
    assert np.all(np.diff(loglik) > 0)


def test_perfect_data_give_the_path_back():
    made = known(120.0, rate=10.0)
    drive = sampled(made.log)
    hidden = drive.without(40.0, 70.0)
    path = chain.solve([hidden])[0].path
    assert path.status is Status.OK
    off = np.hypot(path.east - drive.east, path.north - drive.north)
    assert off.max() < 0.05
    at = np.searchsorted(made.t, drive.t)
    np.testing.assert_allclose(np.cos(path.azimuth - made.azimuth[at]), 1.0, atol=1e-4)
    np.testing.assert_allclose(path.speed, made.speed[at], atol=0.1)


def test_it_finds_speed_scale_and_yaw_bias():
    fit = chain.solve([sampled(known(200.0, noise=0.05, scale=1.03, bias=0.008).log)])[0]
    assert fit.path.info["speed_scale"] == pytest.approx(1.03, abs=2e-3)
    assert fit.path.info["yaw_bias"] == pytest.approx(0.008, abs=5e-4)


def test_side_by_side_is_one_by_one():
    whole = sampled(noisy(duration=150.0).log)
    drives = [whole.between(0, 60).without(20, 30), whole.between(30, 150).without(80, 110), whole.between(100, 140)]
    together = chain.solve(drives)
    for drive, fit in zip(drives, together, strict=True):
        alone = chain.solve([drive])[0]
        np.testing.assert_allclose(fit.z, alone.z, atol=1e-9)
        np.testing.assert_allclose(fit.sigma, alone.sigma, rtol=1e-9)
    assert chain.solve([]) == []


def test_turning_the_map_turns_the_path():
    drive = sampled(noisy(duration=80.0).log).without(30, 50)
    turned = dataclasses.replace(drive, east=drive.north, north=-drive.east)
    a, b = (chain.solve([d])[0].path for d in (drive, turned))
    np.testing.assert_allclose(b.east, a.north, atol=1e-5)
    np.testing.assert_allclose(b.north, -a.east, atol=1e-5)
    np.testing.assert_allclose(b.variance, a.variance[:, ::-1], rtol=1e-4, atol=1e-8)


def test_intervals_hold_where_the_model_is_right():
    inside = []
    for seed in range(4):
        made = known(160.0, noise=0.2, speed_noise=0.3, yaw_noise=0.02, rate=5.0, seed=seed)
        drive = sampled(made.log)
        path = chain.solve([drive.without(60, 90)])[0].path
        hidden = (drive.t >= 60) & (drive.t <= 90)
        error = np.column_stack((path.east - drive.east, path.north - drive.north))[hidden]
        inside.append(np.mean(np.abs(error) <= 1.645 * np.sqrt(path.variance[hidden] + path.fix_variance)))
    assert 0.75 < np.mean(inside) <= 1.0


@pytest.mark.parametrize("sensor", ["speed_mps", "yaw_rate_radps"])
def test_one_sensor_is_better_than_none(sensor):
    made = noisy(duration=120.0)
    log = dataclasses.replace(made.log, **{sensor: np.full(len(made.log), np.nan)})
    whole = sampled(made.log)
    drive = sampled(log).without(50, 60)
    path = chain.solve([drive])[0].path
    hidden = whole.seen & ~drive.seen
    straight = [np.interp(whole.t, whole.t[drive.seen], p[drive.seen]) for p in (whole.east, whole.north)]
    off = np.hypot(path.east - whole.east, path.north - whole.north)[hidden].mean()
    line = np.hypot(straight[0] - whole.east, straight[1] - whole.north)[hidden].mean()
    assert off < 0.5 * line


def test_standing_still_all_the_time():
    t = np.arange(0, 60, 0.2)
    rng = np.random.default_rng(3)
    made = known(60.0, rate=5.0)
    log = dataclasses.replace(
        made.log,
        speed_mps=np.zeros(len(made.log)),
        yaw_rate_radps=1e-3 * rng.standard_normal(len(made.log)),
        lat_deg=50.0 + 1e-6 * rng.standard_normal(len(made.log)),
        lon_deg=14.0 + 1e-6 * rng.standard_normal(len(made.log)),
    )
    path = chain.solve([sampled(log).without(20, 40)])[0].path
    assert path.status is Status.OK
    assert path.finite
    assert np.ptp(path.east) < 1.0
    assert t.size == 300


def test_a_jump_of_the_receiver_far_from_a_gap_does_not_bend_it():
    made = known(160.0, rate=5.0, noise=0.02, speed_noise=0.02, yaw_noise=0.002, seed=4)
    drive = sampled(made.log)
    hidden = (drive.t >= 60) & (drive.t <= 90)
    jumped = dataclasses.replace(drive, east=drive.east + 2.0 * (drive.t > 110))
    fit = chain.solve([jumped.without(60, 90)])[0]
    assert int(np.argmin(fit.weight)) == int(np.searchsorted(drive.t, 110, side="right"))
    assert fit.weight.min() < 0.1
    assert np.hypot(fit.path.east - drive.east, fit.path.north - drive.north)[hidden].mean() < 0.4


def test_a_fix_error_that_drifts_is_carried_into_the_gap():
    made = known(160.0, rate=5.0, noise=0.02, speed_noise=0.02, yaw_noise=0.002, seed=5)
    drive = sampled(made.log)
    # the receiver drifts off by up to 3 m and back, smoothly, again and again
    drive = dataclasses.replace(drive, north=drive.north + 3.0 * np.sin(2 * np.pi * drive.t / 25.0))
    off = {}
    for drifting in (True, False):
        errors = []
        for t0 in (40.0, 60.0, 85.0, 110.0):
            hidden = (drive.t >= t0) & (drive.t <= t0 + 4)
            path = chain.solve([drive.without(t0, t0 + 4)], chain.Chain(drifting=drifting))[0].path
            errors.append(np.hypot(path.east - drive.east, path.north - drive.north)[hidden].mean())
        off[drifting] = np.mean(errors)
    assert off[True] < 0.7 * off[False]


def test_fixes_wrong_by_white_noise_only_have_no_offset():
    drive = sampled(noisy(duration=60.0, offset=0.0).log).without(20, 30)
    fit = chain.solve([drive], chain.Chain(slow=False))[0]
    assert np.abs(fit.z[:, [chain.OFFSET_E, chain.OFFSET_N]]).max() < 1e-2
    assert fit.path.info["slow_sd"] == 0.0


def test_a_first_azimuth_points_along_the_way():
    made = noisy(duration=100.0, bias=0.01)
    drive = sampled(made.log).without(40, 70)
    true = made.azimuth[np.searchsorted(made.t, drive.t)]
    off = np.angle(np.exp(1j * (azimuth_of(drive) - true)))
    assert np.abs(off).max() < 0.6
    assert np.abs(off[drive.seen]).mean() < 0.1


def test_what_points_somewhere_counts_by_how_near_it_is():
    knots = np.linspace(0.0, 900.0, 182)
    rng = np.random.default_rng(1)
    when = np.sort(np.concatenate((rng.uniform(0, 200, 300), rng.uniform(600, 900, 300))))
    pointing = np.exp(1j * rng.normal(size=600))
    away2 = ((knots[:, None] - when) / 15.0) ** 2
    want = np.exp(-0.5 * (away2 - away2.min(axis=1, keepdims=True))) @ pointing
    order = rng.permutation(600)
    for some in (slice(None), order):
        np.testing.assert_allclose(_smooth(knots, when[some], pointing[some]), want, rtol=1e-9)
    np.testing.assert_allclose(_smooth(knots, when[:1], pointing[:1]), np.repeat(pointing[:1], knots.size))
