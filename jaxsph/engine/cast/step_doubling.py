r"""Steps along each ray as long as a tolerance allows: step doubling, Kratz et al. 2011, section 6.

Flow: media at points -> [step doubling] -> composite.

A step is taken once in full and once as two halves. Where both nearly agree the halves are accepted, and the next step may be
longer; else it is halved and tried again. Points lie on the ends of steps, which neighbours share, and between two of them
extinction is linear: so an accepted step costs two evaluations of the media, and a rejected one costs one.

How far both differ is measured as what the ray would show of it, $T \max_{0 \le b \le 1} |\Delta c + b \, \Delta t|$, with $T$
the transmittance in front within the slab, $\Delta c$ and $\Delta t$ the differences of colour and transmittance, and $b$ what
shines behind, which nothing here knows. A slab may take of the tolerance as large a part as its samples are of all samples, and
spends it in proportion to depth; what a step leaves over, those behind it may take. So the differences of a ray add up to the
tolerance at most, whichever slabs are marched first, but for steps of the least length.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.cast.integrator import Integrator, Segment
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Medium, optics
from jaxsph.numerics.compiled import fusion_barrier, greater, lesser, ratio

SHORTEST = 1 / 256  # of a sample: the least step, which is accepted whatever it differs by
RESOLVED = 16  # eps of its depth that a step must be long, such that its middle lies between its ends
ROUNDING = 8  # eps of what a step takes of the light: a difference as small is rounding, and tells nothing
EASY = 4  # times a difference that is allowed: a step of twice the length, with eight times the difference, is then as well


class Steps(NamedTuple):
    """Where all rays of some slabs are; each ray is a slab of its own.

    Attributes:
        sample: of the slab, the sample that the step lies in: no step is longer than what one stands for.
        near, far: depths where the step begins and ends.
        step: depth that it was to take, before it was cut off at the sample's border.
        known: whether light at its far end is known; else that is what is evaluated next, and its middle if it is.
        at_near, at_far: emission in red, green and blue, and extinction, a unit length.
        color, thickness: of what lies in front, the latter by sample.
        spent: differences of accepted steps.
        evaluations: of the media.
    """

    sample: Int[Array, " rays"]
    near: Float[Array, " rays"]
    far: Float[Array, " rays"]
    step: Float[Array, " rays"]
    known: Bool[Array, " rays"]
    at_near: Float[Array, "4 rays"]
    at_far: Float[Array, "4 rays"]
    color: Float[Array, "3 rays"]
    thickness: Float[Array, "samples rays"]
    spent: Float[Array, " rays"]
    evaluations: Int[Array, " rays"]


@dataclasses.dataclass(frozen=True)
class StepDoubling(Integrator):
    """Steps of adaptive length through media that give their optics at points.

    Attributes:
        tolerance: largest sum of differences along a ray, in colour and transmittance, > 0: an estimate of the error, no bound.
            What lies between three points of a step, and shows at none of them, is missed: a sample is the longest step.
        samples: of the whole ray.
    """

    asks_points = True
    forward_only = (
        "`integrator='step_doubling'` has no reverse-mode derivatives, as a ray takes any number of steps; "
        "take forward ones (`jax.jvp`), or give `integrator='samples'`"
    )
    tolerance: float = 1e-3
    samples: int = 256

    def __call__(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """See `Integrator`. What is gathered at samples is not read.

        Differentiation:
            Forward mode only, by what media are made of and by where rays go; the steps that are taken are held fixed.
        """
        steps, (tasks, samples, rays) = self.march(medium, task), task.shape
        red, green, blue = (channel.reshape(tasks, rays) for channel in steps.color)
        thickness = jnp.moveaxis(steps.thickness.reshape(samples, tasks, rays), 0, 1)
        return Segment((red, green, blue), jnp.exp(-thickness.sum(1)), thickness)

    def march(self, medium: Medium, task: SlabTask) -> Steps:
        """All rays of slabs at their ends."""
        slabs = _Slabs.of(medium, task, self.tolerance / self.samples)
        return lax.while_loop(lambda steps: (steps.sample < slabs.real).any(), slabs.turn, slabs.begin())


@dataclasses.dataclass(frozen=True)
class _Slabs:
    """What stays the same while rays step through slabs, the rays one by one.

    Attributes:
        task: the rays as slabs of one ray.
        border: depths of the borders of samples; `real` counts those samples that are not of zero length.
        slant: path length a unit of depth.
        share: of the tolerance, for each sample.
    """

    medium: Medium
    task: SlabTask
    border: Float[Array, "samples_and_one rays"]
    real: Int[Array, " rays"]
    slant: Float[Array, " rays"]
    share: float

    @classmethod
    def of(cls, medium: Medium, task: SlabTask, share: float) -> _Slabs:
        rays = task.one_by_one()
        border = rays.border.T
        unit = jnp.arange(2, dtype=border.dtype)[None]
        slant = jnp.broadcast_to(dataclasses.replace(rays, border=unit).path()[:, 0, 0], border.shape[1:])
        return cls(medium, rays, border, (border[1:] > border[:-1]).sum(0, dtype=jnp.int32), slant, share)

    def begin(self) -> Steps:
        """At the slabs' front borders, with a step of a sample."""
        border, zero, nth = self.border, jnp.zeros_like(self.border[0]), jnp.zeros_like(self.real)
        here = self.light(border[0])
        still = jnp.zeros_like(here)
        known = jnp.zeros(nth.shape, bool)
        thickness, spent = jnp.zeros_like(border[1:]), zero
        step = border[1] - border[0]
        return Steps(nth, border[0], border[1], step, known, here, still, still[:3], thickness, spent, nth + 1)

    def light(self, depth: Float[Array, " rays"]) -> Float[Array, "4 rays"]:
        """Emission and extinction a unit length."""
        there = dataclasses.replace(self.task, depth=depth[:, None], border=jnp.stack([depth, depth], 1))
        always = self.task.slab[0] >= 0
        gathered = fusion_barrier(always, self.medium.gather, there)
        *colors, extinction = fusion_barrier(always, functools.partial(optics, self.medium), gathered, there)
        emission = [jnp.where(extinction > 0, extinction * color, 0) for color in colors]
        return jnp.stack([value[:, 0, 0] for value in (*emission, extinction)])

    def turn(self, steps: Steps) -> Steps:
        """One more point of each ray: the far end of a step, or its middle, which tells whether the step is accepted."""
        going = steps.sample < self.real
        middle = steps.near + 0.5 * (steps.far - steps.near)
        found = self.light(jnp.where(steps.known, middle, steps.far))
        color, taken, difference = fusion_barrier(going.any(), self.compared, steps, found)
        length = self.border[-1] - self.border[0]
        part = (steps.far - self.border[0]) / jnp.where(length > 0, length, 1)
        # of the tolerance of all that lies in front of the step's end, what was not spent there
        allowed = self.share * self.real.astype(part.dtype) * part - steps.spent
        width = self.at(steps.sample + 1) - self.at(steps.sample)
        least = greater(SHORTEST * width, RESOLVED * jnp.finfo(width.dtype).eps * jnp.abs(steps.far))
        enough = (difference <= allowed) | (steps.far - steps.near <= least)
        ended = steps._replace(known=jnp.ones_like(steps.known), at_far=found)
        halved = steps._replace(far=middle, step=middle - steps.near, at_far=found)
        spent = lesser(difference, greater(0, allowed))  # what the least step cannot help is not taken from others
        # after an accepted step comes one of the same length, or twice that if it was easy
        each = jnp.arange(steps.thickness.shape[0])[:, None]
        thickness = steps.thickness + jnp.where(each == steps.sample, taken, 0)
        sample = steps.sample + (steps.far >= self.at(steps.sample + 1))
        begin, end = self.at(sample), self.at(sample + 1)
        step = lesser(jnp.where(EASY * difference <= allowed, 2, 1) * steps.step, end - begin)
        far, known = jnp.where(end - steps.far < 1.5 * step, end, steps.far + step), jnp.zeros_like(steps.known)
        moved = steps._replace(sample=sample, near=steps.far, far=far, step=step, known=known, at_near=steps.at_far)
        moved = moved._replace(color=color, thickness=thickness, spent=steps.spent + spent)
        cases = (~steps.known, ended), (steps.known & ~enough, halved), (steps.known & enough, moved)
        for case, then in cases:
            steps = Steps(*(jnp.where(going & case, new, old) for new, old in zip(then, steps, strict=True)))
        return steps._replace(evaluations=steps.evaluations + going)

    def compared(self, steps: Steps, middle: Array) -> tuple[Array, Array, Array]:
        """Colour behind two halves of a step, the optical thickness of those, and how much more or less the full step shows."""
        path = (steps.far - steps.near) * self.slant
        whole, thickness = _light(steps.at_near, steps.at_far, path)
        (first, front), (second, back) = (_light(*ends, 0.5 * path) for ends in ((steps.at_near, middle), (middle, steps.at_far)))
        halves = first + jnp.exp(-front) * second
        left = jnp.exp(-steps.thickness.sum(0))
        of_color, through = whole - halves, jnp.expm1(-thickness) - jnp.expm1(-front - back)
        most = greater(jnp.abs(of_color), jnp.abs(of_color + through)).max(0)
        noise = -ROUNDING * jnp.finfo(path.dtype).eps * jnp.expm1(-thickness)
        difference = left * greater(0, greater(most, jnp.abs(through)) - noise)
        return steps.color + left * halves, front + back, difference

    def at(self, nth: Int[Array, " rays"]) -> Float[Array, " rays"]:
        """Depths of borders, of the last for those past it."""
        return jnp.take_along_axis(self.border, jnp.minimum(nth, self.border.shape[0] - 1)[None], 0)[0]


def _light(
    near: Float[Array, "4 rays"], far: Float[Array, "4 rays"], path: Float[Array, " rays"]
) -> tuple[Float[Array, "3 rays"], Float[Array, " rays"]]:
    """Colour and optical thickness between two points: extinction linear, colour their mean by extinction."""
    *emission, thickness = 0.5 * path * (near + far)
    share = jnp.where(thickness > 0, ratio(-jnp.expm1(-thickness), thickness), 1)  # of emission, what gets out
    return jnp.stack(emission) * share, thickness
