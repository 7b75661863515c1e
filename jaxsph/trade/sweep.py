"""Error against tolerance against time: one table of what every setting of a scene costs, and how wrong it is.

Flow: settings -> contenders; scene, camera -> plan, render -> [sweep] -> rows -> sweep.csv, figures.

Settings are timed in turns with full rate of the same frame, so that a busy machine is slow for all of them; compile time
and plans are apart.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import itertools
import os
import platform
import re
import statistics
import subprocess
import time
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Float

from jaxsph.engine.planning.fit import plan as make_plan
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.render import render
from jaxsph.engine.runtime.tuning import cores_at_hand
from jaxsph.io.replace import digest_of, fingerprint, written_whole
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings, estimates
from jaxsph.numerics import __version__
from jaxsph.numerics.checks import Progress, record_of
from jaxsph.reference import integral as light_integral

TOLERANCES = (0.001, 0.004, 0.01)
ESTIMATORS: dict[str, dict[str, Any]] = {
    "interval": {"integrator": "samples", "estimator": "interval", "relax": 0.0},
    "interval relaxed": {"integrator": "samples", "estimator": "interval", "relax": 1.0},
    "pilot": {"integrator": "samples", "estimator": "pilot", "relax": 0.0},
    "segments": {"integrator": "segments", "relax": 0.0},
}
BASELINES = ("samples/2", "samples/4", "segments/1", "segments/4", "size/2", "size/4")
FULL_RATE = "full rate"
SEED = 0  # of the pixels that the light integral is taken at
TOLERANCE = 1e-6  # of the integral itself: far below any tolerance that images are asked for
Pixels = tuple[np.ndarray, np.ndarray]  # rows and columns
STAGES = ("grid", "adapt", "cast", "image")
TABLE = "sweep.csv"
"""Name in a sweep's folder."""
Row = dict[str, Any]
"""How wrong one setting was for one frame, and what it took: see `sweep`."""
IN_ORDER = """scene frame fingerprint particles width height samples method tolerance certified max_error mean_error
over_tolerance max_bound over_bound max_error_converged mean_error_converged converged integral_mean integral_p999 integral_max
integral evaluations evaluations_full plan compile grid adapt cast image total deviation full_total repeats bytes dtype device
cores jaxsph jax numpy python commit"""
COLUMNS = tuple(IN_ORDER.split())
"""Of a row. An error is the largest difference of any colour channel or alpha of a pixel; `max_` and `mean_` are over pixels.

`scene`, `frame`: what was rendered;
`repeats`, `converged`, `integral`: as given;
`device`, `cores`, `commit`, `jaxsph`, `jax`, `numpy`, `python`, `dtype`: of the run; `commit` is None outside a checkout;
`width`, `height`, `samples`, `particles`: size of the frame at full rate, which all settings are compared with;
`fingerprint`: digest of particles, transfer function, camera and settings;
`method`: `"full rate"`, an estimator, `"samples/K"`, `"segments/K"` or `"size/K"`;
`tolerance`: what error control was asked for; None without. Segments keep it against the light integral, others against
full rate;
`certified`: whether `max_bound` is proven;
`max_error`, `mean_error`: against full rate; `max_error_converged`, `mean_error_converged`: against that image;
`max_bound`: largest `error_bound`; None without error control;
`over_tolerance`, `over_bound`: share of pixels whose error is over it; None without one. Of segments, the share of those
pixels that the integral was taken at, None if there are none;
`integral_mean`, `integral_p999`, `integral_max`: mean, 99.9 % quantile and largest of the errors to the light integral;
None where it was not taken, or the scene holds media that it does not know;
`evaluations`, `evaluations_full`: kernel evaluations, and those of full rate;
`plan`, `compile`: seconds to make the plan, 0 where an earlier one serves, and to compile what was not compiled before;
`bytes`: working memory that the plan estimates;
`grid`, `adapt`, `cast`, `image`: median seconds of the stages; `image` joins bands, and scales up where `size/K` asks it;
`total`, `deviation`: median of their sum, and median deviation of that sum from it, seconds;
`full_total`: median seconds of full rate in the same turns.
"""
Frame = tuple[Scene, Camera, Row]
"""What is rendered, and what its rows have in common."""

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
) -> list[Row]:
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
        A row for every frame and setting, full rate first: a tidy table, `pandas.DataFrame(rows)` takes it. Its columns are
        `jaxsph.trade.sweep.COLUMNS`, which says what each is.

    Raises:
        TypeError: an argument that there is not.
        ValueError: arguments out of range, scenes and cameras that do not pair, a folder that cannot be made.

    References:
        Hochstetter, Orthmann & Kolb 2016, section 7, tables 2 and 3, figures 11 and 12.
    """
    settings = settings or Settings(integrator="samples")
    if settings.tolerance is not None:
        raise ValueError(f"`settings.tolerance` must be None, got {settings.tolerance}; give `tolerances` instead")
    asked = record_of(Effort, effort, sweep)
    views = _views(scene, camera, frames)
    groups = contenders(settings, tolerances, estimators_of((one for _, one, _ in views), estimators), baselines)
    groups = [group for group in groups if group]
    shared = {"scene": name} | dataclasses.asdict(asked) | of_this_run()
    frames_of = [
        (one, view, shared | {"frame": number} | of_frame(one, view, settings, asked.converged)) for number, one, view in views
    ]
    return _rows(frames_of, groups, asked, folder, progress)


def _rows(
    frames: list[Frame],
    groups: list[list[Contender]],
    effort: Effort,
    folder: str | os.PathLike[str] | None,
    progress: Progress | None,
) -> list[Row]:
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

    rows: list[Row] = []
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


def _measure(frame: Frame, groups: list[list[Contender]], plans: Plans, tick: Callable[[], None]) -> Iterable[Row]:
    """Rows of a frame, as soon as each group has taken its turns."""
    scene, camera, shared = frame
    full = groups[0][0]
    finest = Contender("converged", dataclasses.replace(full.settings, samples=full.settings.samples * shared["converged"]))
    converged, of_full = (_First.of(scene, camera, setting, plans, tick) for setting in (finest, full))
    integral = integral_at(scene, camera, shared["integral"])
    if shared["integral"]:
        tick()
    for group in groups:
        firsts = [of_full, *(_First.of(scene, camera, setting, plans, tick) for setting in group if setting is not full)]
        times = _in_turns(scene, camera, firsts, shared["repeats"], tick)
        for one, turns in zip(firsts, times, strict=True):
            if one.setting in group:
                found = _compared(one, of_full, converged.layers, integral) | _medians(turns)
                row = shared | found | {"full_total": _medians(times[0])["total"]}
                yield {column: row[column] for column in COLUMNS}


class _First(NamedTuple):
    """The first image of a setting, and the plan that its later ones use."""

    setting: Contender
    plan: Plan
    plan_seconds: float
    image: Image
    layers: Float[np.ndarray, "height width 4"]

    @classmethod
    def of(cls, scene: Scene, camera: Camera, setting: Contender, plans: Plans, tick: Callable[[], None]) -> _First:
        """Render it, by the plan of an earlier frame where that serves."""
        view, image, planned = (scene, setting.camera(camera), setting.settings), None, 0.0
        if setting.kind in plans:
            with contextlib.suppress(ValueError):  # the frame outgrew the plan; what else is wrong is so with a new one too
                image = render(*view, plan=plans[setting.kind])
        if image is None:
            started = time.perf_counter()
            plans[setting.kind] = make_plan(*view)
            planned = time.perf_counter() - started
            image = render(*view, plan=plans[setting.kind])
        tick()
        return cls(setting, plans[setting.kind], planned, image, scaled_up(layers_of(image), camera))


def _in_turns(
    scene: Scene, camera: Camera, firsts: Sequence[_First], repeats: int, tick: Callable[[], None]
) -> list[list[dict[str, float]]]:
    """Seconds by stage of every turn of every setting."""
    times: list[list[dict[str, float]]] = [[] for _ in firsts]
    for _ in range(repeats):
        for first, turns in zip(firsts, times, strict=True):
            image = render(scene, first.setting.camera(camera), first.setting.settings, plan=first.plan)
            seconds = {stage: image.stats["seconds"][stage] for stage in STAGES}
            if first.setting.shrink > 1:
                started = time.perf_counter()
                scaled_up(layers_of(image), camera)
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
    first: _First,
    full: _First,
    converged: Float[np.ndarray, "height width 4"],
    integral: tuple[Pixels, Float[np.ndarray, "pixels 4"]] | None,
) -> Row:
    """How wrong an image is, how wrong it was said to be, and the work it took."""
    tolerance, bound = first.setting.tolerance, np.asarray(first.image.error_bound, np.float64)
    error, away = (np.abs(first.layers - other).max(-1) for other in (full.layers, converged))
    found: Row = {"method": first.setting.method, "tolerance": tolerance}
    found["certified"] = bool(first.image.certified) and tolerance is not None
    for behind, errors in (("", error), ("_converged", away)):
        found |= {f"max_error{behind}": float(errors.max()), f"mean_error{behind}": float(errors.mean())}
    found["max_bound"] = None if tolerance is None else float(bound.max())
    against_integral, far = first.setting.is_against_integral, dict.fromkeys(("mean", "p999", "max"))
    if integral is not None:
        pixels, light = integral
        exact = np.abs(first.layers[pixels] - light).max(-1)
        far = {"mean": float(exact.mean()), "p999": float(np.quantile(exact, 0.999)), "max": float(exact.max())}
        error, bound = (exact, bound[pixels]) if against_integral else (error, bound)
    known = tolerance is not None and not (against_integral and integral is None)
    for name, most in (("tolerance", tolerance), ("bound", bound)):
        found[f"over_{name}"] = float((error > most).mean()) if known else None
    found |= {f"integral_{name}": value for name, value in far.items()}
    found |= {"evaluations": first.image.stats["evaluations"], "evaluations_full": full.image.stats["evaluations"]}
    return found | {"plan": first.plan_seconds, "compile": first.image.stats["seconds"]["compile"], "bytes": first.plan.bytes}


def of_frame(scene: Scene, camera: Camera, settings: Settings, converged: int) -> Row:
    """Size of a frame at full rate, and a digest of all that its image depends on."""
    particles = scene.particle_set
    size = {"width": camera.width, "height": camera.height, "samples": settings.samples}
    count = {"particles": particles.num_particles, "dtype": str(particles.dtype)}
    return size | count | {"fingerprint": fingerprint("m", settings, converged, digest_of((scene, camera)))}


def of_this_run() -> Row:
    """Machine and versions."""
    versions = {"jaxsph": __version__, "jax": jax.__version__, "numpy": np.__version__, "python": platform.python_version()}
    return {"device": jax.devices()[0].device_kind, "cores": cores_at_hand(), "commit": _commit()} | versions


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


def write_table(path: str | Path, rows: Sequence[Row]) -> None:
    """Write comma-separated values with a header, whole or not at all; None is an empty cell."""
    with written_whole(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


@dataclasses.dataclass(frozen=True)
class Contender:
    """Settings to render with, at a size divided by `shrink` each way, to be scaled up again."""

    method: str
    settings: Settings
    shrink: int = 1

    @property
    def tolerance(self) -> float | None:
        """What error control is asked for."""
        return self.settings.tolerance

    @property
    def is_against_integral(self) -> bool:
        """Whether its tolerance is kept against the light integral, not against full rate."""
        return self.tolerance is not None and estimates(self.settings.integrator_used)

    @property
    def kind(self) -> Hashable:
        """What fixes its plan besides the frame: all but the numbers that a plan does not depend on."""
        tolerance = None if self.tolerance is None else 0.0
        return dataclasses.replace(self.settings, tolerance=tolerance, relax=0.0), self.shrink

    def camera(self, camera: Camera) -> Camera:
        """`camera`, for the image that is rendered."""
        if self.shrink == 1:
            return camera
        width, height = (-(-size // self.shrink) for size in (camera.width, camera.height))
        return dataclasses.replace(camera, width=width, height=height)


def suitable(settings: Settings) -> tuple[str, ...]:
    """Estimators that keep a tolerance against full rate of those settings, or against the light integral."""
    own = settings.integrator_used
    return tuple(name for name, it in ESTIMATORS.items() if it["integrator"] == own or estimates(it["integrator"]))


def estimators_of(scenes: Iterable[Scene], estimators: Sequence[str] | None) -> Sequence[str] | None:
    """Those that are asked for; of scenes with a surface none."""
    if all(scene.surface is None for scene in scenes):
        return estimators
    if estimators:
        raise ValueError(
            f"`estimators` must be (), got {estimators!r}: a surface of particles has no tolerance; leave the surface out, or "
            "compare `baselines` alone"
        )
    return ()


def contenders(
    settings: Settings, tolerances: Sequence[float], estimators: Sequence[str] | None, baselines: Sequence[str]
) -> list[list[Contender]]:
    """Settings that take turns: full rate and baselines, then each estimator with all of its tolerances."""
    estimators = suitable(settings) if estimators is None else estimators
    for name in estimators:
        if name not in ESTIMATORS:
            raise ValueError(f"`estimators` must be of {', '.join(map(repr, ESTIMATORS))}, got {name!r}")
        if name not in suitable(settings):
            raise ValueError(
                f"`estimators` holds {name!r}, which keeps a tolerance against full rate of point samples, and full rate has "
                f"`integrator={settings.integrator_used!r}`; leave it out, or give `integrator='samples'`"
            )
    groups = [[Contender(FULL_RATE, settings), *dict.fromkeys(baseline(settings, name) for name in baselines)]]
    for name in dict.fromkeys(estimators):
        chosen = [dataclasses.replace(settings, **ESTIMATORS[name], tolerance=float(t)) for t in dict.fromkeys(tolerances)]
        groups.append([Contender(name, one) for one in chosen])
    return groups


def baseline(settings: Settings, name: str) -> Contender:
    """Uniform sampling with K times fewer points or segments, or a smaller image: `"samples/K"`, `"segments/K"` or `"size/K"`."""
    name = "segments/1" if name == "segments" else name
    matched = re.fullmatch(r"(samples|segments|size)/([1-9]\d{0,5})", name)
    if matched is None:
        raise ValueError(f"`baselines` must be like 'samples/2', 'segments', 'segments/2' or 'size/4', got {name!r}")
    factor = int(matched[2])
    if matched[1] == "size":
        return Contender(name, settings, factor)
    return Contender(name, dataclasses.replace(settings, integrator=matched[1], samples=-(-settings.samples // factor)))


def scaled_up(layers: Float[np.ndarray, "rows columns 4"], camera: Camera) -> Float[np.ndarray, "height width 4"]:
    """What an image of fewer pixels shows along the rays of `camera`, bilinearly; the same image where the sizes agree."""
    rows, columns = layers.shape[:2]
    if (rows, columns) == (camera.height, camera.width):
        return layers
    down = (np.arange(camera.height) + 0.5) / camera.height * 2 - 1
    across = ((np.arange(camera.width) + 0.5) / camera.width * 2 - 1) * (camera.width / camera.height) / (columns / rows)
    place = np.meshgrid((down + 1) / 2 * rows - 0.5, (across + 1) / 2 * columns - 0.5, indexing="ij")
    return np.stack(
        [scipy.ndimage.map_coordinates(layer, place, order=1, mode="nearest") for layer in np.moveaxis(layers, -1, 0)], -1
    )


def integral_at(scene: Scene, camera: Camera, count: int) -> tuple[Pixels, Float[np.ndarray, "pixels 4"]] | None:
    """Rows and columns of so many pixels, always the same of one size, and the light integral there: colour and alpha, float64.

    None of no pixels, or of `media` or a surface, which are unknown to it.
    """
    if not count or scene.media or scene.surface is not None:
        return None
    number = camera.width * camera.height
    chosen = np.random.default_rng(SEED).choice(number, min(count, number), replace=False)
    pixels = chosen // camera.width, chosen % camera.width
    return pixels, layers_of(light_integral(scene, camera, pixels=pixels, tolerance=TOLERANCE))


def layers_of(image: Image) -> Float[np.ndarray, "... 4"]:
    """Colour and alpha, float64."""
    alpha = 1 - np.asarray(image.transmittance, np.float64)
    return np.concatenate([np.asarray(image.color, np.float64), alpha[..., None]], -1)
