"""Thin skins around `halfwidth.job.run`: the command line."""
