"""The source papers' numbers beside ours: one module a paper, each with ``main``."""
