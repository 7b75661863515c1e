"""A share of the tests: those whose names fall into one of several parts, as many as a budget of time allows.

`--share=RUN/N` keeps one of N parts: N runs, numbered one after the other, each with a part of its own, run every test once.
`--budget=SECONDS` starts no test later than that, and says at the end which were not run. Every run has another order, of files
and of the tests in them, so that a budget cuts off other tests when a part has its next turn.
"""

from __future__ import annotations

import argparse
import hashlib
import time

import pytest

LEFT = pytest.StashKey[list[str]]()
STARTED = pytest.StashKey[float]()


def share_of(text: str) -> tuple[int, int]:
    """`"RUN/N"` as two numbers."""
    try:
        run, parts = (int(number) for number in text.split("/"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not RUN/N, such as 481/8") from None
    if run < 0 or parts < 1:
        raise argparse.ArgumentTypeError(f"RUN must be 0 or more and N 1 or more, got {text!r}")
    return run, parts


def digest(text: str) -> int:
    """The same number on every machine and in every run."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def pytest_addoption(parser):
    group = parser.getgroup("share", "a share of the tests")
    group.addoption("--share", type=share_of, help="RUN/N: only that of N parts of the selected tests whose turn it is")
    group.addoption("--budget", type=float, help="seconds after which no test is started")


def pytest_configure(config):
    config.stash[LEFT], config.stash[STARTED] = [], time.monotonic()


def pytest_collection_modifyitems(config, items):
    share = config.getoption("--share")
    if share is None:
        return
    run, parts = share
    kept = [item for item in items if digest(item.nodeid) % parts == run % parts]
    kept.sort(key=lambda item: in_order(run, item.nodeid))
    chosen = set(kept)
    config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
    items[:] = kept


def in_order(run: int, name: str) -> tuple[int, int]:
    """Sorts tests by their names, anyhow and in every run otherwise; a file's tests stay together."""
    return digest(f"{run} {name.partition('::')[0]}"), digest(f"{run} {name}")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item):
    budget = item.config.getoption("--budget")
    if budget is None or time.monotonic() - item.config.stash[STARTED] <= budget:
        return None
    item.config.stash[LEFT].append(item.nodeid)
    return True


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):  # of a process that shares the tests with others
        session.config.workeroutput["left"] = session.config.stash[LEFT]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    node.config.stash[LEFT].extend(getattr(node, "workeroutput", {}).get("left", []))


def pytest_terminal_summary(terminalreporter, config):
    left = config.stash[LEFT]
    if left:
        terminalreporter.section(f"{len(left)} tests not run: the budget of {config.getoption('--budget'):g} s was spent")
        for name in sorted(left):
            terminalreporter.line(name)
