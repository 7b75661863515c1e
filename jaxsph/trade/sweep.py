"""Error against tolerance against time: one table of what every setting of a scene costs, and how wrong it is.

Flow: scene, camera -> plan, render -> [sweep] -> measurements -> files, figures.

Settings are timed in turns with full rate of the same frame, so that a busy machine is slow for all of them; compile time
and plans are apart.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import statistics
import time
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.engine.planning.fit import plan as make_plan
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.render import render
from jaxsph.model import Camera, Image, Scene, Settings
from jaxsph.numerics.checks import Progress, record_of
from jaxsph.trade.contenders import (
    BASELINES,
    FULL_RATE,
    TOLERANCES,
    Contender,
    IntegralAt,
    contenders,
    estimators_of,
    layers_of,
    scaled_up,
)
from jaxsph.trade.measurement import TABLE, Measurement, of_frame, of_this_run, write_table

STAGES = ("grid", "adapt", "cast", "image")

Plans = dict[Hashable, Plan]
"""By kind of contender: frames of a sequence share them, so that little is compiled for the later ones."""


@dataclasses.dataclass(frozen=True)
class Effort:
    """How much is done to measure: see `sweep`."""

    repeats: int = 3
    converged: int = 8
    integral: int = 1000

    def __post_init__(self) -> None:
        for name, least in (("repeats", 1), ("converged", 1), ("integral", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"`{name}` must be an integer of at least {least}, got {value!r}")


@dataclasses.dataclass(frozen=True)
class _Frame:
    """A frame, and what its measurements have in common."""

    scene: Scene
    camera: Camera
    shared: dict[str, Any]


def sweep(
    scene: Scene | Sequence[Scene],
    camera: Camera | Sequence[Camera],
    settings: Settings | None = None,
    *,
    tolerances: Sequence[float] = TOLERANCES,
    estimators: Sequence[str] | None = None,
    baselines: Sequence[str] = BASELINES,
    name: str = "scene",
    frames: Sequence[float] | None = None,
    folder: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
    **effort: int,
) -> list[Measurement]:
    """Measure error and time of every estimator at every tolerance, and of coarser sampling and smaller images.

    The error of a pixel is the largest difference of any colour channel or alpha: to the same frame at full rate, to an image
    of `converged` times the samples and, at `integral` random pixels, to the light integral. Times are medians over `repeats`
    turns; each group of settings (the baselines, an estimator) takes turns with full rate.

    Args:
        scene, camera: what to render, and from where; or as many of both as the sequence has frames.
        settings: of full rate, without tolerance, estimator and `relax`; default `Settings(integrator="samples")`.
        tolerances: each >= 0.
        estimators: of `"interval"`, `"interval relaxed"` (`relax` = 1, as Hochstetter et al. 2016 relax) and `"pilot"`, kept
            against full rate of point samples; and `"segments"`, against the light integral. Default all that suit `settings`; of
            scenes with a surface none, as that has no tolerance.
        baselines: `"samples/K"` and `"segments/K"`, uniform point samples or segments, K times fewer than full rate has;
            `"segments"` is `"segments/1"`; `"size/K"`, an image K times smaller each way, scaled up bilinearly.
        name: of the scene, for the table.
        frames: a number for each frame; default 0, 1, ... of a sequence.
        folder: where the table is kept, as `sweep.csv` (a row as soon as it is measured); made if need be. `None` keeps nothing.
        progress: called as `progress(done, total)` after every image.
        effort: `repeats` and `converged`, at least 1, default 3 and 8; and `integral`, at how many pixels to take the light
            integral (`jaxsph.reference.integral`, which knows no `media`), default 1000; 0: none.

    Returns:
        A row for every frame and setting, full rate first: a tidy table, `pandas.DataFrame(rows)` takes it.

    Raises:
        TypeError: an argument that there is not.
        ValueError: arguments out of range, scenes and cameras that do not pair, a folder that cannot be made.

    References:
        Hochstetter, Orthmann & Kolb 2016, section 7, tables 2 and 3, figures 11 and 12.
    """
    settings = settings or Settings(integrator="samples")
    if settings.tolerance is not None:
        raise ValueError(f"`settings.tolerance` must be None, got {settings.tolerance}; give `tolerances` instead")
    asked = record_of(Effort, effort, "sweep")
    views = _views(scene, camera, frames)
    groups = contenders(settings, tolerances, estimators_of((one for _, one, _ in views), estimators), baselines)
    groups = [group for group in groups if group]
    shared = {"scene": name} | dataclasses.asdict(asked) | of_this_run()
    each = [
        _Frame(one, view, shared | of_frame(one, view, settings, asked.converged) | {"frame": number})
        for number, one, view in views
    ]
    return _rows(each, groups, asked, folder, progress)


def _rows(
    frames: list[_Frame],
    groups: list[list[Contender]],
    effort: Effort,
    folder: str | os.PathLike[str] | None,
    progress: Progress | None,
) -> list[Measurement]:
    """The table; in a folder as far as it is measured."""
    path = None if folder is None else Path(folder) / TABLE
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"`folder` {path.parent} cannot be made ({error.strerror}); give another one") from error
    turns = [[one for one in group if one.method != FULL_RATE] for group in groups]
    images = 2 + bool(effort.integral) + sum(len(one) + effort.repeats * (1 + len(one)) for one in turns)
    plans: Plans = {}
    done = itertools.count(1)

    def tick() -> None:
        if progress is not None:
            progress(next(done), images * len(frames))

    rows: list[Measurement] = []
    for frame in frames:
        for row in _measure(frame, groups, plans, tick):
            rows.append(row)
            if path is not None:
                write_table(path, rows)
    return rows


def _views(
    scene: Scene | Sequence[Scene], camera: Camera | Sequence[Camera], frames: Sequence[float] | None
) -> list[tuple[float | None, Scene, Camera]]:
    scenes = [scene] if isinstance(scene, Scene) else list(scene)
    cameras = [camera] if isinstance(camera, Camera) else list(camera)
    if not scenes or len(scenes) != len(cameras):
        raise ValueError(f"`scene` and `camera` must pair, got {len(scenes)} and {len(cameras)}; give one camera a scene")
    if frames is None:
        if isinstance(scene, Scene):
            return [(None, scenes[0], cameras[0])]
        frames = range(len(scenes))
    if len(set(frames)) != len(scenes) or len(frames) != len(scenes):
        raise ValueError(f"`frames` must be {len(scenes)} different numbers, one a scene, got {list(frames)}")
    return [(float(number), one, view) for number, one, view in zip(frames, scenes, cameras, strict=True)]


def _measure(frame: _Frame, groups: list[list[Contender]], plans: Plans, tick: Callable[[], None]) -> Iterable[Measurement]:
    """Rows of a frame, as soon as each group has taken its turns."""
    full = groups[0][0]
    finer = dataclasses.replace(full.settings, samples=full.settings.samples * frame.shared["converged"])
    converged = _First.of(frame, Contender("converged", finer), plans).layers
    tick()
    of_full = _First.of(frame, full, plans)
    tick()
    integral = IntegralAt.of(frame.scene, frame.camera, frame.shared["integral"])
    if frame.shared["integral"]:
        tick()
    for group in groups:
        firsts = [of_full]
        for setting in group:
            if setting is not full:
                firsts.append(_First.of(frame, setting, plans))
                tick()
        times = _in_turns(frame, firsts, frame.shared["repeats"], tick)
        for first, turns in zip(firsts, times, strict=False):
            if first.setting in group:
                found = _compared(first, of_full, converged, integral) | _medians(turns)
                yield Measurement(**frame.shared, **found, full_total=_medians(times[0])["total"])


@dataclasses.dataclass(frozen=True)
class _First:
    """The first image of a setting, and the plan that its later ones use."""

    setting: Contender
    plan: Plan
    plan_seconds: float
    compile_seconds: float
    image: Image
    layers: Float[np.ndarray, "height width 4"]

    @classmethod
    def of(cls, frame: _Frame, setting: Contender, plans: Plans) -> _First:
        view, image, planned = (frame.scene, setting.camera(frame.camera), setting.settings), None, 0.0
        if setting.kind in plans:
            with contextlib.suppress(ValueError):  # the frame outgrew the plan; what else is wrong is so with a new one too
                image = render(*view, plan=plans[setting.kind])
        if image is None:
            started = time.perf_counter()
            plans[setting.kind] = make_plan(*view)
            planned = time.perf_counter() - started
            image = render(*view, plan=plans[setting.kind])
        compiled, layers = image.stats["seconds"]["compile"], scaled_up(layers_of(image), frame.camera)
        return cls(setting, plans[setting.kind], planned, compiled, image, layers)


def _in_turns(frame: _Frame, firsts: Sequence[_First], repeats: int, tick: Callable[[], None]) -> list[list[dict[str, float]]]:
    """Seconds by stage of every turn of every setting."""
    times: list[list[dict[str, float]]] = [[] for _ in firsts]
    for _ in range(repeats):
        for first, turns in zip(firsts, times, strict=True):
            camera = first.setting.camera(frame.camera)
            image = render(frame.scene, camera, first.setting.settings, plan=first.plan)
            seconds = {stage: image.stats["seconds"][stage] for stage in STAGES}
            if first.setting.shrink > 1:
                started = time.perf_counter()
                scaled_up(layers_of(image), frame.camera)
                seconds["image"] += time.perf_counter() - started
            turns.append(seconds)
            tick()
    return times


def _medians(turns: list[dict[str, float]]) -> dict[str, float]:
    sums = [sum(turn.values()) for turn in turns]
    total = statistics.median(sums)
    stages = {stage: statistics.median(turn[stage] for turn in turns) for stage in STAGES}
    return stages | {"total": total, "deviation": statistics.median(abs(one - total) for one in sums)}


def _compared(
    first: _First, full: _First, converged: Float[np.ndarray, "height width 4"], integral: IntegralAt | None
) -> dict[str, Any]:
    """How wrong an image is, how wrong it was said to be, and the work it took."""
    tolerance, bound = first.setting.tolerance, np.asarray(first.image.error_bound, np.float64)
    error, away = (np.abs(first.layers - other).max(-1) for other in (full.layers, converged))
    found: dict[str, Any] = {
        "method": first.setting.method,
        "tolerance": tolerance,
        "certified": bool(first.image.certified) and tolerance is not None,
        "max_error": float(error.max()),
        "mean_error": float(error.mean()),
        "max_error_converged": float(away.max()),
        "mean_error_converged": float(away.mean()),
        "max_bound": None if tolerance is None else float(bound.max()),
        "evaluations": first.image.stats["evaluations"],
        "evaluations_full": full.image.stats["evaluations"],
        "plan": first.plan_seconds,
        "compile": first.compile_seconds,
        "bytes": first.plan.bytes,
    }
    against_integral = first.setting.is_against_integral
    if integral is not None:
        exact = integral.errors(first.layers)
        far = {"mean": exact.mean(), "p999": np.quantile(exact, 0.999), "max": exact.max()}
        found |= {f"integral_{name}": float(value) for name, value in far.items()}
        error, bound = (exact, integral.at(bound)) if against_integral else (error, bound)
    known = tolerance is not None and not (against_integral and integral is None)
    over, beyond = (float((error > most).mean()) if known else None for most in (tolerance, bound))
    return found | {"over_tolerance": over, "over_bound": beyond}
