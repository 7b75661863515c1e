"""One picture by parts: windows of it, and snapshots that stay on disk."""

from typing import TYPE_CHECKING

from jaxsph.numerics.names import lazy

if TYPE_CHECKING:
    from jaxsph.scale.from_disk import TooLittleMemoryError, render_from_disk
    from jaxsph.scale.on_disk import OnDisk
    from jaxsph.scale.parts import merge_tiles, render_tile

__all__ = ["OnDisk", "TooLittleMemoryError", "merge_tiles", "render_from_disk", "render_tile"]

__getattr__, __dir__ = lazy(
    __name__,
    {
        "OnDisk": "jaxsph.scale.on_disk:OnDisk",
        "TooLittleMemoryError": "jaxsph.scale.from_disk:TooLittleMemoryError",
        "merge_tiles": "jaxsph.scale.parts:merge_tiles",
        "render_from_disk": "jaxsph.scale.from_disk:render_from_disk",
        "render_tile": "jaxsph.scale.parts:render_tile",
    },
)
