"""What the state may be: a tank that is never negative, and two tanks that hold ten litres together."""

import numpy as np

import halfwidth as hw


def main():
    # A level that is never below 0 nor above 2 m, and a flow; the gauge is noisy, and silent for 15 s.
    level = hw.Linear(
        [[1, 1], [0, 0.95]],
        None,
        [[1, 0]],
        hw.Gaussian([1e-4, 4e-3]),
        hw.Gaussian(0.25),
        hw.Normal([0.3, 0.0], [0.1, 0.01]),
        bounds=hw.Box([0, -np.inf], [2, np.inf]),
        names=["level", "flow"],
    )
    rng = np.random.default_rng(4)
    truth, x = [], np.array([0.3, 0.0])
    for _ in range(120):
        x = level.A.single @ x + rng.normal(size=2) * [1e-2, 0.06]
        if not 0 <= x[0] <= 2:
            x = np.array([np.clip(x[0], 0, 2), 0.0])  # a full or an empty tank stops the flow
        truth.append(x)
    truth = np.array(truth)
    record = hw.Record(np.arange(1.0, 121), truth[:, 0] + 0.5 * rng.normal(size=120)).without(60, 75)

    free = hw.Linear(level.A, None, level.C, level.w, level.e, level.x0)
    plain = hw.estimate(free, record, hw.KalmanFilter())
    kept = hw.estimate(level, record, hw.Constrained(hw.KalmanFilter()))
    for name, est in (("KalmanFilter", plain), ("Constrained", kept)):
        x, (lo, hi) = est.x[:, 0], (end[:, 0] for end in est.interval(0.9))
        off = x - truth[:, 0]
        inside = np.mean((lo <= truth[:, 0]) & (truth[:, 0] <= hi))
        print(
            f"{name:<13} error {np.sqrt(np.mean(off**2)):.3f} m, level {x.min():.2f} to {x.max():.2f} m,"
            f" 90 % interval {np.mean(hi - lo):.2f} m wide holds {100 * inside:.0f} %"
        )
    print("rows where the filter alone broke a bound:", np.count_nonzero(kept.info["distance"]))

    # Rows D x: the first tank holds at least as much as the second, and together they hold ten litres.
    both = hw.Halfspaces([[1, -1], [1, 1]], [0, 10], [np.inf, 10])
    tanks = hw.Linear(
        np.eye(2), None, np.eye(2), hw.Gaussian(0.01), hw.Gaussian(1.0), hw.Normal([5, 5], 4.0), bounds=both
    )
    readings = hw.Record([1.0, 2.0, 3.0], [[4.0, 5.5], [5.0, 6.1], [4.9, None]])
    for by in ("ep", "project"):
        est = hw.estimate(tanks, readings, hw.Constrained(by=by))
        print(f"{by:<8}", est.x.round(2).tolist(), "sd", est.spread.sd[-1].round(2))

    # On line, and a reading that no tank can have.
    live = hw.stream(level, hw.Constrained())
    live.push(0.4)
    newest = live.push(40.0)
    print(newest.x[0].round(2), newest.status.name, "-", newest.info.get("message"))


if __name__ == "__main__":
    main()
