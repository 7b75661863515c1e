"""Arithmetic that knows nothing of particles: checks, faults, sums, exponents, fusion, digests."""
