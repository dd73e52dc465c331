"""Print the tables of paper 000 beside ours and draw its figures into out/papers/.

Run ``python papers/paper000.py [--quick]``; ``halfwidth reproduce 000`` prints the same tables.
"""

import sys

from halfwidth import reproduce


def main(quick=False):
    for table in reproduce.tables("000", quick=quick):
        print(table.text(), end="\n\n")
    for file in reproduce.paper("000").figures("out/papers", quick=quick):
        print(file)


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
