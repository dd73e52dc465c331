import numpy as np
import pytest

import halfwidth as hw
from halfwidth.vehicle import models


def test_constant_velocity_is_equation_22():
    car = models.constant_velocity(0.1, [0.02, 0.02, 0.05, 0.05], [0.5, 0.5])
    A, B, C = car.A.single, car.B.single, car.C.single
    x, u = np.array([1.0, 2.0, 3.0, -4.0]), np.array([0.5, -0.25])
    np.testing.assert_allclose(A @ x + B @ u, [1.3025, 1.59875, 3.05, -4.025])
    np.testing.assert_allclose(C @ x, [1.0, 2.0])
    np.testing.assert_allclose(car.w.q, [0.02, 0.02, 0.05, 0.05])
    assert car.names.u == ("east_acceleration", "north_acceleration")


def test_steps_one_a_row_or_from_the_record_are_the_same_model():
    t = np.cumsum([0.1, 0.1, 0.3, 0.2, 0.1])
    y = np.column_stack((np.sin(t), np.cos(t)))
    noise = {"q": hw.Gaussian(1e-3), "r": hw.Gaussian(0.01), "x0": hw.Normal(np.zeros(4), 10.0), "acceleration": False}
    record = hw.Record(t, y)
    by_row = hw.estimate(
        models.constant_velocity(np.array([0.1, 0.1, 0.3, 0.2, 0.1]), **noise), record, hw.KalmanSmoother()
    )
    free = models.constant_velocity(None, **noise)
    by_step = hw.estimate(hw.Linear(free.A, None, free.C, free.w, free.e, free.x0, dt=0.1), record, hw.KalmanSmoother())
    np.testing.assert_allclose(by_row.x, by_step.x, atol=1e-12)


def test_gps_ins_knows_no_half_width():
    car = models.gps_ins(0.1)
    assert not car.w.known
    assert not car.e.known
    assert car.nu == 2


def test_the_first_example_of_the_readme():
    car = models.constant_velocity(dt=0.1, q=[0.02, 0.02, 0.05, 0.05], r=[0.5, 0.5], x0=hw.Box(-np.ones(4), np.ones(4)))
    accel = np.c_[np.sin(np.arange(300) / 30), np.cos(np.arange(300) / 40)]
    truth, drive = hw.simulate(car, accel, seed=1)
    drive = drive.without(12.0, 17.0)
    sharp = hw.estimate(car.as_gaussian(), drive)
    assert sharp.status is hw.Status.OK
    assert np.abs(sharp.x[:, :2] - truth.x[:, :2]).max() < 1.0


def test_a_left_turn_makes_the_azimuth_smaller():
    car = models.ctrv(np.full(5, 0.1), np.full(4, 0.1))
    x = car.move(np.array([0.0, 0.0, 0.0, 10.0, 0.2]), np.zeros(0), 0.5)
    assert x[2] == pytest.approx(-0.1)
    assert x[0] < 0  # heading north, turning left: to the west
    assert x[0] == pytest.approx(5 * np.sin(-0.05))
    assert x[1] == pytest.approx(5 * np.cos(-0.05))
    euler = models.ctrv(np.full(5, 0.1), np.full(4, 0.1), euler=True).move(np.array([0, 0, 0, 10, 0.2]), None, 0.5)
    assert euler[0] == 0


def test_scale_and_bias_are_what_the_sensors_add():
    car = models.ctrv(np.full(7, 0.1), np.full(4, 0.1), theta=True)
    y = car.output(np.array([1.0, 2.0, 0.3, 10.0, 0.1, 1.02, 0.005]))
    np.testing.assert_allclose(y, [1.0, 2.0, 10.2, 0.105])


def test_two_antennas_see_the_azimuth():
    x0 = hw.Normal(np.zeros(7), 1.0)
    car = models.two_antenna(np.full(7, 0.1), np.full(7, 0.1), x0=x0, baseline=(0.0, 1.0))  # the second to the left
    azimuth = 0.4
    left = np.array([-np.cos(azimuth), np.sin(azimuth)])
    y = car.output(np.array([5.0, 6.0, *(np.array([5.0, 6.0]) + left), azimuth, 3.0, 0.1]))
    assert y[4] == pytest.approx(azimuth)
    moved = car.move(np.array([0.0, 0.0, 1.0, 0.0, np.pi / 2, 10.0, 0.0]), np.zeros(0), 0.1)
    np.testing.assert_allclose(moved[:4], [1.0, 0.0, 2.0, 0.0], atol=1e-12)


def test_the_middle_azimuth_follows_a_circle_better_than_the_first():
    h, v, w = 0.5, 10.0, 0.4
    t = np.arange(0, 10 + h, h)
    azimuth = -w * t
    true = np.c_[(np.cos(w * t) - 1) * v / w, np.sin(w * t) * v / w]
    middle = np.cumsum(models.displacement(azimuth, np.full(t.size, v), np.full(t.size, h)), axis=0)
    first = np.cumsum(models.displacement(azimuth, np.full(t.size, v), np.full(t.size, h), euler=True), axis=0)
    far = [np.abs(p - true).max() for p in (middle, first)]
    assert far[0] < 0.1
    assert far[0] < 0.1 * far[1]


@pytest.mark.parametrize("antennas", [1, 2])
def test_the_linearised_model_moves_all_antennas_alike(antennas):
    model = models.two_antenna_linear(antennas=antennas)
    assert (model.nx, model.ny, model.nu) == (2 * antennas, 2 * antennas, 2)
    np.testing.assert_allclose(model.B.single @ [1.0, 2.0], np.tile([1.0, 2.0], antennas))
