"""Print the tables of paper 002 beside ours and draw its figures into out/papers/.

Run ``python papers/paper002.py [--quick]``; ``halfwidth reproduce 002`` prints the same tables.
"""

import pathlib
import sys

from halfwidth import reproduce

#: Logs of drives, where a folder with some stands beside the repository.
LOGS = sorted(str(path) for path in (pathlib.Path(__file__).parents[2] / "shared" / "data").glob("*.csv.gz"))


def main(quick=False):
    for table in reproduce.tables("002", quick=quick, logs=LOGS):
        print(table.text(), end="\n\n")
    for file in reproduce.paper("002").figures("out/papers", quick=quick):
        print(file)


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
