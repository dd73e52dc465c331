"""A box that must contain the state: bounded noise, a tunnel, a fix that cannot be, a model known to an interval."""

import dataclasses

import numpy as np

import halfwidth as hw


def main():
    # A car whose acceleration is measured; every number is a bound, not a deviation. Five seconds of tunnel.
    car = hw.vehicle.constant_velocity(
        dt=0.1, q=[0.02, 0.02, 0.05, 0.05], r=[0.5, 0.5], x0=hw.Box([-5, -5, -8, -8], [5, 5, 8, 8])
    )
    accel = np.c_[np.sin(np.arange(300) / 30), np.cos(np.arange(300) / 40)]
    truth, drive = hw.simulate(car, accel, seed=1)
    drive = drive.without(12.0, 17.0)

    safe = hw.estimate(car, drive)  # known half-widths: the hull of all rows
    live = hw.estimate(car, drive, hw.Hull(memory=10))  # the past alone, at a fixed cost a row
    late = hw.estimate(car, drive, hw.Hull(memory=10, lag=20))  # two seconds later
    sharp = hw.estimate(car.as_gaussian(), drive)
    print(hw.score([safe, late, live, sharp], truth, during=drive.gaps()[0], states=[0, 1]))

    # Where must the next fix lie? A functional of the state, before the row is pushed.
    stream = hw.stream(car, hw.Hull(memory=10))
    for y, u in zip(drive.y[:100], drive.u[:100], strict=True):
        stream.push(y, u)
    east = stream.bound(car.C.single[0], u=drive.u[100])
    jumped = drive.y[100, 0] + 4.0
    print(f"next east within [{east.lo:.2f}, {east.hi:.2f}] m")
    print(f"a fix at {jumped:.2f} m cannot be: 0.5 m would have to be {0.5 + east.excess(jumped, 0.5):.2f} m")
    stream.push(None, drive.u[100])  # so it is left out

    # Pushed all the same, it contradicts the others, and the answer says which, and what would reconcile them.
    y = drive.y.copy()
    y[100, 0] = jumped
    bad = hw.estimate(car, hw.Record(drive.t, y, drive.u))
    print(bad.status.name + ":", bad.message)

    # The acceleration is known within 10 % only: entries of B are intervals.
    rough = dataclasses.replace(
        car,
        B=np.where(car.B.single != 0, np.nan, 0.0),
        theta_bounds=(0.9 * car.B.single[car.B.single != 0], 1.1 * car.B.single[car.B.single != 0]),
    )
    wider = hw.estimate(rough, drive)
    print(hw.score([safe, wider], truth, states=[0, 1]))


if __name__ == "__main__":
    main()
