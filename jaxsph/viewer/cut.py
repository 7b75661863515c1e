"""What of a scene is cut away while one looks around: a plane across the view, a box, or a sphere.

Flow: message, Pose -> [cut] -> Clip of the scene; JSON of a page; words of Python.

A cut is measured from a middle, in shares of a reach: what the view turned about, and half of its visible height, when it was
chosen. To move it moves arrays of a clip, and compiles nothing; its kind is static.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxsph.model.clips import Both, Box, Clip, Outside, Plane, Sphere
from jaxsph.viewer.inputs import FARTHEST, InputError, number, vector, word
from jaxsph.viewer.pose import Pose

OFF = "off"
SHARES = {"plane": (-2.0, 2.0, 0.0), "box": (0.01, 2.0, 0.5), "sphere": (0.01, 2.0, 0.5)}
"""Of each kind: the least and the largest share of the reach, and the first."""


@dataclasses.dataclass(frozen=True)
class Cut:
    """A part of space that alone is shown.

    Attributes:
        kind: one of `SHARES`.
        middle: (3,) length units.
        reach: length units.
        share: of the reach: how far behind the middle a plane is, half a side of a box, the radius of a sphere.
        axis: (3,) of length 1, across which a plane is; what is before it is cut away.
        follows: whether that is the direction of view, whichever it is.
        outside: whether the other side is shown instead.
    """

    kind: str
    middle: tuple[float, ...]
    reach: float
    share: float
    axis: tuple[float, ...]
    follows: bool = True
    outside: bool = False

    def seen_from(self, pose: Pose) -> Cut:
        """The same once the view has moved."""
        return dataclasses.replace(self, axis=tuple(pose.axes[2].tolist())) if self.follows else self

    def clip(self) -> Clip:
        """What is shown."""
        middle, size = np.array(self.middle), self.reach * self.share
        made: Clip
        if self.kind == "plane":
            made = Plane((middle + size * np.array(self.axis)).tolist(), list(self.axis))
        elif self.kind == "box":
            made = Box((middle - size).tolist(), (middle + size).tolist())
        else:
            made = Sphere(list(self.middle), size)
        return ~made if self.outside else made

    def told(self) -> dict[str, Any]:
        """For a page, as JSON has it; `least` and `most` are ends of the share."""
        least, most, _ = SHARES[self.kind]
        return {**dataclasses.asdict(self), "least": least, "most": most}


def asked(cut: Cut | None, said: dict[str, Any], pose: Pose) -> Cut | None:
    """The cut that a message asks for: another `kind`, `"off"`, another `share`, `follows` or `outside`; or measured from `here`.

    An address says `middle`, `reach` and `axis`, too, as `told` told them.

    Raises:
        InputError: there is none to change, or no such kind or number.
    """
    kind = cut.kind if cut is not None and "kind" not in said else word(said, "kind", (*SHARES, OFF))
    if kind == OFF:
        return None
    least, most, first = SHARES[kind]
    changes: dict[str, Any] = {name: said[name] is True for name in ("follows", "outside") if name in said}
    changes |= {name: tuple(vector(said, name).tolist()) for name in ("middle", "axis") if name in said}
    if not any(changes.get("axis", (1,))):
        raise InputError("`axis` of a cut must have a direction")
    if cut is None or said.get("here") is True:
        middle, reach, axis = pose.target.tolist(), pose.height / 2, tuple(pose.axes[2].tolist())
        old: dict[str, Any] = {} if cut is None else {"follows": cut.follows, "outside": cut.outside}
        cut = Cut(kind, tuple(middle), reach, first, axis, **old)
    elif kind != cut.kind:
        cut = dataclasses.replace(cut, kind=kind, share=first)
    if "reach" in said:
        changes["reach"] = number(said, "reach", 1 / FARTHEST, FARTHEST)
    return dataclasses.replace(cut, share=number(said, "share", least, most, cut.share), **changes).seen_from(pose)


def python_of(clip: Clip) -> str:
    """Python that makes a clip."""
    if isinstance(clip, Both):
        return f"({python_of(clip.first)} & {python_of(clip.second)})"
    if isinstance(clip, Outside):
        return f"~{python_of(clip.clip)}"
    if isinstance(clip, Box):
        given = clip.corners()
    else:
        assert isinstance(clip, Plane | Sphere)
        place, other = (clip.point, clip.normal) if isinstance(clip, Plane) else (clip.center, clip.radius)
        given = np.asarray(place, np.float64) + np.asarray(clip.rest, np.float64), np.asarray(other, np.float64)
    return f"js.{type(clip).__name__}({', '.join(str(one.tolist()) for one in given)})"
