"""Figures: pictures with a key, transfer functions, sweeps."""
