"""Cotangents of a transfer function's control points are those of the samples between them."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.media.particles import pull_control_points
from jaxsph.model.transfer.function import SELECT_ALL


@jax.jit
def pulled(optics, quantity, found, transfer):
    return pull_control_points((optics, quantity, found), transfer.segments())


@pytest.mark.parametrize("spacing", ["even", "uneven"])
@pytest.mark.parametrize("points", [2, SELECT_ALL, SELECT_ALL + 1, 40])
def test_control_points_have_the_cotangents_of_the_samples_between_them(points, spacing, x64):
    """However many there are: on either side of where they are searched rather than compared."""
    rng = np.random.default_rng(points)
    values = {"even": np.linspace(-1, 2, points), "uneven": np.sort(rng.uniform(-1, 2, points))}[spacing]
    transfer = js.TransferFunction.from_points(values, np.zeros((points, 3)), np.zeros(points))
    found, *optics, quantity = rng.normal(0.5, 1, (6, 3, 4, 64))
    wanted = np.zeros((5, points))
    at = np.clip(np.searchsorted(values, found, side="right") - 1, 0, points - 2)
    part = np.clip((found - values[at]) / (values[at + 1] - values[at]), 0, 1)
    for row, value in zip(wanted, [*optics, -quantity], strict=True):
        np.add.at(row, at, (1 - part) * value)
        np.add.at(row, at + 1, part * value)
    of = pulled(optics, quantity, found, transfer)
    rows = np.concatenate([of.colors.T, of.extinction[None], of.values[None]])
    np.testing.assert_allclose(rows, wanted, rtol=1e-9, atol=1e-9)
