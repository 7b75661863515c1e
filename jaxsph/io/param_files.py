r"""Units of ChaNGa and Gasoline, which stand in a file of parameters beside their snapshots and not in these.

Flow: `run.param` -> [param_files] -> FileUnits of Tipsy and NChilada.

Lines are `key = value`, with comments from `#` on. `dKpcUnit` and `dMsolUnit` are the units of length and mass in kpc and solar
masses; the gravitational constant is 1, so that the unit of time is $\sqrt{L^3 / (G M)}$. Temperatures are in K. With `bComove`
positions and velocities are comoving, and the time of a snapshot is the scale factor. Source: the documentation of ChaNGa,
University of Washington N-Body Shop.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from .table import plain
from .units import LENGTH, TIME, CodeUnit, FileUnits

KPC = 3.0856775814913673e21
SOLAR_GRAVITY = 1.3271244e26
"""G times the mass of the Sun, cm^3 s^-2, which is known better than either."""
SOLAR_MASS = SOLAR_GRAVITY / 6.6743e-8
MIN_UNIT, MAX_UNIT = 1e-40, 1e40
"""Kpc and solar masses of a unit: beyond, densities leave the range of numbers."""
MAX_BYTES = 2**20
MAX_FILES = 256
LENGTHS = "hsmooth", "eps", "soft", "softening", "smoothlength"
DENSITIES = "rho", "den", "density", "gasdensity"
VELOCITIES = "velocity", "vel"
TEMPERATURES = "temp", "temperature"
POTENTIALS = "phi", "pot"
KELVIN, MASS = (0, 0, 0, 1), (0, 1, 0, 0)


def units_beside(path: Path, columns: Iterable[str], time: float) -> tuple[FileUnits, list[str]]:
    """Units of a snapshot's positions and columns as the file of parameters beside it has them, and sentences on that.

    The file is the one whose `achOutName` is the name of the snapshot, or the only one in the folder. Where there is none, or
    its units are no positive numbers, there are no units.
    """
    file, said = _chosen(path)
    if file is None:
        return FileUnits(), said
    keys = _keys(file)
    if keys is None:
        return FileUnits(), [f"units are not known: {file.name} cannot be read"]
    kpc, solar = (_number(keys.get(name)) for name in ("dKpcUnit", "dMsolUnit"))
    for name, value in (("dKpcUnit", kpc), ("dMsolUnit", solar)):
        if value is None or not MIN_UNIT <= value <= MAX_UNIT:
            stated = "is missing" if name not in keys else f"is {keys[name][:40]!r}"
            wanted = f"a number in {MIN_UNIT:g} .. {MAX_UNIT:g}"
            return FileUnits(), [f"units are not known: {name} of {file.name} {stated}, and must be {wanted}"]
    assert kpc is not None and solar is not None
    comoving = (_number(keys.get("bComove")) or 0) != 0
    said = [f"units of {file.name}: dKpcUnit = {kpc:g}, dMsolUnit = {solar:g}{', comoving' * comoving}"]
    if (_number(keys.get("bPeriodic")) or 0) != 0:
        period = keys.get("dPeriod", "1")[:40]
        said.append(f"{file.name} has bPeriodic, with a period of {period}: it is not used; pass `box=` for supports across it")
    return _units(kpc, solar, comoving, columns, time), said


def _units(kpc: float, solar: float, comoving: bool, columns: Iterable[str], time: float) -> FileUnits:
    length, mass = CodeUnit(kpc * KPC, LENGTH, float(comoving)), CodeUnit(solar * SOLAR_MASS, MASS)
    second = CodeUnit(math.sqrt((kpc * KPC) ** 3 / (solar * SOLAR_GRAVITY)), TIME)
    velocity = length.over(second)
    of = dict.fromkeys(LENGTHS, length) | dict.fromkeys(DENSITIES, mass.over(length, 3)) | dict.fromkeys(VELOCITIES, velocity)
    of |= dict.fromkeys(TEMPERATURES, CodeUnit(1.0, KELVIN)) | {"mass": mass}
    if not comoving:
        of |= dict.fromkeys(POTENTIALS, velocity.over(velocity, -1)) | {"tform": second}
    found = {name: of[plain(name)] for name in columns if plain(name) in of}
    if not comoving:
        return FileUnits(length, found, time if math.isfinite(time) else None, second)
    redshift = 1 / time - 1 if time > 0 else math.nan
    return FileUnits(length, found, redshift=redshift if math.isfinite(redshift) else None)


def _chosen(path: Path) -> tuple[Path | None, list[str]]:
    """The file of parameters of a snapshot, or why there is none."""
    path = path.absolute()
    try:
        files = sorted(file for file in path.parent.glob("*.param") if file.is_file())
    except OSError:
        return None, []
    if len(files) <= 1:
        return (files[0] if files else None), []
    own = [file for file in files[:MAX_FILES] if _is_of(path.name, (_keys(file) or {}).get("achOutName", ""))]
    if len(own) == 1:
        return own[0], []
    which = "none" if not own else f"{len(own)}"
    return None, [f"units are not known: there are {len(files)} .param files beside it, and {which} of them has it as achOutName"]


def _is_of(name: str, output: str) -> bool:
    """Whether a snapshot is of a run that writes files of this name, with numbers behind it."""
    own = PurePosixPath(output.strip("\"'")).name
    return bool(own) and (name == own or name.startswith(own + "."))


def _keys(file: Path) -> dict[str, str] | None:
    """Keys and values as they stand there; `None` where the file cannot be read, or is no file of parameters by its size."""
    with contextlib.suppress(OSError):
        if file.stat().st_size > MAX_BYTES:
            return None
        lines = file.read_bytes().decode("utf-8", "replace").splitlines()
        pairs = (line.split("#")[0].partition("=") for line in lines)
        return {key.strip(): value.strip() for key, equals, value in pairs if equals}
    return None


def _number(stated: str | None) -> float | None:
    try:
        value = float(stated or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None
