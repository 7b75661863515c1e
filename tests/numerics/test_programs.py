"""Programs are compiled once for the shapes they are given, the oldest are let go, and results come in the order of inputs."""

from __future__ import annotations

import jax.numpy as jnp
import pytest

from jaxsph.numerics import programs


class Doubler:
    """Stands in for a jitted function, and counts how often it is compiled."""

    compiled = 0

    def lower(self, *_, **__):
        return self

    def compile(self):
        self.compiled += 1
        return lambda value: 2 * value


@pytest.fixture(autouse=True)
def no_programs(monkeypatch):
    monkeypatch.setattr(programs, "_PROGRAMS", {})


def test_a_program_is_compiled_once_for_shapes_and_static_arguments():
    clock, double = programs.Clock(), Doubler()
    for value, static, wanted in ((jnp.ones(3), 1, 1), (jnp.zeros(3), 1, 1), (jnp.ones(4), 1, 2), (jnp.ones(3), 2, 3)):
        assert clock.run("cast", double, (value,), number=static).shape == value.shape
        assert double.compiled == wanted


def test_the_oldest_programs_are_let_go(monkeypatch):
    monkeypatch.setattr(programs, "MOST_PROGRAMS", 2)
    clock, double = programs.Clock(), Doubler()
    for size in (1, 2, 3, 2, 3, 1):
        clock.run("cast", double, (jnp.ones(size),))
    assert double.compiled == 4


@pytest.mark.parametrize("number", [1, 2, 5])
def test_results_come_in_the_order_of_inputs(number):
    clock = programs.Clock()
    found = clock.run_all("cast", Doubler(), [(jnp.float32(k),) for k in range(number)])
    assert [float(value) for value in found] == [2 * k for k in range(number)]
    assert clock.seconds["cast"] > 0 and clock.seconds["grid"] == 0
