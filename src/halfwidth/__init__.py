"""State estimation for the real world: bounded noise, unknown half-widths, missing measurements."""
