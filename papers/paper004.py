"""Print the tables of paper 004 beside ours and draw its figures into out/papers/.

Run ``python papers/paper004.py [--quick]``; ``halfwidth reproduce 004`` prints the same tables.
"""

import sys

from halfwidth import reproduce


def main(quick=False):
    for table in reproduce.tables("004", quick=quick):
        print(table.text(), end="\n\n")
    for file in reproduce.paper("004").figures("out/papers", quick=quick):
        print(file)


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
