"""Marks the core of the suite, `-m core`: what `make check` runs, in a minute and a half.

A test file is in it unless `beyond_core.txt` names it, which lists those that need many programs (`--programs`) or try files by
the hundred; of these it has the tests that are marked `core` by hand, one for each promise. Slow tests are never in it.
"""

from __future__ import annotations

from pathlib import Path

import pytest

TESTS = Path(__file__).parent.parent
BEYOND = frozenset(Path(__file__).with_name("beyond_core.txt").read_text(encoding="utf-8").split())
LATER = "slow", "notebook", "endurance"


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items):
    for item in items:
        late = any(item.get_closest_marker(name) for name in LATER)
        if not late and item.path.relative_to(TESTS).as_posix() not in BEYOND:
            item.add_marker("core")
