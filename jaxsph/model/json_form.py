"""What has a form in JSON: transfer functions and camera paths.

Flow: TransferFunction, CameraPath -> [save] -> file -> [load] -> the same.
"""

from __future__ import annotations

import os
from typing import Any, Self

from jaxsph.numerics.names import import_by_name


class WithJson:
    """What `save` writes as a JSON file and `load` reads; `jaxsph.io.json_files` has its form."""

    @classmethod
    def load(cls, path: str | os.PathLike[str], **more: Any) -> Self:
        """Read what `save`, or a person, wrote. See `jaxsph.io.read_transfer`, and `jaxsph.io.read_camera_path` for `more`."""
        return import_by_name("jaxsph.io.json_files:READERS")[cls](path, **more)  # type: ignore[no-any-return]  # 380 ms

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to `path`, a `.json`, whole or not at all. See `jaxsph.io.write_transfer` and `write_camera_path`."""
        import_by_name("jaxsph.io.json_files:WRITERS")[type(self)](path, self)  # 380 ms
