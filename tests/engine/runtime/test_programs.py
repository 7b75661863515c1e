"""Programs are compiled once for the shapes they are given, the least recently used are let go and free what they held."""

from __future__ import annotations

import gc
import warnings
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsph.engine.runtime import programs
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.programs import Programs, shapes_of, stage

traces = []


@jax.jit
def double(value):
    traces.append(value.shape)
    return 2 * value


@stage(quickly=True)
def settle(value):
    """Some kernels, in a loop, so that memory maps are seen to come and go."""
    return jax.lax.fori_loop(0, 3, lambda _, x: jnp.sort(x)[::-1] + jnp.cumsum(jnp.sin(x)), value)


@pytest.fixture(autouse=True)
def no_traces():
    """Nor what earlier tests have left: to collect it again and again is what would take long."""
    traces.clear()
    gc.freeze()
    yield
    gc.unfreeze()


def ones(size, dtype=np.float32):
    return np.ones(size, dtype)


def test_the_least_recently_used_programs_are_let_go():
    clock = Clock(programs=Programs(most=2))
    for size in (1, 2, 1, 3, 1, 2):
        clock.one("cast", double, (ones(size),))
    assert traces == [(1,), (2,), (3,), (2,)], "1 is used all the time and never compiled again"


def test_programs_that_are_let_go_give_their_memory_maps_back():
    """Even where JAX has them in caches of its own: these hold on to functions weakly, and every program is a function."""
    kept = Programs()
    with jax.default_device(jax.devices("cpu")[0]):  # what an accelerator runs is in its own memory
        Clock(programs=kept).one("cast", settle, (ones(5),))
        kept.clear()
        before = programs.in_use() or 0
        for size in range(10, 15):
            Clock(programs=kept).one("cast", settle, (ones(size),))
        held = (programs.in_use() or 0) - before
        kept.clear()
    left = (programs.in_use() or 0) - before
    assert held >= 5 * 3 or programs.in_use() is None
    assert left <= held // 5


def test_a_crowded_process_lets_go_of_all_programs_and_says_so_once(monkeypatch):
    kept, let_go = Programs(), []
    double(ones(6))  # in a cache of JAX's, which others may need
    Clock(programs=kept).one("cast", double, (ones(7),))
    monkeypatch.setattr(programs, "_LET_GO", [lambda: let_go.append(len(kept))])  # instead of what others hold
    monkeypatch.setattr(programs, "limit", lambda: 1)
    monkeypatch.setattr(programs, "in_use", lambda: 1)
    with pytest.warns(UserWarning, match=r"memory maps.*not jaxsph's own.*jax\.clear_caches"):
        Clock(programs=kept).one("cast", double, (ones(8),))
    assert len(kept) == 1 and let_go == [0], "those of caches go where those that are kept are not enough"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert float(Clock(programs=kept).one("cast", double, (ones(9),)).sum()) == 18
    told = len(traces)
    double(ones(6))
    assert len(traces) == told


def test_where_no_limit_is_known_nothing_is_crowded(monkeypatch, tmp_path):
    monkeypatch.setattr(programs, "LIMIT", tmp_path / "absent")
    monkeypatch.setattr(programs, "IN_USE", tmp_path / "absent")
    assert programs.in_use() is None and programs.limit() is None and not programs.crowded()


def test_another_c_library_is_no_error(monkeypatch):
    monkeypatch.setattr(programs.ctypes, "CDLL", lambda _: object())
    programs.give_back()


def test_programs_are_compiled_anew_under_another_flag_of_jax():
    ours = Programs()
    double = jax.jit(lambda x: 2 * x)
    given = shapes_of((np.ones(3, np.float32),))
    kept = ours.get(double, given, {})
    assert ours.get(double, given, {}) is kept and kept.compiled.result()
    for context in (jax.default_matmul_precision("highest"), jax.debug_nans(True), jax.default_device(jax.devices()[0])):
        with context:
            another = ours.get(double, given, {})
            assert another is not kept and another.compiled.result()


def test_on_the_cpus_beside_an_accelerator_programs_are_compiled_with_what_is_for_cpus(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    asked = []
    monkeypatch.setattr(programs, "_compile", lambda lowered, options: asked.append(options) or lowered.compile())
    here = jax.devices("cpu")[0]
    doubled = programs.stage(quickly=True)(lambda x: 2 * x)
    shapes = shapes_of((ones(3),))
    with jax.default_device(here):
        Programs().get(doubled, shapes, {}).compiled.result()
    Programs().get(doubled, shapes_of((ones(3),), jax.sharding.SingleDeviceSharding(here)), {}).compiled.result()
    Programs().get(doubled, shapes, {}).compiled.result()
    assert asked == [programs.QUICKLY, programs.QUICKLY, {}]


def test_of_options_that_xla_no_longer_has_the_others_are_kept():
    lowered = jax.jit(lambda x: 2 * x).lower(np.ones(3, np.float32))
    with mock.patch.object(lowered, "compile", wraps=lowered.compile) as compiled:
        programs._compile(lowered, {"xla_no_longer": 1} | programs.WIDELY)
    assert compiled.call_args.kwargs == {"compiler_options": programs.WIDELY}
