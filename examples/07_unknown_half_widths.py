"""Unknown half-widths: trajectory and bounds from the data alone, and what is said when the bounds contradict them."""

import numpy as np

import halfwidth as hw


def main():
    unknown = hw.Uniform.unknown(at_most=5.0)
    truth, record = hw.simulate(
        hw.Linear([[0.9, 0.2], [-0.2, 0.9]], None, np.eye(2), hw.Uniform(0.1), hw.Uniform(0.5), hw.Box(-1, 1)),
        T=200,
        seed=1,
    )
    record = record.without(60.0, 70.0)
    model = hw.Linear([[0.9, 0.2], [-0.2, 0.9]], None, np.eye(2), unknown, unknown, hw.Box(-1, 1))
    for point in ("central", "least_squares"):
        est = hw.estimate(model, record, hw.BatchLP(point=point))
        error = np.abs(est.x - truth.x).mean()
        print(f"{point:13}  mean error {error:.3f},  q = {est.q.round(3)},  r = {est.r.round(3)}")

    y = record.y.copy()
    y[119, 0] += 9.0  # one output that no trajectory can explain
    capped = hw.Linear([[0.9, 0.2], [-0.2, 0.9]], None, np.eye(2), hw.Uniform(0.1), hw.Uniform(0.5), hw.Box(-1, 1))
    failed = hw.estimate(capped, hw.Record(record.t, y), hw.BatchLP())
    print(failed.status.name + ":", failed.message)


if __name__ == "__main__":
    main()
