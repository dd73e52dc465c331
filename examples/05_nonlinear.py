"""Nonlinear motion: a turning car from speed and yaw rate, with a gap in its fixes."""

import numpy as np

import halfwidth as hw


def move(x, u, dt):
    """Advance east, north and azimuth by speed u[0] and yaw rate u[1], about the middle of the step."""
    azimuth = x[2] - 0.5 * dt * u[1]
    return np.array([x[0] + dt * u[0] * np.sin(azimuth), x[1] + dt * u[0] * np.cos(azimuth), x[2] - dt * u[1]])


def main():
    car = hw.Nonlinear(
        g=move,
        h=lambda x: x[:2],
        w=hw.Gaussian([0.01, 0.01, 1e-4]),
        e=hw.Gaussian(0.5**2),
        x0=hw.Normal([0.0, 0.0, 0.2], [1.0, 1.0, 0.05]),
        nu=2,
        dt=0.2,
        x_angles=(2,),
        names={"x": ["east", "north", "azimuth"], "y": ["east", "north"], "u": ["speed", "yaw_rate"]},
    )
    u = np.c_[8 + 2 * np.sin(np.arange(300) / 40), 0.2 * np.cos(np.arange(300) / 25)]
    truth, drive = hw.simulate(car, u, seed=7)
    drive = drive.without(25.0, 40.0)
    methods = [hw.ExtendedKalman(smooth=True), hw.UnscentedKalman(smooth=True)]
    found = [hw.estimate(car, drive, method) for method in methods]
    print(hw.score(found, truth, during=drive.gaps()[0], states=[0, 1]))


if __name__ == "__main__":
    main()
