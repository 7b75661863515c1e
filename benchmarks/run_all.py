"""Make every result anew that a page tells figures of, part by part: hours on two cores, and nothing else may run meanwhile.

A part is done once its commands have ended and its JSON is of this code: nothing of the package, or of what the part runs, has
changed since the commit that the JSON names. So a run that was interrupted goes on with the part it was in, also after results
were committed; `build/results/` has what each part printed, and which have begun and ended. Parts that are named run anew.
Where a claim does not hold, or a part fails, the others still run, and it is told at the end with exit status 1. Parts that
need what is not here are left out, by name. At the end `report.py` writes `docs/how_accurate_how_fast.md`.

    python benchmarks/run_all.py [NAME ...] [--list] [--data FOLDER] [--peer-python PYTHON]
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import os
import pathlib
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from typing import Any

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import parts
from parts import PARTS, Part

LOGS = parts.ROOT / "build" / "results"
RECORD = LOGS / "record.json"  # of each part: the commit it began at, and its exit status, once it has ended
COMPILED = parts.ROOT / "build" / "compiled"
GRACE = 60  # seconds that a part has to end after Ctrl-C


def record() -> dict[str, dict[str, Any]]:
    return json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}


def note(part: Part, **about: Any) -> None:
    """Write down where a part is, whole or not at all."""
    LOGS.mkdir(parents=True, exist_ok=True)
    temporary = RECORD.with_suffix(".new")
    temporary.write_text(json.dumps(record() | {part.name: about}, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, RECORD)


def commit() -> str:
    command = ["git", "-C", str(parts.ROOT), "rev-parse", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def state(part: Part) -> str:
    """`done`, `claim does not hold`, `interrupted`, `older code`, or `never run`."""
    of_result = parts.run_of(part)
    known = record().get(part.name, {})
    if parts.is_of_this_code(known.get("commit"), part) and known["status"] is None:
        return "interrupted"
    if not part.result.exists():
        return "never run"
    if not parts.is_of_this_code(of_result.get("commit"), part):
        return "older code"
    return "claim does not hold" if known.get("status") else "done"


def hours(minutes: float) -> str:
    return f"{minutes / 60:.1f} h" if minutes >= 90 else f"{max(minutes, 1):.0f} min"


def listed(part: Part, lacking: list[str]) -> str:
    """A line of `--list`."""
    of_result = parts.run_of(part)
    made = f"{of_result.get('commit') or '-'} {of_result.get('date') or 'no date'}" if of_result else "-"
    told = f"left out, needs {'; '.join(lacking)}" if lacking else state(part)
    where = ", ".join(parts.pages(part)) or "no page"
    return f"{part.name:22s} {hours(parts.minutes(part)):>8s}  {made:28s} {told}; told in {where}"


@contextlib.contextmanager
def compiled_programs(part: Part) -> Iterator[str]:
    """Folder of compiled programs: shared, or new and empty."""
    if not part.compiles:
        yield str(COMPILED)
        return
    with tempfile.TemporaryDirectory() as folder:
        yield folder


def run(command: str, environment: dict[str, str], log: pathlib.Path) -> int:
    """Run a script; what it prints is shown, and written to `log`. Ctrl-C ends it, too."""
    words = [sys.executable, *shlex.split(f"benchmarks/{command}")]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "errors": "replace"}
    with open(log, "a", encoding="utf-8") as file:
        print(f"> python {shlex.join(words[1:])}", file=file, flush=True)
        process = subprocess.Popen(words, cwd=parts.ROOT, env=environment, start_new_session=True, **pipes)
        try:
            for line in process.stdout:
                print(f"  {line}", end="", flush=True)
                print(line, end="", file=file, flush=True)
            return process.wait()
        except BaseException:
            end(process)
            raise


def end(process: subprocess.Popen) -> None:
    """Ask a script and what it has started to end, and make them if they do not."""
    for number, seconds in ((signal.SIGINT, GRACE), (signal.SIGKILL, None)):
        with contextlib.suppress(ProcessLookupError, subprocess.TimeoutExpired):
            os.killpg(process.pid, number)
            process.wait(seconds)
            return


def carry_out(part: Part, data: pathlib.Path | None, peer: str | None) -> int:
    """All commands of a part, from where an interrupted run of this code was; 0 where all of them hold their claims."""
    if state(part) != "interrupted":
        for folder in part.folders:
            shutil.rmtree(parts.RESULTS / folder, ignore_errors=True)
    begun = commit()
    note(part, commit=begun, status=None)
    log, status = LOGS / f"{part.name}.log", 0
    log.unlink(missing_ok=True)
    with compiled_programs(part) as folder:
        shared = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "JAX_COMPILATION_CACHE_DIR": folder}
        environment = os.environ | shared | {"PYTHONUNBUFFERED": "1"}
        for command in part.commands:
            words = shlex.split(command)
            given = [word.replace(parts.DATA, str(data)).replace(parts.PEER, str(peer)) for word in words]
            status = max(status, abs(run(shlex.join(given), environment, log)))
    note(part, commit=begun, status=status)
    return status


def carry_out_all(waiting: list[Part], arguments: argparse.Namespace) -> list[str]:
    """Names of the parts that fail, or whose claims do not hold."""
    failed = []
    for number, part in enumerate(waiting, 1):
        left = sum(map(parts.minutes, waiting[number:]))
        now = datetime.datetime.now().strftime("%H:%M")
        print(f"{now} part {number} of {len(waiting)}, {part.name}: about {hours(parts.minutes(part))}", end="")
        print(f", then {hours(left)} for the others" if left else "", flush=True)
        if carry_out(part, arguments.data, arguments.peer_python):
            failed.append(part.name)
            print(f"{part.name}: a claim does not hold, or it failed", flush=True)
    return failed


def write_page() -> None:
    subprocess.run([sys.executable, str(parts.HERE / "report.py")], check=True)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [part.name for part in PARTS]
    parser.add_argument("names", nargs="*", metavar="NAME", help="of parts to run, anew: " + ", ".join(names))
    parser.add_argument("--list", action="store_true", help="say what each part takes and how old its result is, and run nothing")
    parser.add_argument("--data", type=pathlib.Path, help="folder of particle files that are no part of this repository")
    parser.add_argument("--peer-python", help="a Python that has sarracen")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in names]
    if unknown:
        parser.error(f"no part is called {', '.join(unknown)}; there are {', '.join(names)}")
    return arguments


def main() -> int:
    arguments = parsed()
    chosen = [part for part in PARTS if not arguments.names or part.name in arguments.names]
    lacking = {part: part.lacks(arguments.data, arguments.peer_python) for part in chosen}
    if arguments.list:
        print("\n".join(listed(part, lacking[part]) for part in chosen))
        return 0
    there = [part for part in chosen if not lacking[part]]
    waiting = [part for part in there if arguments.names or state(part) not in ("done", "claim does not hold")]
    print(f"{len(waiting)} of {len(there)} parts to run, {hours(sum(map(parts.minutes, waiting)))} in all", flush=True)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        failed = carry_out_all(waiting, arguments)
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from here")
        return 130
    write_page()
    for part in there:
        if part.name not in failed and state(part) == "claim does not hold":
            failed.append(part.name)
    for part in chosen:
        if lacking[part]:
            print(f"{part.name} was left out; it needs {'; '.join(lacking[part])}")
    for name in failed:
        print(f"{name}: a claim does not hold, or it failed; see {LOGS / name}.log")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
