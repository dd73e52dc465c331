"""On line with unknown half-widths: a sliding window, an outage longer than its memory, and unknown correlations."""

import numpy as np

import halfwidth as hw


def main():
    # A cart whose noise bounds are unknown; its position is lost for 60 s at 10 Hz.
    h = 0.1
    unknown = hw.Uniform.unknown(at_most=5.0)
    cart = hw.Linear([[1, h], [0, 1]], [[h * h / 2], [h]], [[1, 0]], unknown, unknown, None, dt=h, names=["p", "v"])
    push = np.sin(np.arange(1000) / 30)
    true = hw.Linear(cart.A, cart.B, cart.C, hw.Uniform([0.002, 0.005]), hw.Uniform(0.3), hw.Box([0, 0], [0, 0]), dt=h)
    truth, record = hw.simulate(true, push, seed=1)
    record = record.without(20.0, 80.0)

    window = hw.Window(hw.BatchLP(), memory=25)
    est = hw.estimate(cart, record, window)
    off = np.abs(est.x - truth.x)[:, 0]
    print(f"{est.message}")
    print(f"position error: {off[30:200].mean():.2f} m before, {off[820:].mean():.2f} m after the outage")

    live = hw.stream(cart, window)
    for y, u in zip(record.y, record.u, strict=True):
        newest = live.push(y, u)
    print("newest on line:", newest.x[0].round(2), "from", newest.info["rows"], "rows")

    # Which memory predicts best?
    choice = hw.choose_memory(cart, record, memories=(5, 10, 25, 50))
    print("memory:", choice.best, "scores:", choice.score.round(3))

    # Unknown entries: E makes the noise of the states correlated, and NaN says that we do not know how.
    nan = float("nan")
    model = hw.Linear(
        [[0.9, 0.2], [0, 0.8]], [[1], [0.5]], np.eye(2), unknown, unknown, None,
        E=[[1, nan], [0, 1]], theta_bounds=(0, 1),
    )  # fmt: skip
    true = hw.Linear(
        model.A, model.B, model.C, hw.Uniform(0.1), hw.Uniform(0.05), hw.Box([0, 0], [0, 0]), E=[[1, 0.4], [0, 1]]
    )
    truth, record = hw.simulate(true, np.random.default_rng(0).uniform(-1, 1, 300), seed=2)
    batch = hw.estimate(model, record, hw.SequentialLP())
    online = hw.estimate(model, record, hw.Window(hw.SequentialLP(rounds=1, point="optimal"), memory=25))
    lo, hi = hw.ensemble_interval(online, kappa=2.0)
    inside = np.mean((truth.x >= lo) & (truth.x <= hi), where=np.isfinite(lo))
    print("theta 0.4:", batch.theta.round(2), "in the batch,", np.nanmean(online.info["theta"]).round(2), "on line")
    print(f"the windows' own intervals hold {100 * inside:.0f} % of the states")


if __name__ == "__main__":
    main()
