"""A biased map beside noisy fixes: what is only bounded must not be averaged away."""

import dataclasses

import numpy as np

import halfwidth as hw

MAP, CAMERA, FIX = 0.6, 0.15, 1.2  # bound of the lane map's error, noise of the camera and of the fixes, m


def car():
    """Distance from the road's centre line and its rate, at 5 Hz; outputs: a fix, and the lane seen on the map."""
    dt = 0.2
    return hw.Linear(
        A=[[1.0, dt], [0.0, 1.0]],
        B=None,
        C=[[1.0, 0.0], [1.0, 0.0]],
        w=hw.Gaussian(0.02 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])),
        e=hw.Uniform([0.0, MAP]) + hw.Gaussian([FIX**2, CAMERA**2]),
        x0=hw.Normal([0.0, 0.0], [4.0, 0.25]),
        dt=dt,
        names=["offset", "rate"],
    )


def drive(model, seed=4):
    """Draw five minutes: each tile of the map is wrong by its own constant, and a tunnel takes the fixes."""
    gaussian = dataclasses.replace(model, e=model.e.gaussian)
    truth, record = hw.simulate(gaussian, T=1500, seed=seed)
    tile = np.array([0.55, -0.5, 0.6])[np.arange(1500) // 500]
    y = record.y + np.column_stack([np.zeros(1500), tile])
    y[700:1000, 0] = np.nan
    return truth, hw.Record(record.t, y)


def main():
    model = car()
    truth, record = drive(model)

    noise_only = dataclasses.replace(model, e=model.e.gaussian)
    estimates = {
        "Kalman, map believed": hw.estimate(noise_only, record, hw.KalmanFilter()),
        "Kalman, bound as variance": hw.estimate(model.as_gaussian(), record, hw.KalmanFilter()),
        "MixedFilter": hw.estimate(model, record),
        "MixedWindow": hw.estimate(model, record, hw.MixedWindow()),
        "MixedWindow, 2 s late": hw.estimate(model, record, hw.MixedWindow(lag=10)),
    }
    print(f"{'':28}{'inside 99 %':>12}{'half-width':>12}{'rmse':>8}")
    for name, est in estimates.items():
        lo, hi = (end[:, 0] for end in est.interval(0.99))
        x = truth.x[:, 0]
        inside, error = np.mean((lo <= x) & (x <= hi)), np.sqrt(np.mean((est.x[:, 0] - x) ** 2))
        print(f"{name:28}{100 * inside:10.1f} %{np.mean(hi - lo) / 2:10.2f} m{error:6.2f} m")

    mixed = estimates["MixedFilter"].spread
    print(f"at the end: {mixed.sd[-1, 0]:.2f} m of noise beside {mixed.half[-1, 0]:.2f} m that nothing averages away")
    draw(record, truth, estimates, "mixed_noise.png")


def draw(record, truth, estimates, path):
    """Draw errors with their 99 % bands."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.6), layout="constrained", dpi=120)
    ax = figure.subplots()
    base = truth.x[:, 0]
    for name, colour in (("MixedWindow, 2 s late", "#2166ac"), ("Kalman, bound as variance", "#e08214")):
        est = estimates[name]
        lo, hi = (end[:, 0] - base for end in est.interval(0.99))
        ax.fill_between(est.t, lo, hi, color=colour, alpha=0.25, lw=0)
        ax.plot(est.t, est.x[:, 0] - base, color=colour, lw=1.0, label=f"{name}, 99 %")
    ax.plot(record.t, record.y[:, 1] - base, ".", ms=1, color="0.6", label="lane on the map")
    ax.axvspan(record.t[700], record.t[999], color="0.93", zorder=0)
    ax.annotate("tunnel", (record.t[850], 1.5), ha="center", color="0.35")
    ax.axhline(0.0, color="0.2", lw=0.8)
    ax.set(xlabel="t [s]", ylabel="offset, error [m]", xlim=(20, 300), ylim=(-1.8, 1.8))
    ax.legend(loc="lower left", fontsize="small", ncols=3, frameon=False)
    figure.savefig(path)


if __name__ == "__main__":
    main()
