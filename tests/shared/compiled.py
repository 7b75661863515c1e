"""Counts the programs that tests have JAX compile, or load from where they are kept: they are what takes the suite its time.

The number does not depend on how fast the machine is. `--programs=FILE` writes it for each test file, as JSON, most first.
`--most-programs=N` fails a run that needed more. Operations that tests do on arrays by themselves are not counted: each is a
program too, but compiled in no time.
"""

from __future__ import annotations

import collections
import json
from collections.abc import Iterator
from pathlib import Path

import jax.monitoring
import jax.numpy as jnp
import pytest
from jax import lax

EVENT = "/jax/core/compile/backend_compile_duration"
COUNTER = pytest.StashKey["Counter"]()


def is_operation(name: str) -> bool:
    """Whether a program is one operation of JAX's: `jit(add)`, `jit(_where)`."""
    name = name.removeprefix("jit(").removesuffix(")").lstrip("_")
    return hasattr(jnp, name) or hasattr(lax, name)


class Counter:
    """Programs by the test file that was the first to need them."""

    def __init__(self) -> None:
        self.found: collections.Counter[str] = collections.Counter()
        self.file = ""

    def listen(self, event: str, _: float, fun_name: str = "", **more: str) -> None:
        """Called by JAX, from whichever thread compiles."""
        if event == EVENT and not is_operation(fun_name):
            self.found[self.file] += 1


@pytest.fixture
def compiled() -> Iterator[list[str]]:
    """Names of the programs that JAX compiles, or loads from where compiled ones are kept, from now on."""
    begun: list[str] = []

    def told(event: str, _: float, fun_name: str = "", **more: str) -> None:
        if event == EVENT:
            begun.append(fun_name)

    jax.monitoring.register_event_duration_secs_listener(told)
    yield begun
    jax.monitoring.unregister_event_duration_listener(told)


def pytest_addoption(parser):
    group = parser.getgroup("programs", "programs that tests have JAX compile")
    group.addoption("--programs", type=Path, metavar="FILE", help="write how many there are for each test file")
    group.addoption("--most-programs", type=int, metavar="N", help="fail where there are more in all")


def pytest_configure(config):
    counter = config.stash[COUNTER] = Counter()
    jax.monitoring.register_event_duration_secs_listener(counter.listen)
    config.add_cleanup(lambda: jax.monitoring.unregister_event_duration_listener(counter.listen))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    item.config.stash[COUNTER].file = item.nodeid.partition("::")[0]


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session):
    config = session.config
    found = config.stash[COUNTER].found
    if hasattr(config, "workeroutput"):  # of a process that shares the tests with others
        config.workeroutput["programs"] = dict(found)
        return
    if config.option.programs is not None:
        config.option.programs.write_text(json.dumps(dict(found.most_common()), indent=1) + "\n", encoding="utf-8")
    if is_over(config) and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def is_over(config: pytest.Config) -> bool:
    """Whether more programs were needed than may be."""
    most = config.option.most_programs
    return most is not None and config.stash[COUNTER].found.total() > most


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    node.config.stash[COUNTER].found.update(getattr(node, "workeroutput", {}).get("programs", {}))


def pytest_terminal_summary(terminalreporter, config):
    total = config.stash[COUNTER].found.total()
    if is_over(config):
        most = config.option.most_programs
        terminalreporter.section(f"{total} programs were compiled or loaded, more than the {most} that the suite may need")
        terminalreporter.line(
            "Let new tests use the shapes of others (tests/conftest.py: Frames); --programs=FILE tells which need most."
        )
    elif config.option.programs is not None or config.option.most_programs is not None:
        terminalreporter.line(f"{total} programs")
