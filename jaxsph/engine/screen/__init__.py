"""Across the image: which rays are cast, and how pixels are made of them."""
