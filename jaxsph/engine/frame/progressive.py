"""A picture at once, and better ones after it: until the tolerance is met, or every pixel has its ray.

Flow: scene, camera, settings -> plan -> coarse lattice -> [progressive: mark -> cast -> image], again and again.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.images import image_of
from jaxsph.engine.frame.layers import Drawn
from jaxsph.engine.frame.refinement import Decisions, Refinement, counted
from jaxsph.engine.planning.fit import PLANS
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.executors import Clock, Executor, Forecast
from jaxsph.engine.runtime.tuning import shards_at_hand
from jaxsph.engine.screen.canvas import Canvas
from jaxsph.engine.screen.marking import Quality
from jaxsph.engine.screen.packets import Queue
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics import faults
from jaxsph.numerics.checks import is_traced

SHARE = 0.5  # of the squared error, what the leaves hold that a stage splits


def progressive(
    scene: Scene, camera: Camera, settings: Settings | None = None, *, worst: int | None = None, share: float = SHARE
) -> Progressive:
    """Render in stages: `for image in jaxsph.progressive(scene, camera, settings): ...`

    The first image is interpolated between the rays of a coarse lattice; each stage splits the leaves of a quadtree that are
    estimated to be worst, casts the rays that are new, and yields a better image (Kratz et al. 2011, section 5). It ends when no
    leaf is expected to be over `settings.tolerance`, or without one when every pixel has a ray that is not certain to be empty.

    Args:
        scene, camera, settings: as for `jaxsph.render`; `settings.leaf_pixels` and `leaf_estimator` choose the first leaves and
            by what leaves are judged; `settings.screen` is taken to be `"quadtree"`.
        worst: leaves that a stage splits, m of the paper; all with an error as large as the last of them.
        share: if `worst` is not given, each stage splits as few leaves as hold this share in (0, 1] of the sum of all squared
            errors.

    Returns:
        An iterator of images that can be left and gone on with at any time, and begun anew: see `Progressive`.

    Raises:
        ValueError: for a `worst` < 1, a `share` outside (0, 1], traced arguments, and what `jaxsph.render` raises it for.
    """
    if is_traced(scene, camera, settings):
        raise ValueError("`progressive` shows images as they come and needs concrete arrays; call `jaxsph.render` under jit")
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
        self._scene, self._camera, self._settings = scene, camera, _with_quadtree(settings)
        self._worst, self._share = worst, share
        self._state: _State | None = None

    def restart(self, scene: Scene | None = None, camera: Camera | None = None, settings: Settings | None = None) -> Progressive:
        """Begin anew, with another scene, view or settings if given; for a similar frame nothing is compiled."""
        self._scene, self._camera = scene or self._scene, camera or self._camera
        self._settings = self._settings if settings is None else _with_quadtree(settings)
        self._state = None
        return self

    def __iter__(self) -> Progressive:
        return self

    def __next__(self) -> Image:
        if self._state is None:
            self._state = _begun(self._scene, self._camera, self._settings, self._worst)
        elif self._state.done:
            raise StopIteration
        else:
            self._state = self._state.refined(self._worst, self._share)
        return self._state.image(self._settings)


class _Band(NamedTuple):
    """What is known of a band, and the rays that its leaves want next."""

    decisions: Decisions
    scattered: Queue
    whole: Queue


@dataclasses.dataclass(frozen=True)
class _State:
    """What is known after a stage; no band is before the first. Of `grids` there are faults and counts, and no layers."""

    filling: Refinement
    clock: Clock
    grids: Drawn
    canvas: Canvas
    quality: Quality
    bands: tuple[_Band, ...]
    stage: int

    @property
    def done(self) -> bool:
        """Whether there is nothing left to split."""
        return self.stage > 0 and not float(self.quality.over) > 0

    def refined(self, worst: int | None, share: float) -> _State:
        """After another stage."""
        state = self if self.bands else self._opened(worst, share)
        canvas = state.canvas
        for band in state.bands:
            canvas = self.filling.shot(canvas, *band)
        state = dataclasses.replace(state, stage=self.stage + 1)
        return state._marked(canvas, [band.decisions for band in state.bands], worst, share)

    def _opened(self, worst: int | None, share: float) -> _State:
        """With all bands known, and what their leaves want."""
        made = [self.filling.decided(row) for row in self._rows]
        of_bands = Drawn.of(None, [counted(grid) for _, grid in made], self.grids.faults)
        faults.raise_for(of_bands.faults, True)
        grids = of_bands._replace(filled=self.grids.filled + of_bands.filled, pairs=self.grids.pairs + of_bands.pairs)
        return dataclasses.replace(self, grids=grids)._marked(self.canvas, [one for one, _ in made], worst, share)

    def _marked(self, canvas: Canvas, decisions: list[Decisions], worst: int | None, share: float) -> _State:
        bands, quality = [], self.quality
        for row, one in zip(self._rows, decisions, strict=True):
            canvas, scattered, whole, quality = self.filling.marked(canvas, one, row, worst, share)
            bands.append(_Band(one, scattered, whole))
        return dataclasses.replace(self, canvas=canvas, quality=quality, bands=tuple(bands))

    @property
    def _rows(self) -> list[Any]:
        plan = self.filling.frame.plan
        return [jnp.int32(nth * plan.band_height) for nth in range(plan.bands)]

    def image(self, settings: Settings) -> Image:
        """What it looks like."""
        layers = self.filling.finished(self.canvas, [band.decisions for band in self.bands])
        plan = self.filling.frame.plan
        told: dict[str, Any] = {
            "stage": self.stage,
            "rays": int(self.canvas.rays),
            "rays_left": int((~self.canvas.known).sum()),
            "l2_error": float(self.quality.l2),
            "max_error": float(self.quality.largest),
            "leaves_over": int(self.quality.over),
        }
        drawn = self.grids._replace(layers=layers)
        return image_of(drawn, self.filling.frame.camera, settings, plan, self.clock, **told)


def _with_quadtree(settings: Settings) -> Settings:
    return dataclasses.replace(settings, screen="quadtree")


def _begun(scene: Scene, camera: Camera, settings: Settings, worst: int | None) -> _State:
    clock, asked = Clock(), Request.of(scene, camera, settings)
    plan, seen = PLANS.for_frame(asked, clock)
    shards = shards_at_hand(plan.cast.tuning)

    def filling(run: Executor) -> Refinement:
        frame = Frame.begun(seen, camera, settings, plan, asked.scene.formulas, shards, run)
        return Refinement.of(frame, run)

    clock.foresee(lambda known: _rehearse(filling(Forecast(known)), worst))
    begun = filling(clock)
    canvas, made = begun.begun()
    grids = Drawn.of(None, [counted(made)], seen.viewed.faults)
    faults.raise_for(grids.faults, True)
    return _State(begun, clock, grids, canvas, begun.judged(canvas), (), 0)


def _rehearse(filling: Refinement, worst: int | None) -> None:
    """All that will be run, once."""
    canvas, _ = filling.begun()
    filling.judged(canvas)
    filling.finished(canvas, [])
    decisions, _ = filling.decided(jnp.int32(0))
    canvas, scattered, whole, _ = filling.marked(canvas, decisions, jnp.int32(0), worst, SHARE)
    filling.shot(canvas, decisions, scattered, whole)
    filling.finished(canvas, [decisions] * filling.frame.plan.bands)
