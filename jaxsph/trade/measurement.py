"""Measurement: one row of a sweep's table, what it was made of and on what, and the file that the table is kept in.

Flow: scene, camera, settings -> sweep -> [measurement] -> sweep.csv -> figures.
"""

from __future__ import annotations

import csv
import dataclasses
import os
import platform
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxsph.io.replace import digest_of, fingerprint, written_whole
from jaxsph.model import Camera, Scene, Settings
from jaxsph.numerics import __version__

TABLE = "sweep.csv"
"""Name in a sweep's folder."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measurement:
    """How wrong one setting was for one frame, and what it took.

    An error is the largest difference of any colour channel or alpha of a pixel; `max_` and `mean_` are over pixels.

    Attributes:
        scene, frame: what was rendered.
        fingerprint: digest of particles, transfer function, camera and settings.
        particles, width, height, samples: size of the frame at full rate, which all settings are compared with.
        method: `"full rate"`, an estimator, `"samples/K"`, `"segments/K"` or `"size/K"`.
        tolerance: what error control was asked for; None without. Segments keep it against the light integral, others against
            full rate.
        certified: whether `max_bound` is proven.
        max_error, mean_error: against full rate.
        over_tolerance: share of pixels whose error is over the tolerance; None without one. Of segments, it is the share of
            those pixels that the integral was taken at, None if there are none; so is `over_bound`.
        max_bound: largest `error_bound`; None without error control.
        over_bound: share of pixels whose error is over their bound; None without error control.
        max_error_converged, mean_error_converged: against an image of `converged` times the samples.
        converged: that factor.
        integral_mean, integral_p999, integral_max: mean, 99.9 % quantile and largest of the errors to the light integral, at
            random pixels; None where it was not taken, or the scene holds media that it does not know.
        integral: for how many pixels it was asked; 0 for none.
        evaluations, evaluations_full: kernel evaluations, and those of full rate.
        plan, compile: seconds to make the plan, 0 where an earlier one serves, and to compile what was not compiled before.
        grid, adapt, cast, image: median seconds of the stages; `image` joins bands, and scales up where `size/K` asks for it.
        total: median of their sum.
        deviation: median deviation of that sum from `total`, seconds.
        full_total: median seconds of full rate in the same turns.
        repeats: turns.
        bytes: working memory that the plan estimates.
        dtype, device, cores, jaxsph, jax, numpy, python, commit: of the run; `commit` is None outside a checkout.
    """

    scene: str
    frame: float | None
    fingerprint: str
    particles: int
    width: int
    height: int
    samples: int
    method: str
    tolerance: float | None
    certified: bool
    max_error: float
    mean_error: float
    over_tolerance: float | None
    max_bound: float | None
    over_bound: float | None
    max_error_converged: float
    mean_error_converged: float
    converged: int
    integral_mean: float | None = None
    integral_p999: float | None = None
    integral_max: float | None = None
    integral: int = 0
    evaluations: int
    evaluations_full: int
    plan: float
    compile: float
    grid: float
    adapt: float
    cast: float
    image: float
    total: float
    deviation: float
    full_total: float
    repeats: int
    bytes: int
    dtype: str
    device: str
    cores: int
    jaxsph: str
    jax: str
    numpy: str
    python: str
    commit: str | None


COLUMNS = tuple(field.name for field in dataclasses.fields(Measurement))


def of_frame(scene: Scene, camera: Camera, settings: Settings, converged: int) -> dict[str, Any]:
    """Size of a frame at full rate, and a digest of all that its image depends on."""
    particles = scene.particle_set
    size = {"width": camera.width, "height": camera.height, "samples": settings.samples}
    count = {"particles": particles.num_particles, "dtype": str(particles.dtype)}
    return size | count | {"fingerprint": fingerprint("m", settings, converged, digest_of((scene, camera)))}


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


def write_table(path: str | Path, measurements: Iterable[Measurement]) -> None:
    """Write comma-separated values with a header, whole or not at all; None is an empty cell."""
    with written_whole(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(dataclasses.asdict(measurement) for measurement in measurements)
