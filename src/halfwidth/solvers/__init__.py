"""Solvers, one file a problem class, one adapter a library."""
