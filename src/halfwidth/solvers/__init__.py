"""Solvers: programs, the stock libraries that solve them, answers that are proved (`lp.py`), chains in time."""
