"""What the command line tells a person: lines of text, and a progress bar.

Flow: particles, camera, image -> [console] -> cli.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jaxsph.io import ParticleTable
from jaxsph.model import Camera, Image, Settings
from jaxsph.model.registry import ESTIMATING


class UsageError(Exception):
    """The command line asks for something that makes no sense."""


def largest(layer: Any) -> float:
    """Largest number of a layer, 0 of none."""
    return float(np.asarray(layer).max(initial=0))


def largest_difference(image: Image, truth: Image) -> float:
    """Largest difference of any colour channel or alpha of any pixel."""
    pairs = ((image.color, truth.color), (image.transmittance, truth.transmittance))
    return max(float(np.abs(np.asarray(one, np.float64) - np.asarray(other)).max()) for one, other in pairs)


@contextlib.contextmanager
def progress(what: str, unit: str = " bands") -> Iterator[Callable[[int, int], None] | None]:
    """A progress bar on stderr where a person watches and tqdm is there, else `None`."""
    try:
        from tqdm import tqdm
    except ImportError:
        yield None
        return
    if not sys.stderr.isatty():
        yield None
        return
    with tqdm(desc=what, unit=unit, leave=False, file=sys.stderr) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def say(what: str, text: str) -> None:
    """Print a line with its subject in front."""
    print(f"{what:<10}{text}")


def span(values: Any) -> str:
    """Range of numbers as text."""
    values = np.asarray(values, np.float64)
    if not values.size:
        return "nothing"
    low, high = values.min(), values.max()
    return f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"


def ranges(column: np.ndarray) -> str:
    """Range of a scalar, or of each component of a vector; what is not finite is counted, not hidden."""
    columns = np.atleast_2d(column.T).astype(np.float64)
    finite = [part[np.isfinite(part)] for part in columns]
    odd = columns.size - sum(part.size for part in finite)
    return " | ".join(span(part) for part in finite) + (f" ({odd} not finite)" if odd else "")


def attributes(table: ParticleTable) -> None:
    """Print the columns of a table: name, shape, type and range."""
    for sentence in table.conventions:
        print(f"  {sentence}")
    print()
    rows = [("attribute", "shape", "type", "range")]
    for name, column in (("position", table.position), *table.columns.items()):
        rows.append((name, " x ".join(map(str, column.shape)), str(column.dtype), ranges(column)))
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for row in rows:
        print("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, (*widths, 0), strict=True)).rstrip())


def camera_line(camera: Camera) -> str:
    """The options that give this camera again, and its depths."""
    eye, axes = camera.exact_eye(), np.asarray(camera.axes, np.float64)
    fov = 2 * np.degrees(np.arctan(float(camera.half_height)))
    near, far = float(camera.near), float(camera.far)
    target = eye + axes[2] * (near + far) / 2
    place = " ".join(f"{v:.5g}" for v in eye) + " --target " + " ".join(f"{v:.5g}" for v in target)
    return f"--eye {place} --fov {fov:.4g}, depths {near:.5g} to {far:.5g}"


def error_line(image: Image, settings: Settings, by_quadtree: bool) -> str:
    """Largest error of any pixel, how it is known, and what it is measured against where that is not full rate."""
    error = f"at most {largest(image.error_bound):.2g}"
    if settings.integrator in ESTIMATING and settings.screen != "quadtree" and not by_quadtree:
        return f"{error.replace('most', 'most about')} (estimated against the light integral)"
    return f"{error} ({'certified' if image.certified else 'estimated'})"


def time_line(image: Image, elapsed: float) -> str:
    """Seconds by stage, and kernel evaluations."""
    seconds = {name: value for name, value in image.stats.get("seconds", {}).items() if value >= 0.005}
    parts = ", ".join(f"{name} {value:.2f}" for name, value in seconds.items())
    spent, full = float(image.stats["evaluations"]), float(image.stats["evaluations_full"])
    of = "" if spent == full else f" of {full / 1e6:,.1f} M"
    return f"{elapsed:.2f} s ({parts}); {spent / 1e6:,.1f} M{of} kernel evaluations"
