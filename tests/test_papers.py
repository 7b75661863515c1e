"""The page of the papers keeps its word: what it names is there, and every section and equation has a line."""

import re
from pathlib import Path

import pytest
from named import definitions, identifiers, missing, quoted

PAGE = (Path(__file__).parent.parent / "docs" / "papers.md").read_text(encoding="utf-8")
ASKED = {  # what the project was asked for, and what functions that hold it call, or its tests
    "vmapped per-bundle interval compositing": ({"vmap", "scan"}, set()),
    "hypothesis property tests asserting bundle bounds always enclose sampled pixels": (set(), {"given", "lower", "upper"}),
    "grid binning (segment sort)": ({"sort"}, set()),
    "lax.scan greedy optimisation": ({"scan"}, {"given"}),
    "jit-compiled ray casting": ({"jit", "stage"}, set()),
    "error-against-tolerance sweeps": ({"tolerances"}, set()),
}
STATES = "**as there**", "**otherwise**", "**in part**", (NOT_HERE := "**not here**")
PAPERS = {  # sections, and equations
    "Hochstetter": ("2.1 2.2 3 4.1 4.2 4.3 4.4 5.1 5.2 5.3 6.1 6.2 6.3 7", 8),
    "Kratz": ("2.1 2.2 3 4 5 6 7.1 7.2 7.3 7.4 8", 11),
    "Kähler": ("3 3.1 3.2 4 5", 4),
}


def rows(text):
    """Cells of the rows of all tables of a text, without heads."""
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    rules = [{*cells[0]} <= {*"-|"} for cells in lines]
    return [cells for cells, rule, after in zip(lines, rules, [*rules[1:], False], strict=True) if not (rule or after)]


def part(heading):
    """What stands under a heading, its name beginning so, down to the next of its kind."""
    (found,) = (one for one in re.split(r"^## ", PAGE, flags=re.MULTILINE) if one.startswith(heading))
    return found


def test_what_the_page_names_is_there():
    names = quoted(PAGE)
    assert not missing(names) and len(names) > 200
    tests = [name for name in names if name.startswith("test_")]
    assert len(tests) > 90
    assert not [name for name in tests if len(definitions()[name]) > 1], "of two of one name either could go"


@pytest.mark.parametrize("name", [
    "js.scaffold", "adapt.scaffold", "Settings.scaffold", "choose.choose", "scaffold", "test_scaffold", '"scaffolding"',
    "benchmarks/scaffold.py", "tests/engine/test_scaffold.py", "make scaffold", "lax.scaffold", "allocation.choose(",
    'screen="scaffolding"', 'scaffold="quadtree"',
])  # fmt: skip
def test_names_that_are_nowhere_are_told(name):
    there = {"js.bracket", "allocation.choose", "Settings.relax", "choose", '"greedy"', "benchmarks/trade.py", "make test"}
    assert missing(there | {name}) == [name]


@pytest.mark.parametrize("sentence", ASKED)
def test_what_was_asked_for_has_functions_and_tests(sentence):
    """Functions that do what it says, and tests of them."""
    (row,) = (cells for cells in rows(part("What was asked for")) if cells[0].strip("*") == sentence)
    nodes = [node for name in quoted(row[1]) for node in definitions().get(name.removeprefix("js."), [])]
    tests = [node for name in quoted(row[2]) for node in definitions()[name]]
    assert nodes and tests and all(node.name.startswith("test_") for node in tests)
    for found, used in zip((nodes, tests), ASKED[sentence], strict=True):
        assert used <= {name for node in found for name in identifiers(node)}, [node.name for node in found]


@pytest.mark.parametrize("paper", PAPERS)
def test_every_section_and_equation_has_a_line(paper):
    sections, equations = PAPERS[paper]
    found = rows(part(paper))
    met = {word.strip(",;") for cells in found for word in cells[0].split()}
    assert met >= set(sections.split())
    numbers = [list(map(int, re.findall(r"\d+", text))) for cells in found for text in re.findall(r"\(([\d, -]+)\)", cells[0])]
    told = {number for ends in numbers for number in range(min(ends), max(ends) + 1)}
    assert told >= set(range(1, equations + 1))


def test_every_line_says_what_is_here_and_names_it():
    found = [cells for paper in PAPERS for cells in rows(part(paper))]
    assert len(found) > 90 and {len(cells) for cells in found} == {4}
    for _, what, where, state in found:
        assert state.startswith(STATES), what
        assert quoted(where) or state.startswith(NOT_HERE), what
