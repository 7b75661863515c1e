"""Integrals along rays, not normalised."""
