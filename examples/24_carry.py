"""On line: what windows carry on about half-widths they were never told, and the estimate of some rows ago."""

import numpy as np

import halfwidth as hw


def main():
    A, C = [[0.9, 0.2], [-0.2, 0.9]], np.eye(2)
    true = hw.Linear(A, None, C, hw.Uniform(0.1), hw.Uniform(0.5), hw.Box(-1, 1))
    truth, record = hw.simulate(true, T=200, seed=4)
    unknown = hw.Uniform.unknown(at_most=5.0)
    asked = hw.Linear(A, None, C, unknown, unknown, hw.Box(-1, 1))
    inner = hw.Posterior()

    # Ten rows tell little of four half-widths. With `recall` a window also knows what the rows that have left it told.
    late = slice(50, None)
    print("memory 10              error   inside 90 %   r (truth .5), mean and scatter over the windows")
    for name, recall in (("each on its own", 0.0), ("carried on", 40.0)):
        est = hw.estimate(asked, record, hw.Window(inner, memory=10, recall=recall))
        lo, hi = est.interval(0.9)
        error, inside = np.abs(est.x - truth.x)[late].mean(), np.mean((lo <= truth.x) & (truth.x <= hi))
        r = est.info["r"][late]
        print(f"{name:20}  {error:6.3f}  {inside:10.1%}    {r.mean(axis=0).round(2)} +- {r.std(axis=0).round(2)}")

    # Rows that may wait are estimated better: each push gives the state of `lag` rows ago, which later rows have seen.
    print("\nlag   error")
    for lag in (0, 2, 5):
        live = hw.stream(asked, hw.Window(inner, memory=10, lag=lag))
        off = []
        for y in record.y:
            newest = live.push(y)
            row = int(newest.t[0]) - 1
            off.append(np.abs(newest.x[0] - truth.x[row]).mean())
        print(f"{lag:3}   {np.mean(off[50:]):.3f}")
    print("half-widths of the newest window:", newest.q.round(2), newest.r.round(2))

    # A stream may stop and go on elsewhere: the snapshot holds what was learned.
    again = hw.resume(live.snapshot(), asked)
    print("rows known to the one that goes on:", again.push(record.y[-1]).info["rows"])


if __name__ == "__main__":
    main()
