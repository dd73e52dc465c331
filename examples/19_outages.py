"""How long an outage may last: cut holes into a log, let every method fill them, look at error and intervals."""

import halfwidth as hw


def main():
    _, log = hw.vehicle.simulate_drive(duration=240.0, seed=3)  # or: log = hw.vehicle.read("drive.csv")

    result = hw.vehicle.outages(log, lengths=[2, 10], starts=6, seed=1, methods=["linear", "cv", "em", "em-white"])
    print(result.table())
    for method, seconds in result.within(tolerance=1.0).items():
        print(f"{method}: within 1 m up to {seconds:.3g} s")
    assert result.cell("em", 10).mean < result.cell("linear", 10).mean
    # result.plot().figure.savefig("outages.png") draws error against length with the tolerance


if __name__ == "__main__":
    main()
