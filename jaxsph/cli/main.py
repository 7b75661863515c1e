"""Command line: a picture from files of particles, volumes and points in one command.

Flow: words, files of options -> cyclopts -> [main] -> a command -> files, results on stdout, prose on stderr.

Exit codes: 0 done, 1 the work failed, 2 wrong usage, 130 interrupted (SIGINT), 143 asked to end (SIGTERM); one line on stderr
says why. A command's module is imported when that command is asked for, so that help comes at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from cyclopts import App, Argument, ArgumentCollection, CoercionError, CycloptsError, MissingArgumentError, Parameter

from jaxsph.cli import voice
from jaxsph.cli.table import COMMANDS, completed
from jaxsph.cli.voice import UsageError, by_option
from jaxsph.numerics import __version__
from jaxsph.numerics.names import did_you_mean

DONE, FAILED, WRONG_USAGE, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143
AGAIN_SECONDS = 0.02
COLLECTED = 10_000  # objects more, from which on Python looks for what nobody can reach: at 700, a fifth of a command's time
HELP, SHORT_HELP, VERSION = "--help", "-h", "--version"
ALOUD = ("info", "demo", "doctor")  # whose result is what they say
WIDTH, MIN_WIDTH = 110, 95
FIRST_STEPS = "Examples:\n  jaxsph render snap_042.hdf5\n  jaxsph info snap_042.hdf5\n"

EXIT_CODES = (
    "Exit codes: 0 done, 1 the work failed, 2 wrong usage, 130 interrupted, 143 asked to end; one line on stderr says why. "
    "Results are on stdout, all else is on stderr. After a command, -h shows less than --help."
)


class _Terminated(KeyboardInterrupt):
    """The process is asked to end, by a scheduler of jobs perhaps: all that an interrupt tidies up is tidied up."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the result is the exit code.

    Args:
        arguments: those of the process if not given. Only then is `--no-cache` obeyed and SIGTERM heard, as a caller may have set
            up JAX and signals otherwise.
    """
    words = [str(word) for word in (sys.argv[1:] if arguments is None else arguments)]
    command = next(iter(words), "")
    verbose = any(word in ("--verbose", "-v") for word in words)
    if arguments is None:
        gc.disable()  # until all is imported
    try:
        if _helped(command, words):
            return DONE
        run, options = _asked(command, words[1:])
        with _ending_in_order(arguments is None):
            _work(run, options, own_process=arguments is None)
    except _Terminated:
        return _failed(command, "terminated", TERMINATED, verbose)
    except KeyboardInterrupt:
        return _failed(command, "interrupted", INTERRUPTED, verbose)
    except BrokenPipeError:  # the reader of our output went away, as in `jaxsph info FILE | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except UsageError as error:
        which = f"{command} " if command in COMMANDS else ""
        return _failed(command, f"{by_option(str(error), declared(command))} (see `jaxsph {which}--help`)", WRONG_USAGE, verbose)
    except Exception as error:
        told: BaseException | None = error
        while told is not None and not isinstance(told, KeyboardInterrupt):  # libraries of C make an error of one now and then
            told = told.__cause__ or told.__context__
        if told is not None:
            end = ("terminated", TERMINATED) if isinstance(told, _Terminated) else ("interrupted", INTERRUPTED)
            return _failed(command, *end, verbose)
        return _failed(command, _reason(command, error), FAILED, verbose)
    return DONE


def _work(run: Any, options: Any, *, own_process: bool) -> None:
    """Do what is asked for; what a command reads, wherever it is named, is not written to."""
    from jaxsph.cli.console import tell_of_compiling, warnings_in_lines
    from jaxsph.engine.runtime.kept import mended
    from jaxsph.io.replace import keeping
    from jaxsph.io.snapshot_files import with_parts

    beside = [Path(one.file) for name in ("points", "volume") for one in getattr(options, name, ())]
    named = [value for name, value in vars(options).items() if isinstance(value, Path) and name not in ("output", "save")]
    read = [path for path in (*map(Path, filter(None, run.args)), *beside, *named) if os.path.exists(path)]
    with warnings_in_lines(options.command, mended), keeping(with_parts(read)):
        if own_process:
            gc.freeze()  # what was imported stays, and need not be looked through again and again
            gc.set_threshold(COLLECTED)
            gc.enable()
            tell_of_compiling(no_cache=options.no_cache)
        left = run(asked=_in_own_lengths(options, run.args))
        voice.end(options.command)
    if left and own_process:  # threads that nothing can end: the interpreter would wait for them
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(DONE)


def _in_own_lengths(options: Any, files: Sequence[Any]) -> Any:
    """Options with lengths as numbers of the first file."""
    from jaxsph.cli.console import wrong_usage
    from jaxsph.io.opening.opened import in_own_lengths

    if not hasattr(options, "physical") or not files or files[0] is None:
        return options
    with wrong_usage():
        return in_own_lengths(options, files[0], options)


def _asked(command: str, words: list[str]) -> tuple[Any, Any]:
    """The command that is asked for, with its files, and its options. Raises `UsageError`: what cannot be understood."""
    if command not in COMMANDS:
        known = ", ".join(COMMANDS)
        raise UsageError(f"there is no command {command!r}; there are {known}{did_you_mean(command, COMMANDS)}")
    said = completed(command, words, declared(command))
    voice.begin(quiet="--quiet" in said, verbose="--verbose" in said, as_json="--json" in said, aloud=command in ALOUD)
    try:
        function, bound, _ = app(command)[command].parse_args(said, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        raise UsageError(_one_line(error)) from error
    except ValueError as error:  # of a group whose options do not go together
        raise UsageError(str(error)) from error
    bound.apply_defaults()
    own = {"source": bound.args, "command": command, "words": tuple(said), "app": app}
    options = dataclasses.replace(bound.arguments["asked"], **own)
    options.require_together()
    return functools.partial(function, *bound.args), options


def function_of(command: str) -> Callable[..., Any]:
    """The function of a command, whose module is imported now: each takes 200 to 400 ms, and what they all do is said without."""
    match command:
        case "render" | "merge":
            from jaxsph.cli.commands.render import merge, render

            return render if command == "render" else merge
        case "project":
            from jaxsph.cli.commands.columns import project

            return project
        case "slice":
            from jaxsph.cli.commands.planes import slice

            return slice
        case "movie":
            from jaxsph.cli.commands.movie import movie

            return movie
        case "view":
            from jaxsph.cli.commands.view import view

            return view
        case "sweep":
            from jaxsph.cli.commands.sweep import sweep

            return sweep
        case "info" | "transfer":
            from jaxsph.cli.commands.data import info, transfer

            return info if command == "info" else transfer
    from jaxsph.cli.commands.checks import demo, doctor, explain

    checks: dict[str, Callable[..., Any]] = {"demo": demo, "doctor": doctor, "explain": explain}
    return checks[command]


@functools.cache
def app(*asked: str) -> App:
    """All commands by what they do, and those that are asked for with their options, too."""
    made = App(
        "jaxsph",
        help="Render SPH particles as a volume.",
        version=__version__,
        help_format="plaintext",
        help_formatter="plain",
        help_epilogue=EXIT_CODES,
        default_parameter=Parameter(negative=""),
    )
    for name, command in COMMANDS.items():
        function = function_of(name) if name in asked else lambda: None
        made.command(function, name=name, help=command.sentence, group=command.kind, help_prologue=command.shown)
    return made


def _one_line(error: CycloptsError) -> str:
    """What cyclopts refuses, with the option first."""
    if isinstance(error, CoercionError) and error.msg and error.argument is not None:
        name, text = error.argument.name, str(error.msg)
        return f"{name} {text}" if text.startswith("must ") else f"{name}: {text}"
    if isinstance(error, MissingArgumentError) and error.argument is not None:
        return f"{error.argument.name.removeprefix('*')} needs a value"
    return " ".join(str(error).split())


@functools.cache  # it takes a twentieth of a second, and what goes wrong asks again
def arguments_of(command: str) -> ArgumentCollection:
    """What a command offers, as cyclopts has it."""
    return app(command)[command].assemble_argument_collection()


def declared(command: str) -> dict[str, Argument]:
    """The options of a command, by each of their names; none of what is no command."""
    found = arguments_of(command) if command in COMMANDS else ()
    return {name: one for one in found if one.parse for name in one.names if name.startswith("-")}


def _helped(command: str, words: list[str]) -> bool:
    """Whether help or the version was asked for; and print it."""
    if command == VERSION:
        print(f"jaxsph {__version__}")
    elif not words:
        print(f"{FIRST_STEPS}\n`jaxsph --help` lists all commands, `jaxsph COMMAND -h` has more examples.")
    elif command in (HELP, SHORT_HELP):
        print(FIRST_STEPS)
        app().help_print([], console=_wide())
    elif command in COMMANDS and HELP in words:
        app(command).help_print([command], console=_wide())
    elif command in COMMANDS and SHORT_HELP in words:
        _print_short(command)
    else:
        return False
    return True


def _wide() -> Any:
    """Where help goes: lines as long as the terminal's, at least such that examples are not broken."""
    from rich.console import Console

    return Console(width=max(shutil.get_terminal_size((WIDTH, 24)).columns, MIN_WIDTH), highlight=False)


def _print_short(command: str) -> None:
    """Examples and names of options."""
    groups: dict[str, list[str]] = {}
    for one in arguments_of(command):
        if one.show and one.name.startswith("-"):
            kinds: Any = one.parameter.group
            groups.setdefault(kinds[0].name, []).append(one.name)
    print(f"{COMMANDS[command].sentence}\n\n{COMMANDS[command].shown}\n\nOptions:")
    for name, options in groups.items():
        print(f"  {name}: {' '.join(options)}")
    print(f"\n`jaxsph {command} --help` explains them.")


@contextlib.contextmanager
def _ending_in_order(own_process: bool) -> Iterator[None]:
    """Have SIGTERM raise in the block, as SIGINT does; not where it is ignored, or is somebody else's to handle."""

    def end(*_: object) -> None:
        raise _Terminated

    def ask() -> None:
        with asks:  # a timer that is cancelled may be past its wait
            if signal.getsignal(signal.SIGTERM) is end:
                os.kill(os.getpid(), signal.SIGTERM)

    def lost(told: Any) -> None:  # what is raised while an object is thrown away goes no further: ask again
        if not isinstance(told.exc_value, _Terminated):
            before(told)
            return
        again = threading.Timer(AGAIN_SECONDS, ask)
        again.daemon = True
        asking.append(again)
        again.start()

    mine = own_process and threading.current_thread() is threading.main_thread()
    if not mine or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    asking: list[threading.Timer] = []
    asks = threading.Lock()
    before, sys.unraisablehook = sys.unraisablehook, lost
    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        try:
            for again in asking:  # what is done is not to be asked when nobody hears it any more: that would kill the process
                again.cancel()
        finally:
            while signal.getsignal(signal.SIGTERM) is end:
                with contextlib.suppress(_Terminated), asks:
                    signal.signal(signal.SIGTERM, signal.SIG_DFL)
            sys.unraisablehook = before


def _failed(command: str, reason: str, code: int, verbose: bool) -> int:
    if verbose:
        import traceback

        traceback.print_exc()
    print(f"jaxsph{f' {command}' if command in COMMANDS else ''}: {' '.join(reason.split())}", file=sys.stderr)
    return code


def _reason(command: str, error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror or type(error).__name__}"
    if isinstance(error, MemoryError):
        return f"out of memory ({error}); try a smaller --size, fewer --samples or a lower --memory"
    if isinstance(error, ValueError | OSError | ImportError | RuntimeError):
        return by_option(str(error), declared(command)) or type(error).__name__
    return f"unexpected {type(error).__name__}: {error}; --verbose shows where"
