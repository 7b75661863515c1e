"""What the benchmark of table 2 takes out of error control breaks the tolerance where it should, and nowhere else."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from tools import tool

import jaxsph as js
from jaxsph.engine.control import adapt, bounds
from jaxsph.engine.control.errors import CANDIDATES, LEVELS, Candidates, CellErrors

table2 = tool("benchmarks", "table2")
TOLERANCE = table2.ABLATED_AT
SIZE, SAMPLES = 32, 128
SIDE, HALF = 14, 0.8  # particles along an edge of a unit cube; half of the picture's height: outer bundles are partly empty
RISE = 0.04  # of all colours from left to right: super-pixels of single cells keep the tolerance, and not all on a ray


def risen():
    """A cube whose colour rises from left to right, the same at any depth, so that errors of cells have one sign."""
    place = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5
    place += np.random.default_rng(3).uniform(-0.2, 0.2, place.shape)
    position = (place / SIDE - 0.5).astype(np.float32)
    particles = js.Particles.from_arrays(position, 2.4 / SIDE, position[:, 0] + 0.5)
    transfer = js.TransferFunction.from_points([0.0, 1.0], [((1 - RISE) / 2,) * 3, ((1 + RISE) / 2,) * 3], [2.0, 2.0])
    size = {"width": SIZE, "height": SIZE, "near": 19.5, "far": 20.5}
    camera = js.Camera.look_at((0, 0, 20), (0, 0, 0), (0, 1, 0), float(np.degrees(2 * np.arctan(HALF / 20))), **size)
    return js.Scene(particles=particles, transfer=transfer), camera


@pytest.mark.slow
def test_only_contenders_without_a_part_break_the_tolerance():
    some = table2.contenders([TOLERANCE])
    rows = table2.measure("risen", risen(), SAMPLES, 1, some)
    assert [row["contender"] for row in rows] == [one.name for one in some]
    of = {row["contender"]: row for row in rows}
    assert all(table2.is_kept(row) for row in rows)
    assert {name for name, row in of.items() if row["over"]} == set(table2.BREAKING)
    assert of["relaxed"]["coarser"] > 0
    assert of["no greedy"]["coarser"] > of["relaxed"]["coarser"]
    assert of["full rate"]["speed_total"] == 1
    assert all(row[stage] > 0 for row in rows for stage in ("cast", "total", "speed_cast"))
    assert all(table2.line(row) for row in rows)


def test_without_greedy_each_cell_takes_the_whole_tolerance():
    error = jnp.full((CANDIDATES, 3, 2), 0.6 * TOLERANCE).at[0].set(0).at[-1, 0].set(2 * TOLERANCE)
    saving = jnp.arange(CANDIDATES, dtype=jnp.float32)[:, None, None] * jnp.ones((1, 3, 2))
    error, saving, offered = (Candidates(one[:LEVELS], one[LEVELS:]) for one in (error, saving, jnp.ones(error.shape, bool)))
    errors = CellErrors(error, error.levels, jnp.zeros((4, 1, 3, 2)), jnp.zeros((1, 3, 2)))
    given = errors, saving, offered, jnp.zeros(2), jnp.float32(TOLERANCE)
    best = CANDIDATES - 1
    chosen, painted = table2.independent(*given, "greedy")
    np.testing.assert_array_equal(chosen, [[best - 1] * 2, [best] * 2, [best] * 2])
    np.testing.assert_array_equal(painted[0], chosen == best)
    assert ((adapt.choose(*given, "greedy")[0] > 0).sum(0) == 1).all()
    assert ((adapt.choose(*given, "budget")[0] > 0).sum(0) <= 1).all()


def test_without_surfaces_whatever_is_touched_is_covered():
    touched, covered = jnp.asarray([True, True, False]), jnp.asarray([True, False, False])
    proven = bounds.SampleBounds(touched, covered, [touched * 0.5], [touched * 1.0])
    taken = table2.taken_for_covered(0, of=lambda _: proven)
    np.testing.assert_array_equal(taken.covered, touched)
    assert taken.lo is proven.lo
    assert taken.hi is proven.hi


def test_their_rows_have_the_speed_ups_they_print():
    printed = {("flubber", "relaxed", 0.004): (1.5, 1.3), ("letters", "relaxed", 0.004): (1.66, 1.32)}
    printed |= {("mixer", "no greedy", 0.004): (2.45, 1.79), ("radial", "only z", 0.004): (1.54, 1.28)}
    for (scene, name, tolerance), speeds in printed.items():
        row = table2.theirs(scene, table2.Contender(name, tolerance))
        assert (round(row["speed_cast"], 2), round(row["speed_total"], 2)) == speeds
    assert table2.theirs("checker_board, frame 0", table2.Contender("relaxed", 0.004)) is None


def test_committed_rows_are_those_that_the_script_makes():
    found = json.loads((table2.RESULTS / "table2.json").read_text(encoding="utf-8"))
    assert {"commit", "device", "date", "dtype", "load"} <= found["run"].keys()
    assert {"size", "samples"} <= found.keys()
    made = [(one.name, one.tolerance) for one in table2.contenders()]
    for scene in {row["scene"] for row in found["records"]}:
        assert [(row["contender"], row["tolerance"]) for row in found["records"] if row["scene"] == scene] == made
