"""Particles as a file holds them: host side arrays under the names, and in the units, that the file gave them.

Flow: file -> reader -> [ParticleTable] -> quantity, supports, volumes -> Particles.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.io.damage import DataError
from jaxsph.io.parsing import gather_vectors
from jaxsph.model.camera.directions import UP
from jaxsph.model.particles.flat import dimensions_of
from jaxsph.model.particles.kernels import by_name

POSITION_NAMES = ("position", "positions", "pos", "coordinates", "coords", "points", "xyz")
SUPPORT_NAMES = ("support", "support_radius")
VOLUME_NAMES = ("volume",)
GEOMETRY = (*SUPPORT_NAMES, *VOLUME_NAMES)
ROLES: dict[str, tuple[str, ...]] = {
    "density": ("density", "densities", "rho", "rhop", "gas_density", "den"),
    "mass": ("mass", "masses", "particle_mass", "m", "dynamical_masses"),
    "velocity": ("velocity", "velocities", "vel", "vxyz", "v"),
    "temperature": ("temperature", "temperatures", "temp"),
    "internal_energy": ("internal_energy", "internal_energies", "u", "int_energy"),
}  # what codes call the same thing
SMOOTHING_NAMES = ("h", "hsml", "smoothing_length", "smoothinglength")
HEAPED, EVEN = 0.1, 0.05  # of an extent, how far below its middle the mean of moving liquids lies (0.15 to 0.45); across (0.005)
LENGTH, MASS, TIME, TEMPERATURE = (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)
VELOCITY = (1, 0, -1, 0)  # these are powers of cm, g, s and K
MAX_COMPONENTS = 2**16  # numbers of one column a particle: beyond, the names of its components alone would fill the memory


def plain(name: str) -> str:
    """`name` in lower case with letters and digits only, so that `Points:0` and `points_0` compare equal."""
    return "".join(c for c in name.lower() if c.isalnum())


def has_role(name: str, role: str) -> bool:
    """Whether codes call what has this role so, but for case and punctuation."""
    return plain(name) in map(plain, ROLES[role])


def synonyms(name: str) -> tuple[str, ...]:
    """All names that codes have for what has this name; none where they do not differ."""
    return next((names for role, names in ROLES.items() if has_role(name, role)), ())


def called(held: Iterable[str], names: Iterable[str]) -> str | None:
    """Of the names that are `held`, that of the first of `names` that is there, but for case and punctuation; or `None`."""
    own = {plain(name): name for name in reversed(list(held))}
    return next((own[plain(name)] for name in names if plain(name) in own), None)


@dataclasses.dataclass(frozen=True)
class CodeUnit:
    """What 1 in a file is in CGS units: `cgs` times cm, g, s and K to these powers, times powers of a and h that are left in.

    Attributes:
        cgs: > 0.
        powers: of cm, g, s and K.
        a, h: of the scale factor and the Hubble parameter, by which numbers are to be multiplied to become physical.
    """

    cgs: float
    powers: tuple[float, float, float, float]
    a: float = 0.0
    h: float = 0.0

    def over(self, other: CodeUnit, times: float = 1) -> CodeUnit:
        """This one, divided by another to a power."""
        powers = tuple(own - times * its for own, its in zip(self.powers, other.powers, strict=True))
        return CodeUnit(self.cgs / other.cgs**times, powers, self.a - times * other.a, self.h - times * other.h)  # type: ignore[arg-type]


PURE = CodeUnit(1.0, (0, 0, 0, 0))  # of numbers without a unit


@dataclasses.dataclass(frozen=True)
class FileUnits:
    """Units of a file, as far as it states them, and its moment."""

    length: CodeUnit | None = None  # of positions
    columns: Mapping[str, CodeUnit] = dataclasses.field(default_factory=dict)  # by the columns' names
    time: float | None = None  # the moment, as stored
    time_unit: CodeUnit | None = None
    redshift: float | None = None  # of a cosmological run
    hubble: float | None = None  # h of such a run, in 100 km/s/Mpc
    gas: Mapping[str, float] = dataclasses.field(default_factory=dict)  # its gamma, mass fraction of hydrogen, and mu, if stated

    def physical(self, unit: CodeUnit) -> float:
        """What 1 in a unit is in CGS at the moment of the file, without a and h."""
        return unit.cgs * (1 / (1 + (self.redshift or 0))) ** unit.a * (self.hubble or 1) ** unit.h


@dataclasses.dataclass(frozen=True, eq=False)
class ParticleTable:
    """What a particle file holds, in NumPy arrays of native byte order.

    Attributes:
        position: (N, 3), float32 or float64 as stored, in the file's length unit; nothing is subtracted.
        columns: the other data by the name the file gives them: (N,) scalars or (N, k) vectors. They may hold NaN.
        support: (N,) support radius $H > 0$ where the file defines one, or `None`. Length units of `position`.
        volume: (N,) particle volume $V > 0$ where the file defines one, or `None`; of particles in a plane areas.
        box_size: edge lengths of a periodic box whose lower corner is the origin, or `None`.
        time: of the snapshot as the file says it, in the unit of its code (a scale factor where that is the code's time), or
            `None`.
        source: name of the file format.
        path: the file, for messages; empty when the table was made in memory.
        conventions: sentences which say how supports and volumes were got, and what was left out.
        units: of positions and columns, and the moment, as far as the file states them.
        part_type: number of the type of particles that was read, where the format has types.
        stands_for: how many particles each one stands for, of a share that is drawn at random: columns are its own; supports and
            volumes, and what is summed of masses and numbers, are those of as many.
        num_files: how many files the snapshot has, of which this may be one.
        unusable: why supports that the file has cannot be used, where that is so: what needs none can be read all the same.
        announced: how many particles of that type the whole snapshot has, as the file says, which counts up to 2^32.
        kernel: name of the smoothing kernel that the file states, or that its code has unless told otherwise; `None` where the
            format says nothing of kernels.
        sight: of whoever looks at it, the eye, or the direction that parallel rays have, and whether it is an eye; and the
            lower corner of the period that is seen, where that is moved; `None` where nobody does. Vectors have a `los` then.
        center: (3,) from where radii and radial components are; or a function that gives it; `None` for the centre of mass.
        spanned: dimensions of all particles, of a table of some of them; `None` where these are all.

    Raises:
        ValueError: positions of another shape than (N, 3) or not finite; columns of another length;
            supports or volumes that are not finite and positive. Empty sets are allowed.
    """

    position: Float[np.ndarray, "particles 3"]
    columns: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    support: Float[np.ndarray, " particles"] | None = None
    volume: Float[np.ndarray, " particles"] | None = None
    box_size: tuple[float, float, float] | None = None
    source: str = "memory"
    path: str = ""
    conventions: tuple[str, ...] = ()
    units: FileUnits = FileUnits()
    _: dataclasses.KW_ONLY
    time: float | None = None
    part_type: int | None = None
    stands_for: float = 1.0
    num_files: int = 1
    unusable: str | None = None
    announced: int | None = None
    kernel: str | None = None
    sight: tuple[Any, ...] | None = None
    center: Any = None
    spanned: int | None = None

    def __post_init__(self) -> None:
        if self.kernel is not None:
            by_name(self.kernel)
        position = native(np.asarray(self.position))
        if position.ndim != 2 or position.shape[1] != 3:
            raise DataError(f"positions must have shape (N, 3), got {position.shape}; three coordinates a particle")
        if position.dtype not in (np.float32, np.float64):
            position = position.astype(np.float64)
        remedy = "remove these particles, or write the file again"
        refuse_rows(~np.isfinite(position), position, "positions must be finite", remedy, each="")
        columns = {str(name): _column(str(name), column, len(position)) for name, column in self.columns.items()}
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "columns", columns)
        for name in ("support", "volume"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, _positive(name, value, len(position)))

    def __len__(self) -> int:
        return len(self.position)

    @property
    def dimensions(self) -> int:
        """In how many dimensions the particles lie that it was made of: 2 in a plane, 1 on a line."""
        return self.spanned or dimensions_of(self.position, self.box_size)[0]

    def rows(self, which: slice | np.ndarray) -> ParticleTable:
        """Some of the particles."""
        columns = {name: column[which] for name, column in self.columns.items()}
        support, volume = (None if column is None else column[which] for column in (self.support, self.volume))
        some: dict[str, Any] = {"position": self.position[which], "columns": columns, "support": support, "volume": volume}
        return dataclasses.replace(self, **some, spanned=self.dimensions)

    @property
    def up(self) -> tuple[float, float, float]:
        """Which way is up: z in files of codes that have it so, as Phantom and DualSPHysics do, or where particles without types
        lie at the low end of z, as liquids do, and evenly along y; else y.
        """
        z = self.source.startswith("Phantom") or self.named("Rhop") is not None
        if not z and len(self) and self.part_type is None:
            low, high = self.position.min(0), self.position.max(0)
            _, across, below = (low + high) / 2 - self.position.mean(0, dtype=np.float64)
            z = bool(below > HEAPED * (high - low)[2] and abs(across) < EVEN * (high - low)[1])
        return (0.0, 0.0, 1.0) if z else UP

    @property
    def scalars(self) -> tuple[str, ...]:
        """Names of the (N,) columns."""
        return tuple(name for name, column in self.columns.items() if column.ndim == 1)

    @property
    def vectors(self) -> tuple[str, ...]:
        """Names of the (N, k) columns."""
        return tuple(name for name, column in self.columns.items() if column.ndim == 2)

    @property
    def fluid(self) -> str | None:
        """The condition on what is fluid, where a file of DualSPHysics holds boundaries, too; None shows all particles."""
        kind, marker = self.named("Type"), self.named("Mk")
        for name, said, fluid in ((kind, "== 3", lambda of: of == 3), (marker, "<= 10", lambda of: of <= 10)):
            if self.named("Rhop") is not None and name is not None and self.columns[name].ndim == 1:
                return f"{name} {said}" if 0 < fluid(self.columns[name]).sum() < len(self) else None
        return None

    def named(self, *names: str) -> str | None:
        """The first column whose name is one of `names` but for case and punctuation, or `None`."""
        return called(self.columns, names)

    def of_role(self, role: str) -> str | None:
        """The first column that has a role, such as `"mass"`, or `None`."""
        return self.named(*ROLES[role])

    def exact(self, name: str) -> np.ndarray:
        """A column in float64."""
        return self.columns[name].astype(np.float64)

    def masses(self) -> np.ndarray | None:
        """(N,) float64 masses, or `None` where the file has none."""
        name = self.of_role("mass")
        return None if name is None else self.exact(name)

    def with_notes(self, *sentences: str) -> ParticleTable:
        """The table with further conventions."""
        return dataclasses.replace(self, conventions=(*self.conventions, *sentences))

    def said(self, begin: str, default: str) -> str:
        """The convention that begins so, or else the default."""
        return next((sentence for sentence in self.conventions if sentence.startswith(begin)), default)


def table_from_columns(
    position: np.ndarray,
    columns: Mapping[str, np.ndarray],
    *,
    source: str,
    conventions: Sequence[str] = (),
) -> ParticleTable:
    """A table of a general-purpose format, where the meaning of a column is only in its name.

    `support` or `support_radius` is the support radius and `volume` the volume, (N,) or (N, 1). A smoothing length (`h`, ...) is
    kept as a column but not used: whether the support is 1, 1.8 or 2 smoothing lengths depends on the code that wrote it.
    """
    said = list(conventions)
    _, rest = gather_vectors({name: scalar_of_width_one(np.asarray(column)) for name, column in columns.items()}, position)
    special: dict[str, np.ndarray] = {}
    for role, names in (("support", SUPPORT_NAMES), ("volume", VOLUME_NAMES)):
        stored = next((name for name in rest if plain(name) in map(plain, names)), None)
        if stored is not None and rest[stored].ndim == 1:
            special[role] = rest.pop(stored)
            said.append(f"{role} = column `{stored}`")
        elif stored is not None and rest[stored].ndim == 2:
            said.append(f"column `{stored}` has {rest[stored].shape[1]} components and is not used as the {role}")
    support, unusable = usable_supports(special.get("support"))
    smoothing = next((name for name in rest if plain(name) in map(plain, SMOOTHING_NAMES)), None)
    if smoothing is not None and "support" not in special:
        said.append(
            f"column `{smoothing}` looks like a smoothing length and is not used: the factor from it to the support "
            f"radius differs between codes; pass `support=` or --support, as 2*{smoothing}, to set supports yourself"
        )
    more: dict[str, Any] = {"source": source, "conventions": tuple(said), "unusable": unusable}
    return ParticleTable(position, rest, support, special.get("volume"), **more)


def usable_supports(values: np.ndarray | None) -> tuple[np.ndarray | None, str | None]:
    """Supports as a file has them, or why they cannot be used: they are no lengths."""
    try:
        return (None if values is None else _positive("support", values, len(values))), None
    except DataError as error:
        return None, str(error)


def native(array: np.ndarray) -> np.ndarray:
    """`array` in the byte order of this machine."""
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def single_number(value: Any) -> float | None:
    """What is stored, such as a time, as a number; `None` where it is not one finite number."""
    stored = np.ravel(np.asarray(value))
    usable = len(stored) == 1 and stored.dtype.kind in "iufb" and np.isfinite(stored[0])
    return float(stored[0]) if usable else None


def box_of(edges: np.ndarray) -> tuple[tuple[float, float, float] | None, list[str]]:
    """Sides of a periodic box from one stored length or three; where they are none, a note that says so."""
    if len(edges) not in (1, 3) or not (np.isfinite(edges) & (edges > 0)).all():
        stored = ", ".join(f"{edge:g}" for edge in edges[:4].tolist())
        return None, [f"not periodic: a box of {stored} (in the header) has no volume; `box=` or --box-size sets one"]
    x, y, z = np.broadcast_to(edges, 3).tolist()
    return (x, y, z), []


def scalar_of_width_one(column: np.ndarray) -> np.ndarray:
    """(N,) for (N, 1), as VTK and many codes store scalars; any other shape as it is."""
    return column[:, 0] if column.ndim == 2 and column.shape[1] == 1 else column


def refuse_shape(shape: tuple[int, ...], count: int) -> None:
    """Refuse what is no column of so many particles, in words of what is left out."""
    if math.prod(shape[:1]) != count:
        raise DataError(f"it has {math.prod(shape[:1])} rows, but there are {count} particles")
    if not 1 <= math.prod(shape[1:]) <= MAX_COMPONENTS:
        raise DataError(f"it has {math.prod(shape[1:])} numbers a particle, not 1 to {MAX_COMPONENTS}")


def _column(name: str, column: np.ndarray, count: int) -> np.ndarray:
    column = scalar_of_width_one(native(np.asarray(column)))
    if column.ndim not in (1, 2) or len(column) != count:
        wrong = f"column `{name}` has shape {column.shape}, but there are {count} particles;"
        raise DataError(f"{wrong} a column must be (N,) or (N, k): leave it out, or write the file again")
    if column.ndim == 2 and not 1 <= column.shape[1] <= MAX_COMPONENTS:
        must = f"must have 1 to {MAX_COMPONENTS} numbers a particle"
        raise DataError(f"column `{name}` has shape {column.shape}, but {must}; leave it out")
    if column.dtype.kind not in "fiub":
        raise DataError(f"column `{name}` must hold numbers, got dtype {column.dtype}; leave it out")
    return column


def _positive(name: str, value: np.ndarray, count: int) -> np.ndarray:
    value = _column(name, value, count)
    if value.ndim != 1:
        raise DataError(f"`{name}` must have shape ({count},), got {value.shape}; give one number a particle")
    if value.dtype not in (np.float32, np.float64):
        value = value.astype(np.float64)
    more = ", or set supports by `support=` or --support" if name == "support" else ""
    return positive(name, value, f"remove these particles{more}")


def positive(name: str, values: np.ndarray, remedy: str) -> np.ndarray:
    """The values, all of which must be finite and > 0."""
    refuse_rows(~(np.isfinite(values) & (values > 0)), values, f"`{name}` must be finite and positive", remedy)
    return values


def one_each(name: str, given: Any, count: int) -> np.ndarray:
    """(count,) float64 of a number, or of one each."""
    values = np.asarray(given)
    if values.dtype.kind not in "fiu" or values.shape not in ((), (count,)):
        what = f"of shape ({count},) or the name of a column, got {values.dtype} of shape {values.shape}"
        raise DataError(f"`{name}` must be a number, one for each {what}")
    return np.broadcast_to(values.astype(np.float64), (count,))


def refuse_rows(wrong: np.ndarray, values: np.ndarray, must: str, remedy: str, each: str = "values ") -> None:
    """Refuse values some of whose rows are `wrong`: how many, and which is the first."""
    if wrong.any():
        wrong = np.asarray(wrong.any(axis=1)) if wrong.ndim > 1 else wrong
        first = int(np.argmax(wrong))
        shown = values[first].tolist() if values.ndim > 1 else values[first]
        number = f"{int(wrong.sum())} of {len(values)} {each}are not"
        raise DataError(f"{must}, but {number}, the first at index {first}: {shown}; {remedy}")
