"""Provenance: what a measurement was made of, and on what.

Flow: scene, camera, settings -> [provenance] -> sweep.
"""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxsph.model import Camera, Scene, Settings
from jaxsph.numerics.version import __version__


def of_frame(scene: Scene, camera: Camera, settings: Settings, converged: int) -> dict[str, Any]:
    """Size of a frame at full rate, and a digest of all that its image depends on."""
    particles = scene.particle_set
    static = (settings, converged, particles.kernel, camera.width, camera.height, camera.projection)
    digest = hashlib.sha256(repr(static).encode())
    for leaf in jax.tree_util.tree_leaves((scene, camera)):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    size = {"width": camera.width, "height": camera.height, "samples": settings.samples}
    count = {"particles": particles.num_particles, "dtype": str(particles.dtype)}
    return size | count | {"fingerprint": digest.hexdigest()[:16]}


def of_this_run() -> dict[str, Any]:
    """Machine and versions."""
    versions = {"jaxsph": __version__, "jax": jax.__version__, "numpy": np.__version__, "python": platform.python_version()}
    return {"device": jax.devices()[0].device_kind, "cores": os.cpu_count() or 1, "commit": _commit()} | versions


def _commit() -> str | None:
    """Of the checkout that this file is tracked in, if it is."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("describe", "--always", "--dirty", "--exclude", "*")
    except (OSError, subprocess.CalledProcessError):
        return None
