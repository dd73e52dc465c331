"""Which bound do I need? One drive, three kinds of interval, and what each is worth when its assumption is wrong."""

import numpy as np

import halfwidth as hw


def main():
    A, C = [[0.9, 0.2], [-0.2, 0.9]], np.eye(2)
    true = hw.Linear(A, None, C, hw.Uniform(0.1), hw.Uniform(0.5), hw.Box(-1, [1, 1]))
    truth, record = hw.simulate(true, T=300, seed=3)
    record = record.without(120.0, 130.0)
    unknown = hw.Uniform.unknown(at_most=5.0)
    asked = hw.Linear(A, None, C, unknown, unknown, hw.Box(-1, [1, 1]))

    told = hw.estimate(true.as_gaussian(), record, hw.KalmanSmoother())
    learned = hw.estimate(asked, record)  # Posterior: half-widths from the data
    print(f"learned  q = {learned.q.round(3)}, r = {learned.r.round(3)}   (truth .1 and .5)")
    for name, est in (("told the truth", told), ("told nothing", learned)):  # `.plot()` draws the diagram
        print(f"\n{name}: {hw.coverage(est, truth, levels=(0.5, 0.8, 0.95))}")

    # One output in a hundred is off by ten half-widths: a Gaussian belief is dragged along, a named outlier is not.
    rng = np.random.default_rng(0)
    y = record.y.copy()
    bad = (rng.random(y.shape) < 0.01) & record.seen
    y[bad] += rng.choice([-5.0, 5.0], bad.sum())
    dirty = hw.Record(record.t, y)
    dragged = hw.estimate(true.as_gaussian(), dirty, hw.KalmanSmoother())
    named = hw.estimate(asked, dirty, hw.Posterior(outliers=True))
    print(f"\n{bad.sum()} outliers: {len(named.info['outliers'])} named, rate {named.info['rate']:.3f}")
    for name, est in (("clean", learned), ("Gaussian, dragged", dragged), ("outliers named", named)):
        print(f"{name:18}  mean error {np.abs(est.x - truth.x).mean():.3f}")

    # The first output plus the second: any linear functional has an interval of its own.
    lo, hi = learned.interval(0.9, of=[1, 1])
    print(f"\nx0 + x1 at the last row: {lo[-1, 0]:.2f} to {hi[-1, 0]:.2f}, truth {truth.x[-1].sum():.2f}")

    # And any functional of several rows: it is a state of its own, here the mean of x0 over the outage.
    def E(t):
        return [[1, -1 / 11 if 120 <= t <= 130 else 0, 0], [0, 1, 0], [0, 0, 1]]

    summing = hw.Linear(
        [[1, 0, 0], [0, *A[0]], [0, *A[1]]], None, np.c_[[0, 0], C], hw.Uniform.unknown(at_most=[0, 5, 5]), unknown,
        hw.Box([0, -1, -1], [0, 1, 1]), E=E,
    )  # fmt: skip
    lo, hi = hw.estimate(summing, record).interval(0.9)
    mean = truth.x[(record.t >= 120) & (record.t <= 130), 0].mean()
    print(f"mean of x0 over the outage: {lo[-1, 0]:.2f} to {hi[-1, 0]:.2f}, truth {mean:.2f}")

    models = {
        "bounded noise": asked,
        "no state noise": hw.Linear(A, None, C, hw.Uniform(0.0), unknown, hw.Box(-1, [1, 1])),
    }
    print(f"\n{hw.compare(models, record, seed=1)}")


if __name__ == "__main__":
    main()
