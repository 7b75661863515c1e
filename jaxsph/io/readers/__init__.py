"""Readers of particle files, one a format."""
