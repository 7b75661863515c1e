"""Volumes on regular grids: formats, and what a file holds."""
