"""What a reader hands on: columns as they came, one array a role, before anything is repaired."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from halfwidth.vehicle.formats.cells import Tally, Times
from halfwidth.vehicle.formats.layout import Use

Floats = NDArray[np.float64]


@dataclass
class Raw:
    """Columns of one log by role, in the file's own units.

    Attributes
    ----------
    source : str
        For messages.
    uses : mapping of str to Use
        Where each column came from and the unit it states.
    values : dict of str to (N,) array
        Numbers by role, NaN where a cell holds none.
    stamps : (N,) int array or None
        Time in nanoseconds where the time column holds dates; the smallest int64 is "none".
    times : Times
        What kind of stamps those are.
    tallies : dict of str to Tally
        Cells that are no numbers, by role.
    notes : list of str
        What was recognised, repaired or dropped so far.
    """

    source: str
    uses: Mapping[str, Use]
    values: dict[str, Floats]
    stamps: NDArray[np.int64] | None = None
    times: Times = field(default_factory=Times)
    tallies: dict[str, Tally] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def n_rows(self) -> int:
        """Rows of the table."""
        if self.stamps is not None:
            return int(self.stamps.size)
        return int(self.values["time"].size)
