"""Losses nobody tells of: a receiver that freezes, found and bridged; the loss law learned on the way."""

import numpy as np

import halfwidth as hw


def car(loss):
    """Two axes of position and velocity, one step a second, fixes good to half a metre."""
    step = np.array([[1.0, 1.0], [0.0, 1.0]])
    return hw.Linear(
        A=np.kron(np.eye(2), step),
        B=None,
        C=[[1, 0, 0, 0], [0, 0, 1, 0]],
        w=hw.Gaussian(np.kron(np.eye(2), 0.05 * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]))),
        e=hw.Gaussian(0.5**2),
        x0=hw.Normal([0.0, 8.0, 0.0, 3.0], [1.0, 1.0, 1.0, 1.0]),
        names=["east", "v_east", "north", "v_north"],
        loss=loss,
    )


def main():
    # Frozen fixes come in bursts, with a healthy flag; a short tunnel beside them is told to us as NaN.
    freezes = car(hw.Markov(stay_received=0.95, stay_lost=0.7, kind="stale"))
    truth, drive = hw.simulate(freezes, T=400, seed=3)
    drive = drive.without(100, 110)

    believing = hw.estimate(car(None), drive, hw.KalmanSmoother())
    aware = hw.estimate(freezes, drive, hw.GPB(depth=5, smooth=True))
    print(hw.score([believing, aware], truth, states=[0, 2]))

    # gamma is the probability that each fix is what it claims to be; the law need not be known.
    frozen = ~truth.received[:, 0] & drive.seen[:, 0]
    print(f"{frozen.sum()} of 400 fixes were frozen; found {np.sum(frozen & (aware.gamma < 0.5))}, ", end="")
    print(f"false alarms {np.sum(~frozen & drive.seen[:, 0] & (aware.gamma < 0.5))}")
    unknown = car(hw.Markov.unknown(kind="stale"))
    print("learned:", hw.estimate(unknown, drive, hw.GPB(depth=5, smooth=True)).info["loss"])

    # Row by row, the same filter.
    live = hw.stream(freezes, hw.GPB(depth=1))
    newest = [live.push(y) for y in drive.y]
    print("last fix received with probability", round(float(newest[-1].gamma[0]), 3))


if __name__ == "__main__":
    main()
