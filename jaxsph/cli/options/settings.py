"""Settings, devices and names of files from the options of a command.

Flow: options -> [settings] -> Settings, devices, names -> commands.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from jaxsph.cli.console import UsageError, wrong_usage
from jaxsph.engine.runtime.executors import chosen_devices
from jaxsph.model import Settings, registry

SCENE = "scene:"
"""What the name of a built-in scene begins with."""
DRAFT = 4
"""Samples of a picture over those of a draft."""
SETTINGS = ("samples", "integrator", "tolerance", "estimator", "relax", "screen")


def settings_of(options: Any) -> Settings:
    """Settings from the options given; what `Settings` refuses is wrong usage."""
    given = {name: getattr(options, name, None) for name in SETTINGS}
    if getattr(options, "draft", False):
        if options.samples is not None:
            raise UsageError("--draft and --samples exclude each other: one says how many samples, the other leaves it open")
        given["samples"] = max(1, Settings().samples // DRAFT)
    if getattr(options, "progressive", False):  # its stages are of a quadtree
        given["screen"] = "quadtree"
    given["memory_limit"] = None if options.memory is None else int(options.memory * 2**30)
    with wrong_usage():
        return Settings(**{name: value for name, value in given.items() if value is not None})


def as_medium(options: Any, settings: Settings) -> Any:
    """Options that choose no surface for liquids where a tolerance is to be kept or media are asked at points: it has neither.

    Raises `UsageError`: a surface is asked for as well.
    """
    asks_points = registry.integrator_class(settings.integrator_used).asks_points
    if settings.tolerance is None and not asks_points:
        return options
    of_screen = settings.screen != "pixels"
    if options.surface not in (None, False) and (asks_points or not of_screen):
        other = f"--integrator {settings.integrator_used}" if asks_points else "--tolerance"
        raise UsageError(f"--surface and {other} exclude each other: {other[2:].split()[0]} is of media; leave one of them out")
    return dataclasses.replace(options, surface=False) if options.surface is None else options


def devices_of(options: Any) -> str | int | None:
    """The devices that are asked for, if this machine has them."""
    wanted: str | int | None = options.devices
    if wanted is not None:
        if options.progressive:
            raise UsageError("--devices is not for --progressive, whose stages go by one device; leave out one of them")
        with wrong_usage("--devices: "):
            chosen_devices(wanted)
    return wanted


def stem_of(source: str) -> str:
    """The name of a picture: that of its source, without a suffix; a number behind a point is none, as in `snap.00001`."""
    if source.startswith(SCENE):
        return source.split(":")[1]
    path = Path(source)
    return path.name if path.suffix[1:].isdecimal() else path.stem
