"""Counts the programs that tests have JAX compile, or load from where they are kept: they are what takes the suite its time.

The numbers do not depend on how fast the machine is. Single operations on arrays are programs too: each is compiled in a
thirtieth of a second, and there can be thousands. `programs.json` beside the tests holds how many there may be in all, and for
each test file programs, operations and seconds of a run of the whole suite. `--hold-programs=FILE` fails a run that needs more
than such a table has, `--programs=FILE` writes one. The files that took longest are run first.
"""

from __future__ import annotations

import collections
import json
import time
from collections.abc import Iterator
from pathlib import Path

import jax.monitoring
import jax.numpy as jnp
import pytest
from jax import lax

EVENT = "/jax/core/compile/backend_compile_duration"
COUNTER = pytest.StashKey["Counter"]()
TABLE = Path(__file__).parent.parent / "programs.json"
IN_ALL = "in all"  # key of what a whole run by two processes may need: it may only fall
DAILY = "tests/engine/test_random_frames.py"  # draws other kinds of frames each day: held by its own row, not in all
SHARED = 60  # programs beyond its row that a file may need, as those of several files are counted where they are first needed


def is_operation(name: str) -> bool:
    """Whether a program is one operation of JAX's: `jit(add)`, `jit(_where)`."""
    name = name.removeprefix("jit(").removesuffix(")").lstrip("_")
    return hasattr(jnp, name) or hasattr(lax, name)


def read(table: Path) -> dict[str, list[int]]:
    """A table, or none where there is no file."""
    return json.loads(table.read_text(encoding="utf-8")) if table.exists() else {}


class Counter:
    """Programs, single operations and seconds by the test file that was the first to need them."""

    def __init__(self) -> None:
        self.found: dict[str, list[float]] = collections.defaultdict(lambda: [0, 0, 0.0])
        self.file, self.since = "", time.monotonic()

    def listen(self, event: str, _: float, fun_name: str = "", **more: str) -> None:
        """Called by JAX, from whichever thread compiles."""
        if event == EVENT:
            self.found[self.file][int(is_operation(fun_name))] += 1

    def begin(self, file: str) -> None:
        """What follows is of a file."""
        now = time.monotonic()
        self.found[self.file][2] += now - self.since
        self.file, self.since = file, now

    def add(self, found: dict[str, list[float]]) -> None:
        """What another process has counted."""
        for file, counts in found.items():
            self.found[file] = [a + b for a, b in zip(self.found[file], counts, strict=True)]

    def table(self) -> dict[str, list[int]]:
        """By file, those that took longest first."""
        rows = {file: [round(count) for count in counts] for file, counts in self.found.items() if file}
        return dict(sorted(rows.items(), key=lambda row: (-row[1][2], row[0])))

    def totals(self) -> tuple[int, int]:
        """Programs and operations, but for what is another each day."""
        found = [counts for file, counts in self.found.items() if file != DAILY]
        programs, operations, _ = (sum(column) for column in zip((0, 0, 0.0), *found, strict=True))
        return int(programs), int(operations)

    def excess(self, allowed: dict[str, list[int]]) -> list[str]:
        """What is more than a table allows."""
        told = [
            f"{file}: {programs} programs, of {allowed[file][0]}"
            for file, (programs, *_) in self.table().items()
            if file in allowed and programs > allowed[file][0] + SHARED
        ]
        pairs = zip(("programs", "single operations"), self.totals(), allowed[IN_ALL], strict=True)
        return told + [f"{number:,} {what} in all, of {most:,}" for what, number, most in pairs if number > most]


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
    group.addoption("--programs", type=Path, metavar="FILE", help="write programs, operations and seconds of each test file")
    group.addoption("--hold-programs", type=Path, metavar="FILE", help="fail where there are more than such a table has")


def pytest_configure(config):
    counter = config.stash[COUNTER] = Counter()
    jax.monitoring.register_event_duration_secs_listener(counter.listen)
    config.add_cleanup(lambda: jax.monitoring.unregister_event_duration_listener(counter.listen))


def pytest_collection_modifyitems(config, items):
    if config.getoption("--share", None) is not None:  # which has an order of its own
        return
    table = read(TABLE)
    items.sort(key=lambda item: -table.get(item.nodeid.partition("::")[0], (0, 0, 0))[2])  # stable: a file stays together


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    item.config.stash[COUNTER].begin(item.nodeid.partition("::")[0])


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session):
    config, counter = session.config, session.config.stash[COUNTER]
    counter.begin("")
    if hasattr(config, "workeroutput"):  # of a process that shares the tests with others
        config.workeroutput["programs"] = dict(counter.found)
        return
    if config.option.programs is not None:
        table = {IN_ALL: counter.totals()} | counter.table()
        rows = (f" {json.dumps(file)}: {json.dumps(counts)}" for file, counts in table.items())
        config.option.programs.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
    held = config.option.hold_programs
    if held is not None and counter.excess(read(held)) and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    node.config.stash[COUNTER].add(getattr(node, "workeroutput", {}).get("programs", {}))


def pytest_terminal_summary(terminalreporter, config):
    counter, held = config.stash[COUNTER], config.option.hold_programs
    if held is not None or config.option.programs is not None:
        terminalreporter.line("{:,} programs and {:,} single operations".format(*counter.totals()))
    if held is not None and (excess := counter.excess(read(held))):
        terminalreporter.section("more programs were compiled or loaded than may be")
        for line in excess:
            terminalreporter.line(line)
        terminalreporter.line(
            "Let new tests use the shapes of others (tests/conftest.py: Frames) and compute in NumPy; --programs=FILE tells more."
        )
