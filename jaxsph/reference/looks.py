"""Light along portions of rays from what a quantity is at Chebyshev nodes: transfer functions, their kinks and jumps, quadrature.

Flow: quantity at nodes of portions -> [looks] -> extinction and emission at nodes -> light of portions.

On a portion whatever is smooth is taken as the polynomial through `NODES` nodes, ends included; the polynomial through every
second of them says how good that is.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from jaxsph.model.transfer.function import TransferFunction
from jaxsph.reference.where import Portions

NODES = 9
PLACE = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))  # of nodes, from -1 to 1
NUDGE = 1e-7  # of the way from an end to the next node: how far inwards the side of a control value is looked at
KINK = 1 / 8  # error of a gap's integral for a kink within, over the change of slope times the gap squared
CAUTION = 4  # times what is seen of an error: a quantity that turns between nodes may just touch a control value, unseen
THICK = 4.0  # optical thickness of a portion beyond which its attenuation is too steep for what two polynomials say
ROUNDED = 64 * np.finfo(float).eps  # of the largest value, that a quantity may be off
BISECTIONS = 20  # of a gap between two nodes, before a secant


def _polynomials(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """From values at nodes to the Chebyshev coefficients of their polynomial, and to its integrals from -1 to each node."""
    coefficients = np.linalg.inv(chebyshev.chebvander(place, len(place) - 1))
    return coefficients, chebyshev.chebvander(place, len(place)) @ chebyshev.chebint(coefficients, lbnd=-1)


(COEFFICIENTS, INTEGRATION), (_, EVERY_SECOND) = _polynomials(PLACE), _polynomials(PLACE[::2])
WITHIN = chebyshev.chebvander(PLACE[:-1, None] + np.diff(PLACE)[:, None] * [0.2, 0.4, 0.6, 0.8], NODES - 1) @ COEFFICIENTS


class AtNodes(NamedTuple):
    """What is at nodes of portions, summed over the parts of a scene; each adds its own to the arrays.

    Attributes:
        extinction: a unit of path length.
        emission: colour times extinction.
        crossing: depth where a quantity crosses a control value, NaN where none does.
        weight: how much extinction changes there.
        doubt: error of light for what may lie unseen between nodes.
        evaluations: of kernels.
        looked: of each part with a transfer function, in order: numbers of the portions where it is, and its quantities there,
            and what extinction and emission it adds.
    """

    extinction: Float[np.ndarray, "nodes portions"]
    emission: Float[np.ndarray, "3 nodes portions"]
    crossing: Float[np.ndarray, " portions"]
    weight: Float[np.ndarray, " portions"]
    doubt: Float[np.ndarray, " portions"]
    evaluations: Float[np.ndarray, " portions"]
    looked: list[tuple[np.ndarray, list[np.ndarray], np.ndarray, np.ndarray]]


class Light(NamedTuple):
    """What portions show from right in front of them.

    Attributes:
        color: emitted light, attenuated up to the portion's front.
        thickness: optical thickness up to each node.
        error: `CAUTION` times the difference between all nodes and every second, of the largest channel and transmittance
            together, and doubt; 1 for portions that shine and are thicker than `THICK`.
        crossing: see `AtNodes`.
    """

    color: Float[np.ndarray, "portions 3"]
    thickness: Float[np.ndarray, "portions nodes"]
    error: Float[np.ndarray, " portions"]
    crossing: Float[np.ndarray, " portions"]


def light_of(seen: AtNodes, half_path: Float[np.ndarray, " portions"]) -> Light:
    """Integrate extinction up to every node, and emission times transmittance over the portion: of high order in both."""
    color, thickness = _integrated(seen.extinction, seen.emission, half_path, INTEGRATION)
    coarse, thinner = _integrated(seen.extinction[::2], seen.emission[:, ::2], half_path, EVERY_SECOND)
    error = np.abs(color - coarse).max(0) + np.abs(np.exp(-thickness[-1]) - np.exp(-thinner[-1])) + seen.doubt
    error = np.where((thickness[-1] > THICK) & seen.emission.any((0, 1)), 1, CAUTION * error)
    return Light(color.T, thickness.T, error, seen.crossing)


def _integrated(extinction: np.ndarray, emission: np.ndarray, half_path: np.ndarray, rule: np.ndarray) -> tuple[np.ndarray, ...]:
    thickness = np.maximum(half_path * (rule @ extinction), 0)
    return half_path * np.einsum("k,ckp->cp", rule[-1], emission * np.exp(-thickness)), thickness


def tables_of(transfer: TransferFunction) -> list[Table]:
    """A transfer function in float64: one table by one quantity, or one of colours and one of extinction.

    Light bends at control points of either. Extinction of two quantities is at most the largest there is, and colours at most 1.
    """
    colors, extinction = np.asarray(transfer.colors, np.float64).T, np.asarray(transfer.extinction, np.float64)[None]
    most = float(extinction.max())
    if transfer.extinction_values is None:
        table, light = np.concatenate([colors, extinction]), np.concatenate([extinction, colors * extinction])
        return [Table(transfer.values, table, light, most)]
    of_extinction = Table(transfer.extinction_values, extinction, extinction, most)
    return [Table(transfer.values, colors, most * colors, most), of_extinction]


def look_up(
    tables: list[Table], seen: AtNodes, which: np.ndarray, quantities: list[np.ndarray], portions: Portions, slant: np.ndarray
) -> None:
    """Add what portions number `which` show for their `quantities` (nodes, which) each; nothing where those are NaN."""
    there = ~np.isnan(quantities[0][0])
    which, given = which[there], [quantity[:, there] for quantity in quantities]
    half = (portions.end[which] - portions.start[which]) / 2
    gaps = np.diff(PLACE)[:, None] * half * slant[portions.ray[which]]
    looks = zip(tables, (given[0], given[-1]), strict=False)  # by one quantity alone where there is one table
    channels = np.concatenate([table.add(seen, which, quantity, portions, gaps) for table, quantity in looks])
    extinction, emission = channels[3], channels[:3] * channels[3]
    seen.extinction[:, which] += extinction
    seen.emission[:, :, which] += emission
    seen.looked.append((which, given, extinction, emission))


class Table:
    """Some channels of a transfer function, by one quantity.

    Entry k is of point k - 1, as segments are numbered, and entry 0 as of the first point. `_jump` is how much light jumps there,
    `_turn` how much its slope changes, `_bend` both by the lesser width beside.
    At a jump the end of a portion is on the side that the portion is on, so that a portion that ends there is as smooth as any.
    """

    def __init__(self, points: Any, table: np.ndarray, light: np.ndarray, most: float):
        self._values, self._most = np.asarray(points, np.float64), most
        start, base, light = (np.append(one[..., :1], one, -1) for one in (self._values, table, light))
        width, none = np.append(np.diff(start), 0), np.zeros((len(light), 1))
        self._start, self._inverse = start, np.divide(1, width, out=np.zeros_like(width), where=width > 0)
        self._base, self._change = base, np.append(np.diff(base), np.zeros((len(base), 1)), 1)
        self._rank = np.append(0, np.cumsum(np.append(True, width[1:-1] > 0)))  # distinct control values up to each
        rise, before = np.diff(light), np.append(0, width[:-1])
        slope = np.divide(rise, width[:-1], out=np.zeros_like(rise), where=width[:-1] > 0)
        least = np.where((before > 0) & (width > 0), np.minimum(before, width), np.maximum(before, width))
        self._jump = np.where(before > 0, 0, np.abs(np.append(none, rise, 1)).max(0))  # with the later of two points
        self._turn = np.abs(np.append(slope, none, 1) - np.append(none, slope, 1)).max(0)
        self._bend = self._jump + self._turn * least + np.finfo(float).tiny

    def add(self, seen: AtNodes, which: np.ndarray, quantity: np.ndarray, portions: Portions, gaps: np.ndarray) -> np.ndarray:
        """Its channels for a `quantity` (nodes, which); to `seen` go where light bends, and what `gaps` (their path) may hide."""
        inwards = quantity.copy()
        inwards[0] += NUDGE * (quantity[1] - quantity[0])
        inwards[-1] += NUDGE * (quantity[-2] - quantity[-1])
        segment = np.searchsorted(self._values, inwards, "right")
        part = np.clip((quantity - self._start[segment]) * self._inverse[segment], 0, 1)
        upper = np.maximum(segment[1:], segment[:-1])
        bent = self._jump[upper] + KINK * self._turn[upper] * np.abs(np.diff(quantity, axis=0))
        skips = (np.abs(np.diff(self._rank[segment], axis=0)) > 1) | self._hidden(quantity, segment)
        unseen = np.where(skips, self._most, np.where(segment[1:] != segment[:-1], bent, 0)) * gaps
        seen.doubt[which] += np.minimum(unseen.sum(0), 1)
        self._cross(seen, which, quantity, segment, portions)
        return np.asarray(self._base[:, segment] + part * self._change[:, segment])

    def _hidden(self, quantity: np.ndarray, segment: np.ndarray) -> np.ndarray:
        """Gaps between nodes within which the polynomial crosses control values that lie between no two nodes beside them."""
        slack = 1e-9 * np.ptp(quantity, 0) + ROUNDED * (np.abs(quantity).max(0) + np.abs(self._values).max())
        within = quantity[0] + np.tensordot(WITHIN, quantity - quantity[0], 1)
        lowest = np.searchsorted(self._values, within.min(1) + slack, "right")
        highest = np.searchsorted(self._values, within.max(1) - slack, "right")
        least, most = np.minimum(segment[1:], segment[:-1]), np.maximum(segment[1:], segment[:-1])
        return (self._rank[lowest] < self._rank[least]) | (self._rank[highest] > self._rank[most])

    def _cross(self, seen: AtNodes, which: np.ndarray, quantity: np.ndarray, segment: np.ndarray, portions: Portions) -> None:
        """Where the quantity crosses the control value that bends most, those amid a portion before those at its ends."""
        upper = np.maximum(segment[1:], segment[:-1])
        amid = 1 - ((PLACE[1:] + PLACE[:-1]) / 2) ** 2
        weight = np.where(segment[1:] != segment[:-1], self._bend[upper] * amid[:, None], 0)
        gap, best = weight.argmax(0), weight.max(0)
        some = np.flatnonzero(best > seen.weight[which])
        gap, of = gap[some], which[some]
        value = self._values[upper[gap, some] - 1]
        place = _crossing(COEFFICIENTS @ quantity[:, some], value, PLACE[gap], PLACE[gap + 1])
        half = (portions.end[of] - portions.start[of]) / 2
        seen.crossing[of] = portions.start[of] + (place + 1) * half
        seen.weight[of] = best[some]


def _crossing(coefficients: np.ndarray, value: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Where polynomials take a value between `low` and `high`, on both sides of which they are on either side of it."""

    def above(place: np.ndarray) -> np.ndarray:
        return chebyshev.chebval(place, coefficients, tensor=False) - value

    rises = above(high) > above(low)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        past = (above(middle) > 0) == rises
        low, high = np.where(past, low, middle), np.where(past, middle, high)
    before, after = above(low), above(high)
    change = after - before
    return low + (high - low) * np.clip(np.divide(-before, change, out=np.full_like(change, 0.5), where=change != 0), 0, 1)


def where_thickness(thickness: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Share of portions before their thickness (portions, nodes) reaches `target` (portions,)."""
    gap = np.clip((thickness < target[:, None]).sum(1) - 1, 0, NODES - 2)
    return (_crossing(COEFFICIENTS @ thickness.T, target, PLACE[gap], PLACE[gap + 1]) + 1) / 2
