"""One picture by several processes: parts that are some of its rows, and what puts them together."""

from jaxsph.scale.parts import merge_tiles, render_tile

__all__ = ["merge_tiles", "render_tile"]
