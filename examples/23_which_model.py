"""Which model? Kinds of noise, errors of fixes and the length of a window, by evidence and by what was hidden."""

import numpy as np

import halfwidth as hw


def main():
    # A walk seen through a sensor whose error is bounded: what does the record say of its noise?
    x0 = hw.Normal([0.0], 1.0)

    def walk(w, e):
        return hw.Linear([[0.95]], None, [[1]], w, e, x0)

    _, record = hw.simulate(walk(hw.Gaussian(0.01), hw.Uniform(1.0)), T=150, seed=3)
    box, bell = hw.Uniform.unknown(at_most=10.0), hw.Gaussian.unknown(at_most=100.0)
    kinds = {
        "Gaussian error": walk(bell, bell),
        "bounded error": walk(bell, box),
        "bounded plus Gaussian": walk(bell, box + bell),
        "no motion": walk(hw.Gaussian(0.0), box),
    }
    found = hw.compare(kinds, record, seed=1)
    print(f"{found}\nevidence: {found.best}; foretells best: {found.foretells}\n")

    # Fixes that are off for minutes at a time: is their error white, or does an offset drift with it?
    rng = np.random.default_rng(2)
    offset, fixes, position = 0.0, [], 0.0
    speed = np.cos(np.arange(120) / 15)
    for v in speed:
        position += v + rng.normal(0, 0.05)
        offset = 0.97 * offset + rng.normal(0, 0.5)
        fixes.append(position + offset + rng.normal(0, 0.2))
    log = hw.Record(np.arange(120.0), fixes, speed[:, None])
    white = hw.Linear([[1]], [[1]], [[1]], hw.Gaussian(0.05**2), bell, hw.Normal([0.0], 9.0))
    motion = hw.Gaussian.unknown([0.05**2, 0.0], [0.05**2, 100.0])  # the speedometer is known, the drift is not
    drifting = hw.Linear([[1, 0], [0, 0.97]], [[1], [0]], [[1, 1]], motion, bell, hw.Normal([0.0, 0.0], [9.0, 4.0]))
    found = hw.compare({"white": white, "white and drifting": drifting}, log, seed=1)
    print(f"{found}\nevidence: {found.best}\n")

    # How long should a window be? Where the sensor's error changes every thirty rows, not long.
    r = np.where(np.arange(150) // 30 % 2, 0.2, 2.0)
    x, y = 0.0, []
    for half in r:
        x = 0.95 * x + rng.normal(0, 0.1)
        y.append(x + rng.uniform(-half, half))
    changing = hw.Record(np.arange(150.0), y)
    method = hw.Posterior()
    choice = hw.choose_memory(walk(bell, box), changing, method, memories=(10, 20, 60), recall=0.0)
    print(choice)


if __name__ == "__main__":
    main()
