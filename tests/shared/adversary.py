"""Frames that are hard to bound, drawn number by number: so that what hypothesis finds, it can shrink."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import jaxsph as js

CAPACITY = 24  # particles, drawn ones and padding
POINTS = 5  # control points of transfer functions


def numbers(*shape, width=32):
    """Arrays of numbers from 0 to 1."""
    return hnp.arrays(np.float64, shape, elements=st.floats(0, 1, width=width), fill=st.nothing())


@st.composite
def transfer_functions(draw, dtype=np.float64):
    """Bands, jumps, nothing, and walls; control points that any dtype holds."""
    values = np.sort(draw(numbers(POINTS, width=16)))
    if draw(st.booleans()):
        values[3] = values[2]
    opaque = draw(hnp.arrays(np.float64, POINTS, elements=st.sampled_from([0.0, 0.1, 1.0, 30.0, 1e6]), fill=st.nothing()))
    extinction = opaque * (1 - 0.9 * draw(numbers(POINTS)))
    colors = draw(numbers(POINTS, 3))
    return js.TransferFunction.from_points(*(value.astype(dtype) for value in (values, colors, extinction)))


@st.composite
def scenes(draw, kernel="poly6", dtype=np.float64):
    """Supports over four decades, clumps, constants, hardly varying and varying quantities."""
    count = draw(st.integers(0, CAPACITY))
    position = 2 * draw(numbers(count, 3)) - 1
    support = 0.9 * 10 ** -(draw(st.sampled_from([0.3, 1, 4])) * draw(numbers(count))) * draw(st.sampled_from([1, 4]))
    spread = draw(st.sampled_from([1.0, 0.03, 1e-3, 0.0]))
    quantity = draw(st.sampled_from([0.0, 0.3])) + spread * draw(numbers(count))
    if draw(st.booleans()):
        quantity = np.where(position[:, 0] > 0, 0.7, quantity)
    columns = (position, support, quantity, 0.1 + 0.9 * draw(numbers(count)))
    particles = js.Particles.from_arrays(*(column.astype(dtype) for column in columns), kernel, capacity=CAPACITY)
    return js.Scene(particles=particles, transfer=draw(transfer_functions(dtype)))


@st.composite
def cameras(draw, frames, projection="perspective", dtype=np.float64):
    """From outside, or among the particles."""
    turn, rise, *off = draw(numbers(5))
    turn, rise, distance = 2 * np.pi * turn, np.pi * (rise - 0.5), draw(st.sampled_from([3.0, 1.5, 0.2]))
    direction = np.array([np.cos(rise) * np.sin(turn), np.sin(rise), np.cos(rise) * np.cos(turn)])
    eye, target = (distance * direction).astype(dtype), (0.2 * np.array(off) - 0.1).astype(dtype)
    up = (0.1, 1.0, 0.2) if abs(direction[1]) < 0.9 else (1.0, 0.1, 0.2)
    size = {"width": frames.width, "height": frames.height, "near": max(distance - 1.7, 0.05), "far": distance + 1.7}
    if projection == "perspective":
        return js.Camera.look_at(eye, target, up, 50.0, **size)
    return js.Camera.orthographic(eye, target, up, 2.5, **size)
