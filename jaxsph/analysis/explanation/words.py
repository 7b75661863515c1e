"""An explanation in words and numbers.

Flow: Explanation -> [words] -> lines of text, for people and the command line.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsph.model import registry
from jaxsph.model.settings import Settings
from jaxsph.numerics import short

MOST = 5  # particles that are listed, those that add most
SUPER_PIXEL = 5  # what `Image.levels` has for one
FULL_RATE = "samples are at full rate, which is what errors are measured against, not the light integral"
LEVELS = ("at full rate", *(f"at every {1 << level}th sample" for level in range(1, SUPER_PIXEL)), "of one colour")


def note_of(settings: Settings, total: float) -> str:
    """What there is to say of an error bound; nothing where it speaks for itself."""
    if np.isinf(total):
        remedy = "" if registry.estimates(settings.integrator_used) else 'integrator="segments" and '
        return f"no estimate, as nothing is compared without a tolerance: give {remedy}tolerance="
    of_samples, along_rays = settings.integrator_used == "samples", settings.tolerance is not None
    if settings.screen != "pixels":
        judged = of_samples and along_rays and settings.estimator == "pilot"
        return "" if judged else f"of pixels between rays; {FULL_RATE if of_samples else 'along rays nothing is compared'}"
    return FULL_RATE if of_samples and not along_rays else ""


def table_of(made: Any) -> str:
    """An `Explanation` as a table."""
    row, column = made.pixel
    seen, truth = (" ".join(f"{float(channel):.3f}" for channel in color) for color in (made.color, made.integral_color))
    half = f", half of the light gone at depth {made.half_depth:.5g}" if np.isfinite(made.half_depth) else ""
    lines = [f"pixel {row} {column}: colour {seen}, alpha {made.alpha:.4f}{half}", *_budget(made)]
    told = f"colour {truth}, alpha {made.integral_alpha:.4f}; the pixel is {made.off_integral:.2g} off"
    lines.append(_line("light integral", told))
    if made.levels is not None:
        lines.append(_line("cells", _cells(made.levels)))
    lines += _ray(made)
    lines += _particles(made)
    return "\n".join(lines)


def _line(what: str, text: str) -> str:
    return f"{what:<16}{text}"


def _budget(made: Any) -> list[str]:
    if np.isinf(made.total):
        return [_line("error", made.note)]
    kind = "certified" if made.certified else "estimated"
    lines = [_line("error", f"{f'{made.total:.3g}':<11}{kind}{f': {made.note}' if made.note else ''}")]
    shares = sorted(made.sources.items(), key=lambda one: -one[1])
    parts = [(name, f"{share:.3g}", f"{share / made.total:6.1%}" if made.total > 0 else "") for name, share in shares]
    return lines + [_line(f"  {name}", f"{told:<11}{percent}") for name, told, percent in parts]


def _cells(levels: np.ndarray) -> str:
    counts = [(int((levels == level).sum()), name) for level, name in enumerate(LEVELS)]
    told = [f"{number} {name}" for number, name in counts if number]
    empty = int((levels < 0).sum())
    return ", ".join([*told, *([f"{empty} empty"] if empty else [])])


def _ray(made: Any) -> list[str]:
    there = int((made.extinction > 0).sum())
    places = f"{len(made.depth):,} places from depth {made.depth[0]:.5g} to {made.depth[-1]:.5g}, {there:,} that take light"
    lines = [_line("ray", f"{places}; {made.transmittance[-1]:.4f} of it is left at the end")]
    if not np.isnan(made.quantity).all():
        lines.append(_line("quantity", short.span(made.quantity)))
    if made.extinction_quantity is not None:
        lines.append(_line("  of extinction", short.span(made.extinction_quantity)))
    if there:
        most = made.extinction.argmax()
        lines.append(_line("extinction", f"at most {made.extinction[most]:.4g}, at depth {made.depth[most]:.5g}"))
    return lines


def _particles(made: Any) -> list[str]:
    if not len(made.particles):
        return []
    order = np.argsort(-made.added, kind="stable")
    running, total = np.cumsum(made.added[order]), made.added.sum()
    some = f", half of {total:.4f} is by {int(np.searchsorted(running, total / 2)) + 1:,}" if total > 0 else ""
    lines = [_line("particles", f"{len(made.particles):,} met{some}")]
    listed = [which for which in order[:MOST] if made.added[which] > 0]
    return lines + [_line(f"  {made.particles[which]}", f"adds {made.added[which]:.3g}") for which in listed]
