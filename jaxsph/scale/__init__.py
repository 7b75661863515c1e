"""One picture by several processes: parts that are some of its rows, and what puts them together."""

from typing import TYPE_CHECKING

from jaxsph.numerics.names import lazy

if TYPE_CHECKING:
    from jaxsph.scale.parts import merge_tiles, render_tile

__all__ = ["merge_tiles", "render_tile"]

__getattr__, __dir__ = lazy(__name__, {name: f"jaxsph.scale.parts:{name}" for name in __all__})
