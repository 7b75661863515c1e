"""A picture at once, and better ones after it: until the tolerance is met, or every pixel has its ray.

Flow: scene, camera, settings -> plan -> coarse lattice -> [progressive: mark -> cast -> image], again and again.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.images import image_of
from jaxsph.engine.frame.layers import Drawn
from jaxsph.engine.frame.quadtree import Counts, Decisions, begun, finished, mark, opened, shot, sizes_of, tolerance_of
from jaxsph.engine.planning.fit import PLANS
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.executors import Eager
from jaxsph.engine.screen.canvas import Canvas
from jaxsph.engine.screen.marking import Quality
from jaxsph.engine.screen.packets import Queue
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import array_of, at_once
from jaxsph.numerics.trees import on_host

SHARE = 0.5  # of the squared error, what the leaves hold that a stage splits
Bands = tuple[Decisions, ...]
Queues = tuple[tuple[Queue, Queue], ...]


@on_host
def progressive(
    scene: Scene, camera: Camera, settings: Settings | None = None, *, worst: int | None = None, share: float = SHARE
) -> Progressive:
    """Render in stages: `for image in jaxsph.progressive(scene, camera, settings): ...`

    The first image is interpolated between the rays of a coarse lattice; each stage splits the leaves of a quadtree that are
    estimated to be worst, casts the rays that are new, and yields a better image (Kratz et al. 2011, section 5). It ends when no
    leaf is expected to be over `settings.tolerance`, or without one when every pixel has a ray that is not certain to be empty.

    Args:
        scene, camera, settings: as for `jaxsph.render`; `settings.leaf_pixels` chooses the first leaves, and `settings.screen` is
            taken to be `"quadtree"`.
        worst: leaves that a stage splits, m of the paper; all with an error as large as the last of them.
        share: if `worst` is not given, each stage splits as few leaves as hold this share in (0, 1] of the sum of all squared
            errors.

    Returns:
        An iterator of images that can be left and gone on with at any time, and begun anew: see `Progressive`.

    Raises:
        ValueError: for a `worst` < 1, a `share` outside (0, 1], traced arguments, and what `jaxsph.render` raises it for.
    """
    if worst is not None and not worst >= 1:
        raise ValueError(f"`worst` must be at least 1 leaf a stage, got {worst}; None splits by `share`")
    if not 0 < share <= 1:
        raise ValueError(f"`share` must lie in (0, 1], got {share}; 1 splits all leaves that are over the tolerance")
    return Progressive(scene, camera, settings or Settings(), worst, share)


class Progressive:
    """Images of one view, each better than the one before; an iterator that ends when the image is good enough.

    What is known of the image is kept when a stage is interrupted: the next call begins that stage again. The grids of all bands
    are kept, too: memory is that of a whole frame, however many bands it has.
    `image.stats` of each holds `stage`, `rays` cast so far, `rays_left` at most until every pixel has its own, `l2_error` (the
    estimated relative L2 norm of the error), `max_error` (the largest error that a pixel is expected to have), `leaves_over`
    the tolerance, and `seconds` of all stages; `image.error_bound` is the error that each pixel is expected to have.
    """

    def __init__(self, scene: Scene, camera: Camera, settings: Settings, worst: int | None, share: float) -> None:
        self._scene, self._camera, self._settings = scene, camera, settings
        self._worst, self._share = worst, share
        self.restart()

    def restart(self, scene: Scene | None = None, camera: Camera | None = None, settings: Settings | None = None) -> Progressive:
        """Begin anew, with another scene, view or settings if given; for a similar frame nothing is compiled."""
        self._scene, self._camera = scene or self._scene, camera or self._camera
        self._settings = dataclasses.replace(settings or self._settings, screen="quadtree")
        self._stage: _Stage | None = None
        return self

    def __iter__(self) -> Progressive:
        return self

    @at_once()
    def __next__(self) -> Image:
        if self._stage is None:
            stage = self._begun()
        elif self._stage.done:
            raise StopIteration
        else:
            stage = self._refined(self._stage, self._frame, self._run)
        image = self._image(stage)
        self._stage = stage
        return image

    def _begun(self) -> _Stage:
        """The coarse lattice of a new frame, after all that will be run has begun to be compiled."""
        run, asked = Eager(), Request.of(self._scene, self._camera, self._settings)
        plan, seen = PLANS.for_frame(asked, run)
        frame = Frame(seen, asked.camera, self._settings, plan, asked.scene.formulas, shards=plan.shards)

        def begin() -> tuple[Frame, _Stage]:
            ranked = frame.ranked(run)
            coarse = self._coarse(ranked, run)
            if run.foreseeing:
                finished(self._refined(coarse, ranked, run).canvas, ranked, run)
            return ranked, coarse

        self._run, self._asked = run, asked
        self._frame, coarse = run.foreseen(begin)
        return coarse

    def _coarse(self, frame: Frame, run: Eager) -> _Stage:
        canvas, grid = begun(frame, run)
        return _Stage(0, canvas, (grid,), (), *self._marked(canvas, (), frame, run))

    def _refined(self, stage: _Stage, frame: Frame, run: Eager) -> _Stage:
        """After another stage; before the first, bands are opened."""
        number, canvas, grids, bands, queues, _ = stage
        if not bands:
            for row in _first_rows(frame):
                canvas, decisions, grid = opened(canvas, frame, array_of(row, jnp.int32), run)
                grids, bands = (*grids, grid), (*bands, decisions)
            queues, _ = self._marked(canvas, bands, frame, run)
        for decisions, wanted in zip(bands, queues, strict=True):
            canvas = shot(canvas, frame, decisions, wanted, run)
        return _Stage(number + 1, canvas, grids, bands, *self._marked(canvas, bands, frame, run))

    def _marked(self, canvas: Canvas, bands: Bands, frame: Frame, run: Eager) -> tuple[Queues, Quality]:
        """Rays that the worst leaves want of bands that are known, and how good the canvas is said to be."""
        tolerance, plan = tolerance_of(frame), frame.plan
        inputs = canvas, tolerance, array_of(self._share, tolerance.dtype)
        static = {"lists": plan.lists, "sides": sizes_of(frame).sides, "number": self._worst, "tuning": plan.cast.tuning}
        return run.one("adapt", mark, inputs, first_rows=_first_rows(frame) if bands else (), **static)  # type: ignore[no-any-return]

    def _image(self, stage: _Stage) -> Image:
        """What it looks like."""
        layers = finished(stage.canvas, self._frame, self._run)
        drawn = Drawn.of(layers, stage.grids, self._frame.seen.viewed.faults)
        told: dict[str, Any] = {
            "stage": stage.number,
            "rays_left": int((~np.asarray(stage.canvas.known)).sum()),
            "l2_error": float(stage.quality.l2),
            "max_error": float(stage.quality.largest),
            "leaves_over": int(stage.quality.over),
        }
        return self._asked.in_given_unit(image_of(drawn, self._frame, self._run, **told))


class _Stage(NamedTuple):
    """What is known after a stage; no band is after that of the coarse lattice."""

    number: int
    canvas: Canvas
    grids: tuple[Counts, ...]
    bands: Bands
    queues: Queues
    quality: Quality

    @property
    def done(self) -> bool:
        """Whether there is nothing left to split."""
        return self.number > 0 and not float(self.quality.over) > 0


def _first_rows(frame: Frame) -> tuple[int, ...]:
    return tuple(nth * frame.plan.band_height for nth in range(frame.plan.bands))
