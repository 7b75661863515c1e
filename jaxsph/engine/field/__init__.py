"""Sums over particles at given points: fetched, summed up, and interpolated between nodes."""
