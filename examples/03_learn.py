"""Learning the noise: Q and R from a record that misses almost a third of its rows."""

import numpy as np

import halfwidth as hw


def main():
    truth = hw.Linear(
        A=[[1.0, 1.0], [0.0, 1.0]],
        B=None,
        C=[[1.0, 0.0], [0.0, 1.0]],
        w=hw.Gaussian([[0.5, 0.1], [0.1, 0.2]]),
        e=hw.Gaussian([[1.0, 0.3], [0.3, 2.0]]),
        x0=hw.Normal([0.0, 0.0], 1.0),
    )
    _, record = hw.simulate(truth, T=2000, seed=3)
    lost = np.random.default_rng(4).random(len(record)) < 0.3
    record = hw.Record(record.t, np.where(lost[:, None], np.nan, record.y))

    guess = hw.Linear([[1, 1], [0, 1]], None, np.eye(2), hw.Gaussian(1.0), hw.Gaussian(1.0), truth.x0)
    for method in ("em", "ml"):
        learned = hw.learn(guess, record, method=method)
        print(f"{method}: log-likelihood {learned.loglik:.2f} after {len(learned.history)} iterations")
        print("Q =", np.round(learned.model.w.cov().single, 3).tolist())
        print("R =", np.round(learned.model.e.cov().single, 3).tolist())


if __name__ == "__main__":
    main()
