r"""Analytic scenes: `checker_board` and `radial`, of a unit cube, `flubber`, of two balls, and `letters`; each is a formula.

All are after figures of Hochstetter et al. 2016. `checker_board` (figure 8) has cubes of increasing concentration that diffuse.
`radial` (figure 3) is a smooth concentration under a transfer function that is anything but. In `flubber` (figure 10) two fluids
wind around each other while they orbit a centre. `letters` (figure 1) of dyed fluid fall into a basin and splash.
"""

from __future__ import annotations

import colorsys
import functools
from collections.abc import Callable

import numpy as np
import scipy
from jaxtyping import Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.scenes.sampling import fluid_of, moment_of, pictured, scatter

PARTICLES = 100_000
CUBE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
OBLIQUELY = (-0.55, -0.45, -1.0)  # where one looks at a cube
CUBES = 5  # cubes along each axis of the board
FRONT = 0.01  # width of the front between cubes in frame 0, over the edge of the board
SPREAD = 0.0004  # what a frame adds to the square of that width
CENTRE = (1.0, 1.0, 1.0)  # where the radial concentration is 0: the upper right corner that the camera sees in front
BANDS = 16  # narrow bands of its transfer function, evenly spaced over the concentration
BALL = 0.5  # radius of each fluid's ball in frame 0; the two touch at the centre
TILT = np.radians(40.0)  # between the axes of the two rotations, which makes sheets of what would be a flat spiral
RATES = (0.9, 0.5)  # of the two rotations at the centre, radians a frame
CORE = 0.35
"""Distance from the centre within which the fluid turns nearly as one; without it the centre would turn infinitely fast."""

SECONDS_PER_FRAME = 0.1
GRAVITY = 9.81

BASIN = ((-1.0, 0.0, -0.5), (1.0, 0.2, 0.5))  # where the water stands at rest, metres
HEIGHT, THICKNESS = 0.6, 0.2  # of a letter, metres, without the width of its stroke; and from its front to its back
GAP, STAGGER = 0.25, 0.1  # from the water to the first letter in frame 0, and what each further letter hangs higher, metres
LEFT_EDGES = (-0.84, -0.18, 0.48)  # left edges of the letters, metres
STROKE = 0.12  # half the width of a stroke, in heights of a letter
SPLASHING = 0.3  # share of a letter that is thrown up again where it meets the water; the rest sinks
SINKING, CARRIED = 0.12, 0.12  # seconds in which what sinks comes to rest, and how far it is carried sideways meanwhile, metres

SWELL, SWELL_WIDTH, SWELL_SPEED = 0.35, 0.12, 1.4
"""Height over the water's depth, width in metres and speed in metres a second, of the ring that a letter raises."""
LATEST = 10_000  # the last moment: all has long been at rest


def _cube(quantity: Callable[[np.ndarray], np.ndarray], particles: int | None, seed: int) -> Particles:
    """Fluid in a unit cube, of a quantity that depends on the place."""
    count = PARTICLES if particles is None else particles
    position = scatter(np.zeros(3), np.ones(3), count, seed)
    return fluid_of(position, quantity(position), (1.0 / count) ** (1 / 3))


def checker_board(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """A unit cube of fluid; of its 5 x 5 x 5 cubes every second is dyed, more to the right and to the back.

    Frame 0 has sharp fronts, later ones diffuse (any number >= 0, fractions too); `None` is frame 2.
    """
    moment = moment_of("checker_board", frame, 2.0)
    fluid = _cube(lambda position: concentration(position, moment), particles, seed)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.1, 0.3, 0.5, 0.75, 1.0],
        colors=[(0.2, 0.3, 0.5), (0.35, 0.35, 0.95), (0.15, 0.7, 0.75), (0.35, 0.85, 0.3), (1.0, 0.8, 0.2), (1.0, 0.3, 0.15)],
        extinction=[0.15, 3.0, 5.0, 6.0, 7.0, 8.0],
    )
    return pictured(fluid, transfer, CUBE, OBLIQUELY, width, height)


def concentration(position: Float[np.ndarray, "particles 3"], frame: float) -> Float[np.ndarray, " particles"]:
    r"""Concentration in [0, 1] at points of the unit cube.

    The exact solution of the diffusion equation without flux through the cube's faces. A dyed interval $[a, b]$ of an
    axis becomes $\frac{1}{2} [\mathrm{erf}((x - a)/w) - \mathrm{erf}((x - b)/w)]$ plus its mirror images, and cubes are
    products of intervals; $w^2 = `FRONT`^2 + `SPREAD` \cdot frame$.
    """
    width = np.sqrt(FRONT**2 + SPREAD * frame)
    edges = np.arange(CUBES + 1) / CUBES
    shares = []
    for x in position.T:
        mirrored = [x, -x, 2.0 - x, x + 2.0, x - 2.0]
        steps = np.sum([[scipy.special.erf((image - edge) / width) for edge in edges] for image in mirrored], axis=0)
        shares.append(0.5 * (steps[:-1] - steps[1:]))
    column, row, depth = np.indices((CUBES,) * 3)
    increasing = 0.1 + 0.9 * (column + (CUBES - 1 - depth)) / (2 * (CUBES - 1))  # the camera stands on the +z side
    dyed = np.where((column + row + depth) % 2 == 0, increasing, 0.0)
    total = np.zeros(len(position))
    for i, share in enumerate(shares[0]):
        for j, other in enumerate(shares[1]):
            total += share * other * (dyed[i, j] @ np.asarray(shares[2]))
    return np.clip(total, 0.0, 1.0)


def radial(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    r"""A unit cube of fluid with the quantity $|x - c| / \sqrt{3}$, $c$ a corner: from 0 there to 1 at the far corner.

    It does not move: `frame` is accepted and changes nothing.
    """
    fluid = _cube(lambda position: np.linalg.norm(position - CENTRE, axis=1) / np.sqrt(3), particles, seed)
    return pictured(fluid, narrow_bands(), CUBE, OBLIQUELY, width, height)


def narrow_bands() -> TransferFunction:
    """Thin shells of strong colour, a fifth of a band wide, in a faint haze."""
    values, colors, extinction = [0.0], [(0.35, 0.4, 0.5)], [0.15]
    for band in range(BANDS):
        middle, half = (band + 0.5) / BANDS, 0.1 / BANDS
        color = colorsys.hsv_to_rgb((0.62 * band) % 1.0, 0.75, 1.0)
        edge = 0.5 * half
        values += [middle - half - edge, middle - half, middle + half, middle + half + edge]
        colors += [(0.35, 0.4, 0.5), color, color, (0.35, 0.4, 0.5)]
        extinction += [0.15, 20.0, 20.0, 0.15]
    return TransferFunction.from_points([*values, 1.0], [*colors, (0.35, 0.4, 0.5)], [*extinction, 0.15])


def flubber(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """Two balls of fluid, quantity 0 and 1, that orbit the point where they touch and are wound into sheets.

    It is a formula, not a simulation (`orbited`): frames are any number >= 0, fractions too; `None` is frame 8.
    """
    moment = moment_of("flubber", frame, 8.0)
    count = PARTICLES if particles is None else particles
    halves = [ball(part, seed + number) for number, part in enumerate((count // 2, count - count // 2))]
    place = np.concatenate([half + (side * BALL, 0.0, 0.0) for side, half in zip((-1, 1), halves, strict=True)])
    quantity = np.repeat([0.0, 1.0], [len(half) for half in halves])
    spacing = (2 * 4 / 3 * np.pi * BALL**3 / count) ** (1 / 3)
    fluid = fluid_of(orbited(place, moment), quantity, spacing)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.35, 0.5, 0.65, 1.0],
        colors=[(0.95, 0.45, 0.15), (0.95, 0.60, 0.25), (0.95, 0.95, 0.85), (0.30, 0.75, 0.70), (0.10, 0.50, 0.75)],
        extinction=[2.5, 2.5, 8.0, 2.5, 2.5],
    )
    reach = 1.6 * BALL
    return pictured(fluid, transfer, ((-reach,) * 3, (reach,) * 3), (-0.35, -0.75, -1.0), width, height)


def ball(count: int, seed: int) -> Float[np.ndarray, "count 3"]:
    """`count` points, evenly spread through a ball of radius `BALL` around the origin."""
    box = scatter(np.full(3, -BALL), np.full(3, BALL), round(count * 6 / np.pi), seed)
    return box[np.sort(np.argsort((box**2).sum(1), kind="stable")[:count])]


def orbited(position: Float[np.ndarray, "particles 3"], frame: float) -> Float[np.ndarray, "particles 3"]:
    r"""Where particles are after `frame` frames.

    Every sphere around the centre turns rigidly, by the angle $\omega\, t\, (1 + r^2 / c^2)^{-3/4}$ around one axis and
    then around another: far out as $r^{-3/2}$, the rate of Kepler's orbits. Rotations that depend on the radius alone
    keep volume, so the fluid stays as dense as it was.
    """
    radius = np.linalg.norm(position, axis=1)
    slower = frame * (1 + (radius / CORE) ** 2) ** -0.75
    axes = ((0.0, 1.0, 0.0), (np.sin(TILT), np.cos(TILT), 0.0))
    for axis, rate in zip(axes, RATES, strict=True):
        position = _turned(position, np.asarray(axis), rate * slower)
    return position


def _turned(position: np.ndarray, axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rodrigues' rotation of every point by its own angle."""
    along = (position @ axis)[:, None] * axis
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    return along + (position - along) * cosine + np.cross(axis, position) * sine


def letters(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """S, P and H fall into water; the quantity is their dye: 0 in the water, then 1/3, 2/3 and 1.

    It is a formula, not a simulation: particles fall freely until they meet the water, where some are thrown up and fall again,
    and others come to rest (`fallen`). Frames are tenths of a second, any number >= 0, fractions too; `None` is frame 3.5.
    """
    moment = moment_of("letters", frame, 3.5, LATEST)
    count = PARTICLES if particles is None else particles
    lower, upper = np.asarray(BASIN)
    volumes = [float((upper - lower).prod()), *(area(name) * HEIGHT**2 * THICKNESS for name in GLYPHS)]
    spacing = (sum(volumes) / count) ** (1 / 3)
    parts = np.diff(np.round(np.cumsum([0.0, *volumes]) / sum(volumes) * count).astype(int))
    now, generator = moment * SECONDS_PER_FRAME, np.random.default_rng(seed)
    drops = [letter(number, int(part), seed + 1 + number) for number, part in enumerate(parts[1:])]
    water = scatter(lower, upper, int(parts[0]), seed)
    dropped = [fallen(drop, left, now, generator) for drop, left in zip(drops, LEFT_EDGES, strict=True)]
    sunk = sum(float((place[:, 1] <= upper[1]).sum()) for place in dropped) / max(count, 1) * sum(volumes)
    rise = 1 + sunk / volumes[0]
    for number, left in enumerate(LEFT_EDGES):
        water[:, 1] *= 1 + swell(water, left + HEIGHT * 0.3, now - float(_until_water(GAP + number * STAGGER)))
    position = np.concatenate([water, *dropped])
    position[:, 1] *= np.where(position[:, 1] <= upper[1] * (1 + SWELL), rise, 1.0)
    quantity = np.repeat(np.arange(4) / 3, parts)
    fluid = fluid_of(position, quantity, spacing)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.1, 1 / 3, 2 / 3, 1.0],
        colors=[(0.15, 0.40, 0.75), (0.20, 0.60, 0.80), (0.25, 0.85, 0.55), (0.98, 0.75, 0.20), (0.95, 0.30, 0.20)],
        extinction=[1.2, 2.5, 9.0, 9.0, 9.0],
    )
    top = upper[1] + GAP + STAGGER * (len(LEFT_EDGES) - 1) + HEIGHT * (1 + 2 * STROKE)
    return pictured(fluid, transfer, (BASIN[0], (BASIN[1][0], top, BASIN[1][2])), (-0.25, -0.4, -1.0), width, height)


def _arc(middle: tuple[float, float], start: float, end: float) -> list[tuple[float, float]]:
    angles = np.radians(np.linspace(start, end, 13))
    return [(middle[0] + 0.3 * np.cos(angle), middle[1] + 0.25 * np.sin(angle)) for angle in angles]


GLYPHS: dict[str, list[list[tuple[float, float]]]] = {
    "S": [_arc((0.3, 0.75), 25, 270) + _arc((0.3, 0.25), 90, -155)],
    "P": [[(0.0, 0.0), (0.0, 1.0), *_arc((0.3, 0.75), 90, -90), (0.0, 0.5)]],
    "H": [[(0.0, 0.0), (0.0, 1.0)], [(0.6, 0.0), (0.6, 1.0)], [(0.0, 0.5), (0.6, 0.5)]],
}
"""Lines along the middle of the strokes, in heights of a letter: y from 0 to 1, x from 0 to 0.6."""

GLYPH_BOX = ((-STROKE, -STROKE), (0.6 + STROKE, 1 + STROKE))  # the box around a letter, in heights


def distance(place: Float[np.ndarray, "points 2"], name: str) -> Float[np.ndarray, " points"]:
    """From points to the middle of a letter's strokes, in heights."""
    nearest = np.full(len(place), np.inf)
    for line in GLYPHS[name]:
        for start, end in zip(np.asarray(line[:-1]), np.asarray(line[1:]), strict=True):
            along = end - start
            share = np.clip((place - start) @ along / max(along @ along, 1e-12), 0, 1)
            nearest = np.minimum(nearest, ((place - start - share[:, None] * along) ** 2).sum(1))
    return np.sqrt(nearest)


@functools.cache
def area(name: str) -> float:
    """Of a letter's face, in squared heights."""
    lower, upper = np.asarray(GLYPH_BOX)
    axes = [np.linspace(a, b, 200) for a, b in zip(lower, upper, strict=True)]
    inside = distance(np.stack(np.meshgrid(*axes), -1).reshape(-1, 2), name) <= STROKE
    return float(inside.mean() * (upper - lower).prod())


def letter(number: int, count: int, seed: int) -> Float[np.ndarray, "count 3"]:
    """`count` points, evenly spread through a letter where it hangs in frame 0, metres."""
    name = tuple(GLYPHS)[number]
    lower, upper = (np.append(corner, depth) for corner, depth in zip(np.asarray(GLYPH_BOX), (-0.5, 0.5), strict=True))
    box = scatter(lower, upper, round(count * float((upper - lower)[:2].prod()) / area(name)) + 1, seed)
    kept = box[np.sort(np.argsort(distance(box[:, :2], name), kind="stable")[:count])]
    bottom = BASIN[1][1] + GAP + STAGGER * number + HEIGHT * STROKE
    return kept * (HEIGHT, HEIGHT, THICKNESS) + (LEFT_EDGES[number], bottom, 0.0)


def _until_water(above: Float[np.ndarray, " points"] | float) -> Float[np.ndarray, " points"]:
    """Seconds of free fall from a height above the water."""
    return np.sqrt(2 * np.maximum(above, 0.0) / GRAVITY)


def fallen(
    start: Float[np.ndarray, "count 3"], left: float, now: float, generator: np.random.Generator
) -> Float[np.ndarray, "count 3"]:
    r"""Where the particles of a letter are after `now` seconds.

    They fall from rest, $y = y_0 - g t^2 / 2$, and meet the water with $v = \sqrt{2 g (y_0 - d)}$. Those that splash leave
    it with a part of that speed upwards and another outwards, fall once more, and rest; the others come to rest
    exponentially at some depth. Walls reflect.
    """
    surface = BASIN[1][1]
    above = start[:, 1] - surface
    since = now - _until_water(above)
    speed = np.sqrt(2 * GRAVITY * np.maximum(above, 0.0))
    random = generator.random((len(start), 5))
    outward = np.arctan2(start[:, 2] / THICKNESS, (start[:, 0] - left) / HEIGHT - 0.3) + (random[:, 0] - 0.5)
    up, out = (0.1 + 0.5 * random[:, 1]) * speed, (0.1 + 0.35 * random[:, 2]) * speed
    rest = surface * random[:, 3]
    flown = np.clip(since, 0.0, 2 * up / GRAVITY)
    calmed = 1 - np.exp(-np.maximum(since, 0.0) / SINKING)
    landed = 1 - np.exp(-np.maximum(since - 2 * up / GRAVITY, 0.0) / SINKING)
    splashes = random[:, 4] < SPLASHING
    risen = surface + up * flown - GRAVITY / 2 * flown**2 - (surface - rest) * landed
    height = np.where(splashes, risen, surface - (surface - rest) * calmed)
    sideways = np.where(splashes, out * flown, CARRIED * random[:, 2] * calmed)
    place = start.copy()
    place[:, 1] = np.where(since > 0, height, start[:, 1] - GRAVITY / 2 * now**2)
    for axis, direction in ((0, np.cos(outward)), (2, np.sin(outward))):
        low, there_and_back = BASIN[0][axis], 2 * (BASIN[1][axis] - BASIN[0][axis])
        turn = np.mod(start[:, axis] + sideways * direction - low, there_and_back)
        place[:, axis] = low + np.minimum(turn, there_and_back - turn)  # folded back between the walls
    return place


def swell(water: Float[np.ndarray, "points 3"], middle: float, since: float) -> Float[np.ndarray, " points"]:
    """How much a letter that met the water `since` seconds ago raises it, over its depth: a ring that runs outwards and ebbs."""
    if since <= 0:
        return np.zeros(len(water))
    away = np.hypot(water[:, 0] - middle, water[:, 2])
    front = SWELL_SPEED * since
    ring = np.exp(-(((away - front) / SWELL_WIDTH) ** 2))
    return SWELL * ring * (1 - np.exp(-since / 0.05)) / (1 + front / (4 * SWELL_WIDTH))
