"""``python -m halfwidth``: the command line."""

from halfwidth.shells.cli import main

main()
