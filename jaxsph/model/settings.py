"""Settings: how well, and with what means, an image is to be made."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

GIBIBYTE = 1 << 30


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Choices of the user; hashable where they fix a shape.

    Attributes:
        samples: fine samples N along every ray, at least 1.
        tolerance: `None` renders at full rate: the reference image. A number would ask for error control, which this
            version does not have and refuses.
        memory_limit: bytes that a frame's working arrays may take; the image is rendered in bands to keep it.
    """

    samples: int = 256
    tolerance: float | None = None
    memory_limit: int = 4 * GIBIBYTE

    def __post_init__(self) -> None:
        if isinstance(self.samples, bool) or not isinstance(self.samples, int | np.integer) or self.samples < 1:
            raise ValueError(f"`samples` must be an integer of at least 1, got {self.samples!r}")
        if self.samples > 1 << 20:
            raise ValueError(f"`samples` must be at most {1 << 20}, got {self.samples}; more cannot be told apart in float32")
        if self.tolerance is not None:
            raise ValueError(
                f"`tolerance` = {self.tolerance}: error control is not part of this version; use tolerance=None (full rate)"
            )
        if not self.memory_limit > 0:
            raise ValueError(f"`memory_limit` must be > 0 bytes, got {self.memory_limit}")


jax.tree_util.register_dataclass(Settings, data_fields=[], meta_fields=["samples", "tolerance", "memory_limit"])
