"""A live stream: one row at a time, saved in the middle and resumed, with the same numbers as the batch."""

import numpy as np

import halfwidth as hw


def main():
    walk = hw.Linear([[1, 1], [0, 1]], None, [[1, 0]], hw.Gaussian(0.01), hw.Gaussian(1.0), hw.Normal([0, 0], 1.0))
    _, record = hw.simulate(walk, T=200, seed=5)
    record = record.without(50.0, 60.0)

    live = hw.stream(walk, hw.KalmanFilter())
    for y in record.y[:100]:
        newest = live.push(y)  # None or NaN is a missing entry
    saved = live.snapshot()  # bytes

    again = hw.resume(saved)
    for y in record.y[100:]:
        newest = again.push(y)
    batch = hw.estimate(walk, record, hw.KalmanFilter())
    print("newest:", newest.x[0].round(4), "interval:", [v[0].round(2) for v in newest.interval(0.9)])
    print("largest difference from the batch:", f"{np.abs(newest.x[0] - batch.x[-1]).max():.1e}")


if __name__ == "__main__":
    main()
