"""Many series at once over the cores, and a forecast with its interval."""

import numpy as np

import halfwidth as hw


def main():
    trend = hw.Linear(
        [[1, 1], [0, 1]], None, [[1, 0]], hw.Gaussian([1e-3, 1e-4]), hw.Gaussian(0.5), hw.Normal([0, 0], 9.0)
    )
    records = [hw.simulate(trend, T=500, seed=k)[1].without(100.0, 130.0) for k in range(50)]
    several = hw.estimate(trend, records)  # one estimate a record
    print(len(several), "series, total log-likelihood", round(sum(one.loglik for one in several), 1))

    ahead = hw.forecast(trend, records[0], 20)
    lo, hi = ahead.interval(0.9)
    print("in 20 rows:", ahead.x[-1].round(2), "between", lo[-1].round(2), "and", hi[-1].round(2))
    assert np.all(np.diff(hi[:, 0] - lo[:, 0]) > 0)


if __name__ == "__main__":
    main()
