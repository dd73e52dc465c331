"""Bounds that hold, in microseconds: sets that contain the state of a cart and of a turning vehicle."""

import numpy as np

import halfwidth as hw


def main():
    # A cart whose noise is known to stay within half-widths; its position is lost for 5 s at 10 Hz.
    h = 0.1
    cart = hw.Linear(
        [[1, h], [0, 1]], [[h * h / 2], [h]], [[1, 0]],
        hw.Uniform([0.002, 0.02]), hw.Uniform(0.3), hw.Box([-1, -1], [1, 1]), dt=h, names=["p", "v"],
    )  # fmt: skip
    truth, record = hw.simulate(cart, np.sin(np.arange(300) / 30), seed=1)
    record = record.without(12.0, 17.0)
    for method in (hw.IntervalFilter(), hw.EllipsoidFilter(), hw.ZonotopeFilter(), hw.ConstrainedZonotopeFilter()):
        est = hw.estimate(cart, record, method).check()
        lo, hi = est.interval()
        inside = np.all((lo <= truth.x) & (truth.x <= hi))
        print(f"{type(method).__name__:26} mean width {np.mean(hi - lo, axis=0).round(3)}  truth inside: {inside}")

    # A fix that cannot be: the row is named, and there is no interval.
    y = record.y.copy()
    y[200] += 3.0
    print(hw.estimate(cart, hw.Record(record.t, y, record.u), hw.ZonotopeFilter()).message)

    # Row by row.
    live = hw.stream(cart, hw.ZonotopeFilter())
    for y, u in zip(record.y, record.u, strict=True):
        newest = live.push(y, u)
    print("newest:", [end.round(2).tolist() for end in newest.interval()])

    # An entry known to an interval only: from step to step 5 to 15 % of the speed is lost.
    drag = hw.Linear(
        [[1, h], [0, np.nan]], cart.B, cart.C, cart.w, cart.e, cart.x0, dt=h, theta_bounds=([0.85], [0.95])
    )
    lo, hi = hw.estimate(drag, record.without(0.0, 30.0), hw.ZonotopeFilter()).interval()
    print("after 30 s blind with unknown drag, the speed is within", [float(v[-1, 1].round(2)) for v in (lo, hi)])

    # A turning vehicle: g and h are replaced by affine functions with a proved distance.
    vehicle = hw.Nonlinear(
        lambda x, u, dt: np.array(
            [x[0] + dt * x[2] * np.cos(x[3]), x[1] + dt * x[2] * np.sin(x[3]), x[2] + dt * u[0], x[3] + dt * u[1]]
        ),
        lambda x: np.array([x[0], x[1], np.hypot(x[0] - 50, x[1] - 20)]),
        hw.Uniform([0.01, 0.01, 0.01, 0.001]),
        hw.Uniform([0.5, 0.5, 0.2]),
        hw.Box([-0.5, -0.5, 4.5, 0.2], [0.5, 0.5, 5.5, 0.4]),
        nu=2,
        dt=0.2,
    )
    u = np.c_[np.sin(np.arange(100) / 9), 0.4 * np.cos(np.arange(100) / 15)]
    truth, record = hw.simulate(vehicle, u, seed=1)
    lo, hi = hw.estimate(vehicle, record.without(8.0, 11.0), hw.ZonotopeFilter()).check().interval()
    print(
        "vehicle inside:", np.all((lo <= truth.x) & (truth.x <= hi)), "mean width:", np.mean(hi - lo, axis=0).round(2)
    )


if __name__ == "__main__":
    main()
