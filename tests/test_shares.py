"""How the suite is shared out over runs, counted, and kept compiled: what `tests/shared` adds to pytest."""

import argparse
import itertools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import Counter
from core import BEYOND, TESTS
from examples import USUAL, examples
from kept_programs import folder, trim
from share import in_order, share_of

SHARED = Path(__file__).parent / "shared"
FILES = {f"test_{name}.py": 20 for name in "abcd"}
NAMES = {f"{file}::test_{number}" for file, count in FILES.items() for number in range(count)}


def pytest_on(folder, *arguments, plugin="share"):
    """Run pytest by itself, with one of our plugins."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_ADDOPTS"} | {"PYTHONPATH": str(SHARED)}
    command = [sys.executable, "-m", "pytest", "-p", plugin, "-p", "no:cacheprovider", "-p", "no:hypothesispytest", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    made = tmp_path_factory.mktemp("suite")
    for file, count in FILES.items():
        (made / file).write_text("".join(f"def test_{number}(): pass\n" for number in range(count)))
    return made


def collected(suite, *arguments):
    said = pytest_on(suite, "--collect-only", "-q", *arguments).stdout
    return [line for line in said.splitlines() if "::" in line]


def test_runs_one_after_the_other_run_every_test_once(suite):
    runs = [collected(suite, f"--share={run}/3") for run in (481, 482, 483)]
    assert sorted(itertools.chain(*runs)) == sorted(NAMES) and min(map(len, runs)) > 10


def test_at_its_next_turn_a_part_comes_in_another_order():
    """By many runs, each of a budget for ten tests only, all tests of a part are run."""
    names = sorted(NAMES)
    reached = set()
    for run in range(0, 320, 8):
        ordered = sorted(names, key=lambda name: in_order(run, name))
        files = [name.partition("::")[0] for name in ordered]
        assert sum(one != next for one, next in itertools.pairwise(files)) == len(FILES) - 1  # stay together
        reached.update(ordered[:10])
    assert reached == NAMES


def test_what_a_budget_cuts_off_is_named(suite):
    ran = pytest_on(suite, "-q", "--share=0/1", "--budget=0")
    assert ran.returncode == 0 and f"{len(NAMES)} tests not run" in ran.stdout
    assert all(name in ran.stdout for name in NAMES)


@pytest.mark.parametrize("text", ["1", "a/b", "-1/8", "0/0"])
def test_a_share_that_is_none_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match=re.escape(repr(text))):
        share_of(text)


def test_programs_and_operations_are_counted_for_the_file_that_needed_them():
    counter = Counter()
    counter.begin("tests/test_x.py")
    jax.monitoring.register_event_duration_secs_listener(counter.listen)
    try:
        twice = jax.jit(lambda x: jnp.sin(x) * 2)
        for size in (3, 4, 3):
            twice(np.zeros(size, np.float32))
        jnp.arcsinh(jnp.float32(2))
    finally:
        jax.monitoring.unregister_event_duration_listener(counter.listen)
    (programs, operations, _) = counter.table()["tests/test_x.py"]
    assert programs == 2 and operations in (0, 1, 2)  # others may have needed them before


def test_a_run_that_needs_more_programs_than_it_may_fails(tmp_path):
    (tmp_path / "test_it.py").write_text("import jax\ndef test_it(): jax.jit(lambda x: x)(1.0), jax.jit(lambda x: -x)(1.0)\n")
    table = tmp_path / "table.json"
    for most, code in ((1, 1), (2, 0)):
        table.write_text(json.dumps({"in all": [most, 10]}))
        ran = pytest_on(tmp_path, f"--hold-programs={table}", plugin="compiled")
        assert ran.returncode == code and "2 programs and" in ran.stdout
        assert ("2 programs in all, of 1" in ran.stdout) == bool(code)


def test_what_is_beyond_the_core_is_there():
    assert BEYOND and not [name for name in BEYOND if not (TESTS / name).exists()]


def test_programs_are_kept_apart_by_processor_and_workers_and_what_was_used_last_stays(tmp_path):
    places = {folder(tmp_path, workers, runs_on) for workers in ("0", "2") for runs_on in ("one", "other")}
    assert len(places) == 4
    for age, place in enumerate(sorted(places)):
        place.mkdir()
        (place / "program").write_bytes(bytes(100))
        os.utime(place / "program", (1e9 - age, 1e9 - age))
    trim(tmp_path, 250)
    assert sorted(file.parent for file in tmp_path.rglob("program")) == sorted(places)[:2]


@pytest.mark.parametrize(("profile", "times"), [("dev", 1), ("ci", 1), ("nightly", 10)])
def test_at_night_every_test_tries_ten_times_the_examples(profile, times):
    try:
        hypothesis.settings.load_profile(profile)
        assert examples(15).max_examples == 15 * times and examples(15).deadline is None
        assert hypothesis.settings().derandomize is (profile == "ci")
    finally:
        hypothesis.settings.load_profile(USUAL)
