"""Any known noise: a particle filter on a bounded, nonlinear problem with a bound on the state."""

import numpy as np

import halfwidth as hw


def main():
    tank = hw.Nonlinear(
        g=lambda x, u, dt: x + dt * (u - 0.4 * np.sqrt(np.maximum(x, 0.0))),  # inflow, and outflow by its own pressure
        h=lambda x: x,
        w=hw.Uniform(0.05),
        e=hw.Uniform(0.2) + hw.Gaussian(0.05**2),  # a float that sticks, and a noisy reading
        x0=hw.Box(0.5, 1.5),
        nu=1,
        bounds=(0.0, 4.0),
        dt=0.5,
        names=["level"],
    )
    truth, record = hw.simulate(tank, 0.5 + 0.3 * np.sin(np.arange(200) / 20), seed=4)
    est = hw.estimate(tank, record.without(40.0, 55.0), hw.ParticleFilter(particles=2000), seed=1)
    print(hw.score(est, truth))
    print("lowest end of the interval:", est.interval(0.9)[0].min().round(3), "(the tank is never below empty)")


if __name__ == "__main__":
    main()
