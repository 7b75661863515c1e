"""A share of the tests: those whose names fall into one of several parts, as many as a budget of time allows.

`--share=K/N` keeps the K-th of N parts (K from 0), so that N runs with another K each run every test once. `--budget=SECONDS`
starts no test later than that, and says at the end which were not run. Files come in another order for every K: what a budget
cuts off is not always the same.
"""

from __future__ import annotations

import argparse
import hashlib
import time

import pytest

LEFT = pytest.StashKey[list[str]]()
STARTED = pytest.StashKey[float]()


def share_of(text: str) -> tuple[int, int]:
    """`"K/N"` as two numbers."""
    try:
        which, parts = (int(number) for number in text.split("/"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not K/N, such as 0/8") from None
    if not 0 <= which < parts:
        raise argparse.ArgumentTypeError(f"K must lie in 0 .. N - 1, got {text!r}")
    return which, parts


def digest(text: str) -> int:
    """The same number on every machine and in every run."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def pytest_addoption(parser):
    group = parser.getgroup("share", "a share of the tests")
    group.addoption("--share", type=share_of, help="K/N: only the K-th of N parts of the tests that are selected")
    group.addoption("--budget", type=float, help="seconds after which no test is started")


def pytest_configure(config):
    config.stash[LEFT], config.stash[STARTED] = [], time.monotonic()


def pytest_collection_modifyitems(config, items):
    share = config.getoption("--share")
    if share is None:
        return
    which, parts = share
    kept = [item for item in items if digest(item.nodeid) % parts == which]
    kept.sort(key=lambda item: digest(f"{which} {item.path.name}"))  # stable: a file's tests stay together
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = kept


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
