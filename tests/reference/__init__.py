"""Slow and obvious versions of the stages, in plain Python and NumPy, to hold the kernels against."""
