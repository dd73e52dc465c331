"""A first gap: a vehicle on two axes, five seconds of tunnel, and what a smoother makes of it."""

import numpy as np

import halfwidth as hw


def main():
    dt = 0.1
    step = np.array([[1.0, dt], [0.0, 1.0]])  # position and velocity on one axis
    car = hw.Linear(
        A=np.kron(np.eye(2), step),
        B=np.kron(np.eye(2), [[dt**2 / 2], [dt]]),  # the input is the measured acceleration
        C=np.kron(np.eye(2), [[1.0, 0.0]]),  # the receiver gives positions
        w=hw.Uniform([0.02, 0.05, 0.02, 0.05]),  # bounds, not covariances
        e=hw.Uniform(0.5),
        x0=hw.Box(-1.0, 1.0),
        names={"x": ["east", "v_east", "north", "v_north"]},
        dt=dt,
    )
    acceleration = np.c_[np.sin(np.arange(300) / 30), np.cos(np.arange(300) / 40)]
    truth, drive = hw.simulate(car, acceleration, seed=1)  # 30 s of fixes and accelerometer
    drive = drive.without(12.0, 17.0)  # five seconds of tunnel

    filtered = hw.estimate(car.as_gaussian(), drive, hw.KalmanFilter())
    smoothed = hw.estimate(car.as_gaussian(), drive)  # the default for Gaussian noise
    print(hw.score([filtered, smoothed], truth, during=drive.gaps()[0], states=[0, 2]))
    print(smoothed.check().summary())


if __name__ == "__main__":
    main()
