"""Stands in for the renderer where a test is about what is around it: pictures by the float64 reference, which compiles nothing.

Also a program: `by_reference.py view FILE ...` is a command whose pictures are made so, in a process of its own.
"""

import contextlib
import dataclasses
import importlib
import sys
from collections.abc import Callable, Hashable, Iterator
from typing import Any
from unittest import mock

import jax
import numpy as np
import pytest
from surfaced import crossing

import jaxsph as js
from jaxsph.analysis.projection.columns import PLANE
from jaxsph.cli.main import main
from jaxsph.engine.frame.finish import metadata_of
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.particles.kernels import by_name

PROJECT = "jaxsph.analysis.projection.project"
RENDER = ("jaxsph", "jaxsph.viewer.stages", "jaxsph.trade.sweep", "jaxsph.sequence.task")
PLAN = {"jaxsph.viewer.stages": "plan", "jaxsph.trade.sweep": "make_plan", "jaxsph.sequence.task": "make_plan"}
DEPTHS = 200  # along a ray, between which a surface is looked for
BOUND = 0.003  # of the error of what was asked for with a tolerance
MOST = 200  # pictures that are kept
PICTURES: dict[Hashable, Any] = {}
"""What the reference has made, by all that it was made of: tests ask for one picture with a title, with a bar, in other units."""


class Roomy:
    """A plan that has room for everything."""

    chosen, bytes, levels = None, 1, ()

    def __init__(self, pixel: str = "mean") -> None:
        self.pixel = pixel

    def serves(self, _: Any) -> bool:
        return True

    def check(self, *_: Any) -> None:
        """Made for whatever is asked for."""


def once(make: Callable[..., Any], *given: Any, **how: Hashable) -> Any:
    """What `make` makes of trees of arrays; it may have made it before."""
    leaves, structure = jax.tree.flatten(given)
    arrays = [np.asarray(leaf) for leaf in leaves]
    key = make, tuple(how.items()), structure, tuple((array.dtype.str, array.shape, array.tobytes()) for array in arrays)
    if key not in PICTURES:
        if len(PICTURES) >= MOST:
            PICTURES.clear()
        PICTURES[key] = make(*given, **how)
    return PICTURES[key]


def render(scene: Any, camera: Any, settings: Any = None, progress: Any = None, **_: Any) -> js.Image:
    """As `jaxsph.render`; between two bands somebody may leave it."""
    settings = js.Settings() if settings is None else settings
    if progress is not None:
        progress(1, 2)
    plainly = dataclasses.replace(settings, tolerance=None)
    image = once(_surface, scene, camera) if scene.surface is not None else once(js.reference.render, scene, camera, plainly)
    certified = {} if settings.tolerance is None else {"error_bound": np.full(image.shape, BOUND), "certified": True}
    seconds = dict.fromkeys(("plan", "compile", "grid", "adapt", "cast", "image"), 1.0)
    told = metadata_of(with_depths(camera, scene), settings, settings.tolerance is not None)
    return dataclasses.replace(image, stats=image.stats | {"seconds": seconds}, metadata=told, **certified)


def sums(given: tuple[Any, ...], seen: Any, plan: Roomy, clock: Any) -> tuple[list[Any], Any]:
    """As `jaxsph.project` and `jaxsph.slice` have them added up: one for each column of amounts, and no fault."""
    particles, amounts, camera = given
    columns = np.asarray(amounts, np.float64).T
    if plan.pixel == PLANE:
        return [once(_on_plane, particles, camera, one).astype(particles.dtype) for one in columns], np.int32(0)
    images = [once(js.reference.project, particles, camera, one, pixel=plan.pixel, subrays=2) for one in columns]
    return [np.asarray(image.values, particles.dtype) for image in images], np.int32(0)


def _on_plane(particles: Any, camera: Any, amounts: np.ndarray) -> np.ndarray:
    """Sums in the middle of one sample, of particles of equal volumes that carry the amounts."""
    equal = dataclasses.replace(particles, quantity=amounts, volume=np.ones_like(amounts))
    weighted, _, _ = js.reference.field(js.Scene(particles=equal), camera, 1)  # over that of the least support
    least = np.min(particles.support, where=np.asarray(particles.valid), initial=np.inf)
    return np.asarray(weighted[..., 0] * by_name(particles.kernel).norm / least**3)


def _surface(scene: Any, camera: Any) -> js.Image:
    """In colours without light and shade, and opaque."""
    found, look = crossing(scene, with_depths(camera, scene), samples=DEPTHS), scene.transfer
    met = np.isfinite(found.depth)
    colors = np.asarray(look.colors, np.float64).T
    color = np.stack([np.interp(found.quantity, np.asarray(look.values, np.float64), one) for one in colors], -1)
    none = np.zeros(met.shape)
    layers = np.where(met[..., None], color, 0), np.where(met, 0.0, 1.0), found.depth, none, none
    counts = {"evaluations": 0, "evaluations_full": 0, "cells": 0, "pairs": 0}
    return js.Image(*layers, True, 0, counts, normal=np.where(met[..., None], found.normal, 0))


@contextlib.contextmanager
def pictures_by_reference() -> Iterator[None]:
    """Those of `jaxsph.render`, as users, commands, views, sequences and sweeps call it; sums of `jaxsph.project`, too."""
    with contextlib.ExitStack() as patched:
        project = importlib.import_module(PROJECT)
        patched.enter_context(mock.patch.object(project, "_sums", sums))
        patched.enter_context(mock.patch.object(project, "planned", lambda _, pixel, *__: (Roomy(pixel), None)))
        for name in RENDER:
            patched.enter_context(mock.patch.object(importlib.import_module(name), "render", render))
        for name, verb in PLAN.items():
            patched.enter_context(mock.patch.object(importlib.import_module(name), verb, lambda *_, **__: Roomy()))
        yield


@pytest.fixture
def by_reference() -> Iterator[list[Any]]:
    """Pictures are made by the reference; the settings that they were asked for with."""
    asked: list[Any] = []

    def recorded(scene: Any, camera: Any, settings: Any = None, **more: Any) -> js.Image:
        asked.append(settings)
        return render(scene, camera, settings, **more)

    with pictures_by_reference(), mock.patch.object(js, "render", recorded):
        yield asked


if __name__ == "__main__":
    with pictures_by_reference():
        sys.exit(main())
