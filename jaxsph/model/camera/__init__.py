"""Cameras, the paths they move along, and how they frame what there is."""
