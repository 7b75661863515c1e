"""Draw `docs/house.svg` and `docs/engine.svg`: which rooms the code has, on which floors they are, and which import which.

Everything in the picture is read from the code (`house_rooms`). Rooms are the folders and modules of `jaxsph/`, or of
`jaxsph/engine/`, with the first line of their docstrings; floors are the layers that `pyproject.toml` has import-linter keep;
arrows are imports, found with `ast`. An import that other arrows already lead to is not drawn: what a room uses is all that can
be reached from it downwards.

    python docs/draw_house.py
"""

from __future__ import annotations

import dataclasses
import html
import tomllib
from collections import defaultdict
from pathlib import Path

from house_rooms import ROOT, Edge, contents_of, floors_of, imports_of, named_rooms, purpose_of, reduced, rooms_of

PICTURES = {"jaxsph": ROOT / "docs" / "house.svg", "jaxsph.engine": ROOT / "docs" / "engine.svg"}

WIDTH = 840  # of the house, pixels
MARGIN = 20
BESIDE = 8  # between rooms of a floor
GAP = 24  # between floors
LANE = 13  # between lines in a stairwell
LABEL = 140  # what a name takes where its purpose stands beside it
PAD = 12
LINE = 17  # of text
NAME_SIZE, TEXT_SIZE, FILE_SIZE = 15, 13, 12
INK, SOFT, FAINT, LIGHT = "#1f2933", "#3e4c59", "#66788a", "#9aa5b1"
WALL, ROOM, FOLDER, PAPER = "#cbd2d9", "#ffffff", "#eaf2fb", "#f7f9fb"


@dataclasses.dataclass
class Room:
    """A rectangle with text.

    Attributes:
        lines: (x, y, size, colour, bold, text), relative to the upper left corner.
    """

    name: str
    folder: bool
    x: float
    y: float
    width: float
    height: float
    lines: list[tuple[float, float, int, str, bool, str]]

    def touches(self, side: str) -> bool:
        """Whether one of its walls is the house's."""
        return self.x < 1 if side == "left" else self.x + self.width > WIDTH - 1


def text_width(text: str, size: int) -> float:
    """At most so many pixels, in any usual sans-serif font."""
    return size * sum(0.36 if c in "iljftr.,:;'()[]| " else 0.96 if c in "mwMW" else 0.74 if c.isupper() else 0.63 for c in text)


def wrapped(text: str, width: float, size: int) -> list[str]:
    """Lines that are no wider than `width`."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and text_width(longer, size) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def furnished(package: Path, room: str, x: float, width: float, alone: bool, by_name: bool) -> Room:
    """A room with its text: its name, what it is for, and its files if it is a folder."""
    folder = (package / room).is_dir()
    title = room + ("/" if folder else ".py")
    left, top = (LABEL, PAD + NAME_SIZE - 2) if alone else (PAD, PAD + NAME_SIZE + 1 + LINE)
    space = width - left - PAD
    said = purpose_of(package, room) + (" Looked up by name." if by_name else "")
    lines = [(PAD, PAD + NAME_SIZE - 2, NAME_SIZE, INK, True, title)]
    texts = [(TEXT_SIZE, SOFT, text) for text in wrapped(said, space, TEXT_SIZE)]
    if folder:
        files = ", ".join(contents_of(package, room))
        texts += [(FILE_SIZE, FAINT, text) for text in wrapped(files, space, FILE_SIZE)]
    lines += [(left, top + k * LINE, size, color, False, text) for k, (size, color, text) in enumerate(texts)]
    return Room(room, folder, x, 0, width, lines[-1][1] + PAD, lines)


def built(package: Path, floors: list[list[str]]) -> dict[str, Room]:
    """All rooms, floor by floor, the highest first."""
    rooms, by_name, y = {}, named_rooms(package), 0.0
    for floor in reversed(floors):
        width, alone = (WIDTH - BESIDE * (len(floor) - 1)) / len(floor), len(floor) == 1
        for k, name in enumerate(floor):
            rooms[name] = furnished(package, name, k * (width + BESIDE), width, alone, name in by_name)
        height = max(rooms[name].height for name in floor)
        for name in floor:
            rooms[name].y, rooms[name].height = y, height
        y += height + GAP
    return rooms


@dataclasses.dataclass
class Lane:
    """The line in a stairwell that all imports of a room share, on one side of the house."""

    target: str
    sources: list[str]
    side: str
    column: int = 0

    def span(self, rooms: dict[str, Room]) -> tuple[float, float]:
        """Its upper and lower end, about."""
        return min(rooms[name].y for name in self.sources), rooms[self.target].y + rooms[self.target].height

    @property
    def x(self) -> float:
        """Where it is drawn."""
        off = LANE * (self.column + 1.5)
        return -off if self.side == "left" else WIDTH + off


def split(edges: list[Edge], rooms: dict[str, Room], level: dict[str, int]) -> tuple[list[Edge], dict[str, list[str]]]:
    """Arrows straight down to the next floor; and the sources of all others, by target."""
    straight, far = [], defaultdict(list)
    for source, target in edges:
        if level[source] - level[target] == 1 and shared(rooms[source], rooms[target]):
            straight.append((source, target))
        else:
            far[target].append(source)
    return straight, far


def shared(above: Room, below: Room) -> tuple[float, float] | None:
    """From where to where two rooms have a wall in common, if they do."""
    low, high = max(above.x, below.x), min(above.x + above.width, below.x + below.width)
    return (low, high) if high - low > 2 * BESIDE else None


def lanes_of(far: dict[str, list[str]], rooms: dict[str, Room]) -> list[Lane]:
    """A side for each target, where most of its rooms have a wall; short lanes next to the house."""
    lanes: list[Lane] = []
    used = {"left": 0.0, "right": 0.0}
    for target, sources in sorted(far.items(), key=lambda item: (-len(item[1]), item[0])):
        inside = {side: sum(not rooms[name].touches(side) for name in (target, *sources)) for side in used}
        lane = Lane(target, sources, min(used, key=lambda side: (inside[side], used[side])))
        top, bottom = lane.span(rooms)
        used[lane.side] += bottom - top
        lanes.append(lane)
    lanes.sort(key=lambda lane: (lane.span(rooms)[1] - lane.span(rooms)[0], lane.target))
    for nth, lane in enumerate(lanes):
        top, bottom = lane.span(rooms)
        beside = [(other.column, other.span(rooms)) for other in lanes[:nth] if other.side == lane.side]
        taken = {column for column, (start, end) in beside if start < bottom and top < end}
        lane.column = min(set(range(len(lanes))) - taken)
    return lanes


class Router:
    """Ports on walls and tracks between floors, such that no two lines lie on each other."""

    def __init__(self, rooms: dict[str, Room], lanes: list[Lane]) -> None:
        self.rooms = rooms
        sides = defaultdict(list)
        below, above = defaultdict(list), defaultdict(list)
        for lane in lanes:
            for name in lane.sources:
                (sides[name, lane.side] if rooms[name].touches(lane.side) else below[name]).append((1, -lane.column, lane.target))
            target = rooms[lane.target]
            (sides[lane.target, lane.side] if target.touches(lane.side) else above[lane.target]).append((0, 0, lane.target))
        self._sides = {key: [target for *_, target in sorted(ports)] for key, ports in sides.items()}
        self._below, self._above = below, above
        self._tracks: dict[tuple[float, str], int] = {}

    def side(self, name: str, side: str, target: str) -> float:
        """Height at which the line to a target meets a room's outer wall."""
        ports, room = self._sides[name, side], self.rooms[name]
        return room.y + room.height * (ports.index(target) + 1) / (len(ports) + 1)

    def wall(self, name: str, target: str, above: bool) -> float:
        """Where along its ceiling or floor a line leaves a room that has no outer wall: off the middle, that arrows take."""
        ports, room = [key for *_, key in (self._above if above else self._below)[name]], self.rooms[name]
        return room.x + room.width * (0.8 if above else 0.2) + LANE * (ports.index(target) - (len(ports) - 1) / 2)

    def track(self, y: float, target: str) -> float:
        """Height of the line to a target between two floors, of which the upper ends at `y`."""
        others = [key for key in self._tracks if key[0] == y]
        nth = self._tracks.setdefault((y, target), len(others))
        return y + GAP * (0.25, 0.5, 0.75)[nth % 3]


def rounded(points: list[tuple[float, float]], radius: float = 5) -> str:
    """A path along right angles, corners rounded."""
    path = f"M{points[0][0]:.1f} {points[0][1]:.1f}"
    for before, here, after in zip(points, points[1:], points[2:], strict=False):
        ends = []
        for other in (before, after):
            run = abs(other[0] - here[0]) + abs(other[1] - here[1])
            part = min(radius, run / 2) / run if run else 0
            ends.append((here[0] + (other[0] - here[0]) * part, here[1] + (other[1] - here[1]) * part))
        path += f" L{ends[0][0]:.1f} {ends[0][1]:.1f} Q{here[0]:.1f} {here[1]:.1f} {ends[1][0]:.1f} {ends[1][1]:.1f}"
    return path + f" L{points[-1][0]:.1f} {points[-1][1]:.1f}"


def line(points: list[tuple[float, float]], color: str, width: float, head: str = "") -> str:
    """One line, with an arrow head at its end if it has a name."""
    end = f' marker-end="url(#{head})"' if head else ""
    return f'<path d="{rounded(points)}" fill="none" stroke="{color}" stroke-width="{width}"{end}/>'


def drawn_straight(straight: list[Edge], rooms: dict[str, Room]) -> list[str]:
    """Arrows to the next floor, each in the middle of the wall that the two rooms share."""
    found = []
    for source, target in straight:
        low, high = shared(rooms[source], rooms[target]) or (0, 0)
        x = (low + high) / 2
        found.append(line([(x, rooms[source].y + rooms[source].height), (x, rooms[target].y - 2)], SOFT, 1.6, "near"))
    return found


def drawn_lane(lane: Lane, rooms: dict[str, Room], router: Router) -> list[str]:
    """From each source into the stairwell, down, and into the target."""
    target, edge = rooms[lane.target], 0 if lane.side == "left" else WIDTH
    inward = 2 if lane.side == "right" else -2
    if target.touches(lane.side):
        y = router.side(lane.target, lane.side, lane.target)
        end = [(lane.x, y), (edge + inward, y)]
    else:
        x, y = router.wall(lane.target, lane.target, True), router.track(target.y - GAP, lane.target)
        end = [(lane.x, y), (x, y), (x, target.y - 2)]
    found, starts = [], []
    for name in lane.sources:
        room = rooms[name]
        if room.touches(lane.side):
            y = router.side(name, lane.side, lane.target)
            start = [(edge, y), (lane.x, y)]
        else:
            x, y = router.wall(name, lane.target, False), router.track(room.y + room.height, lane.target)
            start = [(x, room.y + room.height), (x, y), (lane.x, y)]
        starts.append(start)
    starts.sort(key=lambda start: start[-1][1])
    found.append(line([*starts[0], *end], LIGHT, 1.2, "far"))
    for start in starts[1:]:
        found.append(line(start, LIGHT, 1.2))
        found.append(f'<circle cx="{start[-1][0]:.1f}" cy="{start[-1][1]:.1f}" r="2.4" fill="{LIGHT}"/>')
    return found


def drawn_room(room: Room) -> list[str]:
    """Walls and text."""
    fill = FOLDER if room.folder else ROOM
    found = [
        f'<rect x="{room.x:.1f}" y="{room.y:.1f}" width="{room.width:.1f}" height="{room.height:.1f}" rx="5" '
        f'fill="{fill}" stroke="{WALL}"/>'
    ]
    for x, y, size, color, bold, text in room.lines:
        weight = ' font-weight="bold"' if bold else ""
        at = f'x="{room.x + x:.1f}" y="{room.y + y:.1f}" font-size="{size}"'
        found.append(f'<text {at} fill="{color}"{weight}>{html.escape(text, quote=False)}</text>')
    return found


def roof(title: str, ends: tuple[float, float], height: float) -> list[str]:
    """A gable, with what is to be known of the picture."""
    rooms = "Rooms are folders and modules, floors are layers. Imports only point down."
    arrows = "Dark: to the next floor. Light: further down, by the stairs. What other arrows lead to is not drawn."
    texts = [(title, -64, NAME_SIZE + 1, INK), (rooms, -44, TEXT_SIZE, SOFT), (arrows, -24, TEXT_SIZE, SOFT)]
    found = [f'<path d="M{ends[0]:.1f} -8 L{WIDTH / 2} {-height:.1f} L{ends[1]:.1f} -8 Z" fill="{FOLDER}" stroke="{WALL}"/>']
    for text, y, size, color in texts:
        at = f'x="{WIDTH / 2}" y="{y}" font-size="{size}"'
        weight = ' font-weight="bold"' if color == INK else ""
        found.append(f'<text {at} fill="{color}" text-anchor="middle"{weight}>{text}</text>')
    return found


def heads() -> str:
    """Arrow heads."""
    marks = [
        f'<marker id="{name}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="{size}" markerHeight="{size}" '
        f'markerUnits="userSpaceOnUse" orient="auto"><path d="M0 0 L8 4 L0 8 Z" fill="{color}"/></marker>'
        for name, color, size in (("near", SOFT, 9), ("far", LIGHT, 8))
    ]
    return f"<defs>{''.join(marks)}</defs>"


def picture(of: str) -> str:
    """The picture of a package, as the code is now."""
    package = ROOT / of.replace(".", "/")
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    (layers,) = (contract["layers"] for contract in contracts if contract.get("containers") == [of])
    names = rooms_of(package)
    imports = {room: imports_of(package, room, names) for room in names}
    floors = floors_of(layers, imports)
    level = {room: k for k, floor in enumerate(floors) for room in floor}
    rooms = built(package, floors)
    straight, far = split(reduced(imports), rooms, level)
    lanes = lanes_of(far, rooms)
    router = Router(rooms, lanes)
    beside = LANE * (max((lane.column for lane in lanes), default=0) + 3)
    height, above = max(room.y + room.height for room in rooms.values()), 150
    parts = [*roof(f"The house of {of}", (-beside, WIDTH + beside), above)]
    parts += [element for lane in lanes for element in drawn_lane(lane, rooms, router)]
    parts += drawn_straight(straight, rooms)
    parts += [element for room in rooms.values() for element in drawn_room(room)]
    left, top = -beside - MARGIN, -above - MARGIN
    size = WIDTH + 2 * (beside + MARGIN), height + above + 2 * MARGIN
    box = f'viewBox="{left:.0f} {top:.0f} {size[0]:.0f} {size[1]:.0f}" width="{size[0]:.0f}" height="{size[1]:.0f}"'
    ground = f'<rect x="{left:.0f}" y="{top:.0f}" width="{size[0]:.0f}" height="{size[1]:.0f}" fill="{PAPER}"/>'
    opening = f'<svg xmlns="http://www.w3.org/2000/svg" {box} font-family="Helvetica, Arial, sans-serif">'
    return "\n".join([opening, heads(), ground, *parts, "</svg>", ""])


if __name__ == "__main__":
    for of, file in PICTURES.items():
        file.write_text(picture(of), encoding="utf-8")
