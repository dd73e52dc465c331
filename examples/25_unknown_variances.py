"""Gaussian noise whose variances nobody knows, alone and beside bounded noise: found by evidence, with their spread."""

import numpy as np

import halfwidth as hw


def main():
    A, C = [[0.9, 0.2], [0, 0.8]], np.eye(2)
    x0 = hw.Normal([0, 0], 1.0)
    true = hw.Linear(A, None, C, hw.Gaussian([0.04, 0.09]), hw.Gaussian([0.25, 0.16]), x0)
    truth, record = hw.simulate(true, T=60, seed=1)

    unknown = hw.Gaussian.unknown(at_most=100.0)
    est = hw.estimate(hw.Linear(A, None, C, unknown, unknown, x0), record)
    found = est.info["variances"]
    print(f"{est.method}: {est.status.value}")
    for name, mean, lo, hi, is_ in zip(
        ("Q0", "Q1", "R0", "R1"), found["mean"], found["lo"], found["hi"], (0.04, 0.09, 0.25, 0.16), strict=True
    ):
        print(f"{name}  {mean:.3f}, 5 to 95 %: {lo:.3f} to {hi:.3f}   (truth {is_})")

    # The most likely variances taken as if they were the truth leave out what is not known of them.
    guess = hw.Linear(A, None, C, hw.Gaussian([0.1, 0.1]), hw.Gaussian([0.1, 0.1]), x0)
    structure = {"Q": "diagonal", "R": "diagonal"}
    likely = hw.learn(guess, record, structure=structure, method="ml").model
    plug = hw.estimate(likely, record)
    for name, one in (("variances integrated", est), ("most likely ones", plug)):
        lo, hi = one.interval(0.9)
        print(f"{name:21} mean width {np.mean(hi - lo):.3f}, inside {np.mean((lo <= truth.x) & (truth.x <= hi)):.1%}")

    # Rounding to a grid is bounded and known, what the sensor adds is neither.
    step = 1.0
    rounded = hw.Record(record.t, np.round(record.y / step) * step)
    mixed = hw.Linear(A, None, C, unknown, hw.Uniform(step / 2) + unknown, x0)
    print(
        "\nrounded to",
        step,
        "- R =",
        hw.estimate(mixed, rounded).R.round(2),
        "beside the rounding; without it",
        end=" ",
    )
    print(hw.estimate(hw.Linear(A, None, C, unknown, unknown, x0), rounded).R.round(2))

    # On line, variances are carried from window to window as half-widths are.
    live = hw.estimate(mixed, rounded, hw.Window(hw.Posterior(), memory=15))
    print("last window of 16 rows: Q =", live.Q.round(2), "R =", live.R.round(2))


if __name__ == "__main__":
    main()
