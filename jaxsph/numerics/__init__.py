"""Arithmetic that knows nothing of particles: checks, faults, sorting by segments."""
