"""Slow and obvious versions of the stages, in plain Python, to hold the kernels against."""
