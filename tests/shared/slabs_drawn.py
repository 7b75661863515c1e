"""Slabs of rays and the particles in their windows, drawn at random without a camera or a grid."""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.tasks import SlabSchedule, SlabTask

TASKS, SAMPLES, COLUMNS, ROWS, PARTICLES = 34, 5, 3, 4, 30  # more slabs than are looked at together
NEAR, FAR = 1.0, 4.0
FORMS = "perspective", "orthographic", "scattered"


def drawn(rng, form):
    """Particles in two windows a slab, and slabs that tile a depth, their rays all about."""
    support = 0.7 * 10 ** -rng.uniform(0, 1.7, PARTICLES)
    x, y = rng.uniform(-0.7, 0.7, (2, PARTICLES))
    scale = 10 ** rng.uniform(-1, 1, PARTICLES)
    where = {"x": x, "y": y, "z": rng.uniform(NEAR, FAR, PARTICLES), "scale": scale, "size": scale * support}
    columns = where | {"quantity": rng.uniform(0, 1, PARTICLES)}
    unread = dict.fromkeys(field.name for field in dataclasses.fields(Ordered))
    ordered = Ordered(**unread | columns)
    begin = np.stack([np.zeros(TASKS), rng.integers(10, 20, TASKS)]).astype(np.int32)
    length = np.stack([rng.integers(0, 10, TASKS), rng.integers(0, 10, TASKS)]).astype(np.int32)
    reference = rng.uniform(0, 1, TASKS)
    zero = np.zeros(TASKS, np.int32)
    entry = SlabSchedule(np.ones(TASKS, bool), zero, begin, length, length.sum(0), (reference,))
    first = rng.uniform(NEAR, FAR, (TASKS, 1))
    border = first + rng.uniform(0.05, 0.5, (TASKS, 1)) * np.arange(SAMPLES + 1)
    depth = 0.5 * (border[:, 1:] + border[:, :-1])
    count = COLUMNS if form != "scattered" else ROWS
    u, v = rng.uniform(-0.4, 0.4, (TASKS, count)), rng.uniform(-0.4, 0.4, (TASKS, ROWS))
    task = SlabTask(entry, zero, zero, u, v, depth, border, form != "orthographic", form == "scattered", between=True)
    return ordered, rng.permutation(PARTICLES).astype(np.int32), task
