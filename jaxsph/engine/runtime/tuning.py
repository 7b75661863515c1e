"""Sizes of batches and other choices that suit a kind of machine, CPUs or accelerators, all in one place.

Flow: [tuning] -> plan -> stages.

No number here changes what an image shows: it is the same bit for bit where kernels round alike, and to rounding anywhere.

On CPUs batches are small, so that operands stay in the caches, of 1 MB (second level) and some 16 MB (third) a core; and kernels
are few, as each is compiled to machine code of its own. On an accelerator every launch costs a few microseconds whatever it does,
and each decision of the host a round trip: so batches are as large as memory allows, and there are no fusion barriers, which are
branches.
"""

from __future__ import annotations

import dataclasses
import os

from jaxtyping import Array

from jaxsph.numerics.checks import require_sizes

MAX_SHARDS = 64  # of a band
BUNDLES_OF_TILE = 4  # so many shards divide any band


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Sizes of batches, for one kind of machine.

    Attributes:
        samples_at_once: samples along depth, each of 64 rays, whose sums are accumulated together: a chunk.
        samples_held: samples whose light is held before it is composited: a batch.
        bundles_composited: bundles of a layer of slabs that are composited together.
        half_depths_found: bundles among these whose depths of half transmittance are computed together.
        cells_of_nodes: cells of a lattice whose sums are accumulated together.
        cells_bounded: cells whose errors are bounded together.
        slabs_bounded: slabs whose errors are bounded together.
        bundles_decided: bundles whose slabs are decided together.
        max_sorts: sorts that run side by side.
        pairs_per_sort: the least number of pairs for which another sort beside the others saves more time than it costs.
        max_shards: the most shards of a band that run side by side.
        turns: about the most turns in which a quadtree casts all bundles of a band; arrays have room for the bundles of one.
        sorts_on_host: whether NumPy sorts and selects particles on the host, between programs; never under a trace.
        common_particles, common_pairs: sizes of arrays, smallest first, that eager frames share, so that files of any size share
            programs; empty where arrays are about as large as each frame needs.
        fusion_barriers: whether there are barriers against XLA's fusion (`numerics.compiled`), and two sums travel as one complex
            number (`field.sums`).
    """

    samples_at_once: int
    samples_held: int
    bundles_composited: int
    half_depths_found: int
    cells_of_nodes: int
    cells_bounded: int
    slabs_bounded: int
    bundles_decided: int
    max_sorts: int
    pairs_per_sort: int
    max_shards: int
    turns: int
    sorts_on_host: bool
    fusion_barriers: bool
    common_particles: tuple[int, ...] = ()
    common_pairs: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        require_sizes(self)


CPU = Tuning(
    samples_at_once=1 << 10,  # accumulators and operands of a batch stay in the second-level cache
    samples_held=1 << 15,  # stays in the third-level cache
    bundles_composited=256,
    half_depths_found=32,
    cells_of_nodes=256,
    cells_bounded=512,  # operands stay in the second-level cache
    slabs_bounded=1024,
    bundles_decided=1024,
    max_sorts=16,  # 16 sorts of 5 M pairs in all took 0.8 of 4, as each stays in the caches
    pairs_per_sort=1 << 15,
    max_shards=MAX_SHARDS,  # two threads in one program were 1.1 to 1.3 times as fast as one, two programs side by side 1.9 times
    turns=16,
    sorts_on_host=True,  # 1 M particles in 20 ms instead of 45, their lists in 0.2 s of one core instead of 0.4
    fusion_barriers=True,  # without them shading was computed six times, and every weight once for each sum
    common_particles=(1 << 16, 1 << 18, 1 << 20),  # an entry of padding takes 0.1 us
    common_pairs=(1 << 22, 1 << 24),  # lists that the host makes never touch room that is not filled
)
ACCELERATOR = Tuning(
    samples_at_once=1 << 20,  # some 60 M samples a kernel: 2,400 launches for a frame of 1 M particles, of 694,000
    samples_held=1 << 20,
    bundles_composited=1 << 16,  # a layer of 2048 x 2048 pixels
    half_depths_found=1 << 16,
    cells_of_nodes=1 << 14,
    cells_bounded=1 << 14,
    slabs_bounded=1 << 16,
    bundles_decided=1 << 16,
    max_sorts=1,
    pairs_per_sort=1 << 15,
    max_shards=1,
    turns=1,
    sorts_on_host=False,
    fusion_barriers=False,
)
MEMORY = 4 << 30  # bytes that a frame's working arrays may take on CPUs, whose memory other processes need as well
SHARE_OF_DEVICE = 0.5  # of an accelerator's memory, that a frame's working arrays may take


def tuning_for(array: Array) -> Tuning:
    """The tuning of the device that holds `array`."""
    return CPU if all(device.platform == "cpu" for device in array.devices()) else ACCELERATOR


def memory_for(array: Array) -> int:
    """Bytes that a frame may take on the device that holds `array`: `MEMORY` on CPUs, else a share of the device's memory."""
    limits = [(device.memory_stats() or {}).get("bytes_limit") for device in array.devices() if device.platform != "cpu"]
    return min((int(SHARE_OF_DEVICE * limit) for limit in limits if limit), default=MEMORY)


def cores_at_hand() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def shards_at_hand(tuning: Tuning, bundles: int = BUNDLES_OF_TILE) -> int:
    """How many shards run side by side: the largest power of two that cores and `max_shards` allow and that divides `bundles`."""
    return min(tuning.max_shards, 1 << (cores_at_hand().bit_length() - 1), bundles & -bundles)
