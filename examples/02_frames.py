"""Data frames: a river gauge with lost samples, read from a frame and given back as one."""

import numpy as np
import pandas as pd

import halfwidth as hw


def main():
    rng = np.random.default_rng(0)
    index = pd.date_range("2026-03-01", periods=200, freq="h", name="when")
    level = 2.0 + np.cumsum(0.05 * rng.standard_normal(200))
    frame = pd.DataFrame({"gauge_a": level + 0.2 * rng.standard_normal(200), "gauge_b": level}, index=index)
    frame["gauge_b"] += 0.1 * rng.standard_normal(200)
    frame.loc[index[60:90], "gauge_b"] = np.nan  # one gauge fails for 30 hours
    frame.loc[index[70:80], "gauge_a"] = np.nan  # the other for ten of them

    river = hw.Linear(
        A=[[1.0]],
        B=None,
        C=[[1.0], [1.0]],
        w=hw.Gaussian(0.05**2),
        e=hw.Gaussian([0.2**2, 0.1**2]),
        x0=hw.Normal([2.0], 1.0),
        names={"x": ["level"]},
    )
    record = hw.Record.from_frame(frame)  # the index is the clock, every column an output
    print(record)
    filled = hw.estimate(river, record).to_frame(level=0.95)  # a pandas frame with the same index
    print(filled.iloc[[59, 75, 95]].round(2))


if __name__ == "__main__":
    main()
