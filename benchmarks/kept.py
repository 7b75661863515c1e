"""Write what a benchmark measured: whole or not at all, with what it was measured on, when, and which variants it made."""

from __future__ import annotations

import json
import os
import pathlib
import subprocess
import time
from collections.abc import Iterable
from importlib.metadata import version
from typing import Any

import jax.numpy as jnp

from jaxsph.io.replace import written_whole
from jaxsph.trade.sweep import of_this_run

RESULTS = pathlib.Path(__file__).parent / "results"
BEGUN = {"date": time.strftime("%Y-%m-%d"), "load": [round(load, 1) for load in os.getloadavg()]}
CLOCK = time.perf_counter()


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(pathlib.Path(__file__).parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def commit_of_code() -> str:
    """Last commit; `-dirty` where the package or a benchmark is other than it was there.

    It is asked of git, as asking JAX for its devices here would settle them. Results that changed make no code dirty: one is
    written after the other.
    """
    changed = _git("diff", "--name-only", "HEAD", "--", "../jaxsph", "*.py")
    return _git("rev-parse", "--short", "HEAD") + ("-dirty" if changed else "")


COMMIT = commit_of_code()  # as the code is that runs, whatever is committed meanwhile


def of_run(*packages: str) -> dict[str, Any]:
    """Device, cores that may be used, commit, versions (of `packages` as well), date, load when it began, and seconds since."""
    versions = {package: version(package) for package in packages}
    run = of_this_run() | {"commit": COMMIT, "dtype": str(jnp.zeros(()).dtype)} | versions
    return run | BEGUN | {"seconds": round(time.perf_counter() - CLOCK)}


def keep(path: pathlib.Path, variants: Iterable[str], *, packages: Iterable[str] = (), **measured: Any) -> None:
    """Write `measured` as JSON, after `run` and the names of all variants that it has figures of."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(variants))
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps({"run": of_run(*packages), "variants": names, **measured}, indent=1) + "\n")
