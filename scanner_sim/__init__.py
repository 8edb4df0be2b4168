"""A stripe laser scanner that knows the truth."""
