"""Arithmetic that knows nothing of particles: checks, faults, sums, exponents, fusion, digests."""

__version__ = "0.2.0"
