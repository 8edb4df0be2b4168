"""Analytic surfaces through many groups of points at once: where to start, descent, which kind."""
