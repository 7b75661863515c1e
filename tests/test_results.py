"""Results can be made again: each is a part of a table that goes on where it was interrupted, and says what fails."""

import ast
import builtins
import json
import pathlib
import re
import shlex
import signal
import subprocess
import sys

import pytest
from figures import blocks, figures, measured, unmeasured, unnamed
from tools import ROOT, tool

run_all = tool("benchmarks", "run_all")
parts = run_all.parts
NOW = "the commit of now"


def options(script):
    """Options that a script's parser knows, and whether it takes anything besides, read from its code."""
    tree = ast.parse((parts.HERE / script).read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "add_argument"]
    names = {argument.value for call in calls for argument in call.args if isinstance(argument, ast.Constant)}
    return {name for name in names if name.startswith("-")}, {name for name in names if not name.startswith("-")}


@pytest.fixture
def table(tmp_path, monkeypatch):
    """Three parts, of which nothing is run: what each command does is in a dictionary, by name of the part."""
    some = tuple(parts.script(name, 30) for name in ("first", "second", "third"))
    does = {}

    def ran(command, environment, log):
        name = command.split(".py")[0]
        does["ran"] = [*does.get("ran", []), name]
        if name in does.get("interrupted", []):
            raise KeyboardInterrupt
        run = {"commit": NOW, "date": "2026-01-01", "seconds": 7200, "load": [does.get("load", 0.1)], "cores": 2}
        (tmp_path / f"{name}.json").write_text(json.dumps({"run": run}))
        return does.get("status", {}).get(name, 0)

    monkeypatch.setattr(parts, "RESULTS", tmp_path)
    monkeypatch.setattr(parts, "is_of_this_code", lambda commit, part: commit == NOW)
    monkeypatch.setattr(run_all, "PARTS", some)
    monkeypatch.setattr(run_all, "LOGS", tmp_path / "logs")
    monkeypatch.setattr(run_all, "RECORD", tmp_path / "logs" / "record.json")
    monkeypatch.setattr(run_all, "commit", lambda: NOW)
    monkeypatch.setattr(run_all, "run", ran)
    monkeypatch.setattr(run_all, "write_page", lambda: None)
    return does


def main(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["run_all.py", *words])
    handler = signal.getsignal(signal.SIGTERM)
    try:
        return run_all.main()
    finally:
        signal.signal(signal.SIGTERM, handler)


def test_an_interrupted_run_goes_on_where_it_was(table, monkeypatch, capsys):
    table["interrupted"] = ["second"]
    assert main(monkeypatch) == 130
    assert "3 of 3 parts to run, 1.5 h in all" in capsys.readouterr().out
    assert [run_all.state(part) for part in run_all.PARTS] == ["done", "interrupted", "never run"]
    table["interrupted"], table["ran"] = [], []
    assert main(monkeypatch) == 0
    assert table["ran"] == ["second", "third"]
    assert "part 1 of 2, second: about 30 min, then 30 min for the others" in capsys.readouterr().out
    assert main(monkeypatch) == 0 and table["ran"] == ["second", "third"]
    assert main(monkeypatch, "third") == 0 and table["ran"] == ["second", "third", "third"]
    assert main(monkeypatch, "--list") == 0
    assert "2.0 h" in capsys.readouterr().out.splitlines()[-1], "as long as the last time"
    table["load"] = 20
    assert main(monkeypatch, "third") == 0 and main(monkeypatch, "third", "--list") == 0
    assert "30 min" in capsys.readouterr().out.splitlines()[-1], "on a busy machine"


def test_a_claim_that_fails_is_told_last(table, monkeypatch, capsys):
    table["status"] = {"first": 1}
    assert main(monkeypatch) == 1
    assert table["ran"] == ["first", "second", "third"]
    assert capsys.readouterr().out.splitlines()[-1].startswith("first: a claim does not hold")
    table["ran"] = []
    assert main(monkeypatch) == 1 and table["ran"] == []


def test_what_an_interrupted_sweep_measured_is_kept(table, monkeypatch):
    swept = parts.trade("swept", 1, "")
    monkeypatch.setattr(run_all, "PARTS", (swept,))
    monkeypatch.setattr(run_all, "run", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    row = parts.RESULTS / "swept" / "sweep.jsonl"
    row.parent.mkdir()
    row.touch()
    assert main(monkeypatch) == 130 and not row.exists(), "of other code"
    row.parent.mkdir()
    row.touch()
    assert main(monkeypatch) == 130 and row.exists(), "of this code"


def test_parts_that_lack_something_are_left_out(table, monkeypatch, capsys, tmp_path):
    lacking = parts.script("lacking", 1, f"{parts.DATA}/mixer_001.npz --peer-python {parts.PEER}", packages=("no_such_package",))
    monkeypatch.setattr(run_all, "PARTS", (lacking,))
    assert main(monkeypatch) == 0 and "ran" not in table
    told = capsys.readouterr().out.splitlines()[-1]
    assert all(word in told for word in ("mixer_001.npz", "no_such_package", "--peer-python", "left out"))
    (tmp_path / "mixer_001.npz").touch()
    assert lacking.lacks(tmp_path, "python3") == ["Python packages: no_such_package"]


def test_a_script_is_shown_logged_and_ended(tmp_path, monkeypatch, capsys):
    script = tmp_path / "benchmarks" / "waiting.py"
    script.parent.mkdir()
    script.write_text("import sys, time\nprint('begun')\nif len(sys.argv) == 1:\n    time.sleep(600)\nsys.exit(3)\n")
    monkeypatch.setattr(parts, "ROOT", tmp_path)
    environment = {"PYTHONUNBUFFERED": "1"}
    assert run_all.run("waiting.py now", environment, tmp_path / "log") == 3
    assert capsys.readouterr().out == "  begun\n" and "begun" in (tmp_path / "log").read_text()
    processes = []

    class Interrupted(subprocess.Popen):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            self.stdout = self.lines(self.stdout)
            processes.append(self)

        def lines(self, pipe):
            yield pipe.readline()
            raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_all.run("waiting.py", environment, tmp_path / "log")
    assert processes[0].returncode is not None, "it still runs"


def test_code_that_changed_makes_results_old(monkeypatch):
    part = parts.script("trade", 1)
    assert {"trade.py", "peers.py", "workloads.py"} <= set(parts.sources("trade.py"))
    asked = []

    def diff(command, **_):
        asked.append(command)
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setattr(subprocess, "run", diff)
    assert not parts.is_of_this_code("abc", part)
    assert {"abc", "jaxsph", "benchmarks/trade.py", "benchmarks/peers.py"} <= set(asked[0])
    assert not parts.is_of_this_code("abc-dirty", part) and not parts.is_of_this_code(None, part) and len(asked) == 1


@pytest.mark.parametrize("part", parts.PARTS, ids=[part.name for part in parts.PARTS])
def test_commands_are_those_that_scripts_take(part):
    for command in part.commands:
        script, *words = shlex.split(command)
        known, places = options(script)
        named = {word for word in words if word.startswith("-")}
        assert named <= known, f"{script} has no {named - known}"
        assert places or not words or words[0].startswith("-"), f"{script} takes no file or scene"
    assert set(part.files) <= parts.FILES.keys()


def test_every_result_is_made_by_a_part():
    made = {part.result.name for part in parts.PARTS}
    assert len(made) == len(parts.PARTS)
    assert {file.name for file in parts.RESULTS.glob("*.json")} <= made
    writing = {file.name for file in parts.HERE.glob("*.py") if "keep(" in file.read_text(encoding="utf-8")} - {"kept.py"}
    assert writing == {script for part in parts.PARTS for script in part.scripts}


@pytest.mark.parametrize("script", sorted({script for part in parts.PARTS for script in part.scripts}))
def test_scripts_use_no_name_that_is_nowhere(script):
    """What fails after an hour of measuring, when results are written: names of their functions are looked up then."""
    tree = ast.parse((parts.HERE / script).read_text(encoding="utf-8"))
    known = {*dir(builtins), "__file__", "__doc__"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            known |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            known.add(node.name)
        elif isinstance(node, ast.arg):
            known.add(node.arg)
        elif isinstance(node, ast.ExceptHandler) and node.name:
            known.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            known.add(node.id)
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    assert used <= known, used - known


def bound(node):
    """Names that a statement of a module binds."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    if isinstance(node, ast.Import | ast.ImportFrom):
        return {(alias.asname or alias.name).split(".")[0] for alias in node.names}
    return {name.id for name in ast.walk(node) if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)}


def evaluated(script, expression):
    """An expression in a script's names, of whose statements only those run that it takes: no contender has to be installed."""
    body = ast.parse((parts.HERE / script).read_text(encoding="utf-8")).body
    statements = [node for node in body if isinstance(node, ast.Assign | ast.AnnAssign | ast.FunctionDef | ast.ClassDef)]
    statements += [node for node in body if isinstance(node, ast.Import | ast.ImportFrom)]
    needed, waiting = [], [expression]
    while waiting:
        used = {name.id for name in ast.walk(waiting.pop()) if isinstance(name, ast.Name)}
        more = [node for node in statements if bound(node) & used and node not in needed]
        needed += more
        waiting += more
    names = {"__file__": str(parts.HERE / script), "__name__": __name__}
    future = ast.parse("from __future__ import annotations").body
    exec(compile(ast.Module(future + [node for node in body if node in needed], []), script, "exec"), names)
    return eval(compile(ast.Expression(expression), script, "eval"), names)


def variants(script):
    """Names of all variants that a script makes: its own function says so, or what it writes beside results is a constant."""
    tree = ast.parse((parts.HERE / script).read_text(encoding="utf-8"))
    if any(isinstance(node, ast.FunctionDef) and node.name == "variants" for node in tree.body):
        return list(evaluated(script, ast.parse("variants()", mode="eval").body))
    (call,) = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "keep")
    return list(evaluated(script, call.args[1]))


OLD = {  # results of before dates were written: until they are made again; none may be added
    "accelerator", "calibration", "calibration_segments", "cluster", "convergence", "first_frames", "first_pictures", "gradients",
    "imports", "looking_around", "project_over_frame",
    "scale", "scaling", "snapshots", "surfaces", "trade_1m", "trade_200k",
    "truth", "two_quantities", "vtk_grid",
}  # fmt: skip
UNMEASURED = {"calibration_screen", "screen"}  # likewise


@pytest.mark.parametrize("part", parts.PARTS, ids=[part.name for part in parts.PARTS])
def test_results_name_their_run_and_variants_that_scripts_make(part):
    made = {name for script in part.scripts for name in ([] if script == "looking_around.py" else variants(script))}
    made |= {pathlib.Path(word).name for command in part.commands for word in shlex.split(command)[1:]}
    if part.name in UNMEASURED:
        assert not part.result.exists(), "measured: take it off the list"
        return
    found = json.loads(part.result.read_text(encoding="utf-8"))
    assert {"device", "commit"} <= found["run"].keys() and found["variants"]
    if part.name in OLD:
        assert "date" not in found["run"], "made again: take it off the list"
        return
    assert found["run"]["commit"] and re.fullmatch(r"20\d\d-\d\d-\d\d", found["run"]["date"])
    assert set(found["variants"]) <= made, "the script makes no such variant"


WRITTEN = {"how_accurate_how_fast.md", "command_line.md"}  # by programs
FILES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES = [page for page in FILES if page.name not in WRITTEN]


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_figures_of_pages_are_roundings_of_results(page):
    text = page.read_text(encoding="utf-8")
    assert unmeasured(text) == []
    assert unnamed(text) == [], "a comment has to name the files that these figures are from"
    named = {source.split(" (")[0] for block in blocks(text) for source in block.sources}
    assert named <= {part.result.name for part in parts.PARTS} | WRITTEN


@pytest.mark.parametrize(("text", "read"), [
    ("12.1 %, 1,000,000 points, 3e-4 to 9e-4, 76 ms", ["12.1 %", "1,000,000", "3e-4", "9e-4", "76 ms"]),
    ("8 x 8 pixels (1.43 to 2.01), 97 k. 0.09 + 1.02 s", ["8", "8", "1.43", "2.01", "97 k", "0.09", "1.02"]),
    ("section 4.1, tables 2 and 3, of 2016, `x 3`, 1:1000, 1.4.1, 2^30, $x^2 + 3$, [here](a.md#b-2), poly6", []),
])  # fmt: skip
def test_what_is_a_figure(text, read):
    assert [figure.text for figure in figures(text)] == read


@pytest.mark.parametrize(("figure", "source"), [
    ("0.41", "some.json"), ("0.406", "some.json"), ("41 %", "some.json (share)"), ("406 ms", "some.json (share)"),
    ("1.95", "some.json (share / time)"), ("1,234", "some.json"), ("7", "some.json; besides 7"), ("0.208", "some.json (time)"),
])  # fmt: skip
def test_roundings_of_what_was_measured_are_right(figure, source, some_result):
    assert unmeasured(f"<!-- figures: {source} -->\nIt is {figure} of it.\n\nAnd 99.9 % of all.") == []
    assert unmeasured(f"| a | 99.9 | it is {figure} <!-- figures: {source} --> |") == []


@pytest.mark.parametrize(("figure", "source"), [
    ("0.42", "some.json"), ("0.405", "some.json"), ("40 %", "some.json"), ("41", "some.json (time)"),
    ("0.208", "some.json (share)"), ("1.96", "some.json (share / time)"), ("1,235", "some.json"), ("7", "some.json"),
    ("9", "some.json"),
])  # fmt: skip
def test_figures_that_nobody_measured_are_told(figure, source, some_result):
    page = f"It was measured:\n\n<!-- figures: {source} -->\nIt is\n{figure} of it.\n"
    assert [text for text, _ in unmeasured(page)] == [figure]
    assert unnamed(f"It is 0.5 of it (`benchmarks/trade.py`). {figure}")


@pytest.fixture
def some_result(tmp_path, monkeypatch):
    found = {"run": {"seconds": 9}, "rows": [{"share": 0.4062, "time": 0.2083, "name": "of 1,234 rays"}]}
    (tmp_path / "some.json").write_text(json.dumps(found))
    monkeypatch.setattr("figures.RESULTS", tmp_path)
    measured.cache_clear()
    yield
    measured.cache_clear()
