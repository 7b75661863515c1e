"""Ways to and from a transfer function besides its control points: presets, files, figures.

Flow: colour map, preset, file -> [transfer_ways] -> TransferFunction -> file, figure.

The work is done by modules above this one, which enter themselves here, as formats do for images.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from jaxsph.model.transfer.function import TransferFunction


class TransferWays:
    """What a transfer function can be made of, and what can be made of it."""

    presets: ClassVar[Callable[..., TransferFunction]]
    writer: ClassVar[Callable[..., None]]
    reader: ClassVar[Callable[..., TransferFunction]]
    drawer: ClassVar[Callable[..., Any]]

    @classmethod
    def preset(cls, name: str, shown: Any, **more: Any) -> TransferFunction:
        """One that suits a kind of data: `"fluid"`, `"density"`, `"temperature"`, ...; see `jaxsph.scenes.preset`.

        Args:
            name: of the preset.
            shown: Particles or a Volume, whose quantity gives the range and whose size the extinction; or (low, high).
            more: as for `jaxsph.scenes.preset`.
        """
        return cls.presets(name, shown, **more)

    @classmethod
    def from_colormap(cls, colors: Any, values: Any, extinction: Any = 1.0) -> TransferFunction:
        """Of a named map or rows of colours, at control values; see `jaxsph.model.transfer.maps.from_colormap`."""
        from jaxsph.model.transfer import maps as transfer_maps

        return transfer_maps.from_colormap(colors, values, extinction)

    @classmethod
    def from_matplotlib(cls, cmap: Any, norm: Any = None, **more: Any) -> TransferFunction:
        """Of a map and a norm of matplotlib's.

        See `jaxsph.model.transfer.maps.from_matplotlib` for `more`: `low`, `high`, `extinction`, `points`.
        """
        from jaxsph.model.transfer import maps as transfer_maps

        return transfer_maps.from_matplotlib(cmap, norm, **more)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TransferFunction:
        """Read what `save` wrote. See `jaxsph.io.read_transfer`."""
        return cls.reader(path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to `path`, a `.json`, whole or not at all. See `jaxsph.io.write_transfer`."""
        type(self).writer(path, self)

    def figure(self, scene: Any = None, camera: Any = None, **more: Any) -> Any:
        """A figure of matplotlib's: colours and extinction, over the histogram of what rays of `camera` meet in `scene`.

        See `jaxsph.plot.transfer_figure.transfer_figure` for `more`.
        """
        return type(self).drawer(self, scene, camera, **more)
