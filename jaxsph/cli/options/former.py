"""Former spellings of options: rewritten as they are written now, and told of unless they stay for good.

Flow: words of a command line -> [former] -> words as options are now, what was told -> words -> cyclopts.

The names of the contract of the first version stay silently: `--quantity`, and places of several words as in `--eye 0 0 9`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from jaxsph.cli.voice import UsageError

COUNTS = {
    **dict.fromkeys(("--eye", "--target", "--up", "--center", "--box"), 3),
    **dict.fromkeys(("--range", "--depth-range", "--pixel"), 2),
    **dict.fromkeys(("--clip-plane", "--clip-box", "--cut-box", "--slice"), 6),
    **dict.fromkeys(("--clip-sphere", "--cut-sphere"), 4),
}
"""Options that took so many numbers, a word each."""
LISTS = ("--tolerances", "--estimators", "--baselines", "--frames")
"""Options of `sweep` that took any number of words."""
FLAGS = ("--not-periodic",)
ALONE = {"--surface": 0.5}
"""Values of options that may be given without one."""
RENAMED: dict[str, tuple[str, str]] = {
    "--quantity": ("--color-by", "{}"),
    "--domain": ("--norm", "{}"),
    "--opacity": ("--optical-depth", "{}"),
    "--box": ("--box-size", "{}"),
    "--not-periodic": ("--box-size", "none"),
    "--clip-plane": ("--clip", "plane:{}"),
    "--clip-box": ("--clip", "box:{}"),
    "--cut-box": ("--clip", "~box:{}"),
    "--clip-sphere": ("--clip", "sphere:{}"),
    "--cut-sphere": ("--clip", "~sphere:{}"),
    "--axis": ("--view", "{}"),
    "--debug": ("--verbose", ""),
    "--frame-all": ("--width", "all"),
}
SILENT = {"--quantity", "--debug", "--eye", "--target", "--up", "--center", "--frame-all", "--axis", "--pixel"}
OF_SCENES = ("--particles", "--frame")
BEHIND = {
    "--point-": ("--points", ("radius", "opacity", "color", "colormap", "type")),
    "--volume-": ("--volume", ("quantity", "colormap")),
}
SCENE = "scene:"


@dataclasses.dataclass
class Rewritten:
    """A command line as it is written now.

    Attributes:
        command: its name.
        words: what follows.
        told: sentences on former spellings.
    """

    command: str
    words: list[str]
    told: list[str]


def rewritten(command: str, words: Sequence[str], offered: Callable[[str, str], bool]) -> Rewritten:
    """The command line with former spellings replaced; `offered` says whether a command has an option."""
    made = Rewritten(command, [], [])
    if "--slice" in (word.partition("=")[0] for word in words) and command == "render":
        made.command = "slice"
        made.told.append("`render --slice` is now `jaxsph slice --plane`")
    if {"--box", "--not-periodic"} <= {word.partition("=")[0] for word in words}:
        raise UsageError("--box and --not-periodic exclude each other; both are --box-size now")
    behind: dict[str, str] = {}
    left = list(words)
    while left:
        word = left.pop(0)
        name, equals, value = word.partition("=")
        of_words = name in COUNTS or (name in LISTS and made.command == "sweep")
        if not name.startswith("--") or (offered(made.command, name) and not of_words):
            alone = name in ALONE and not equals and not (left and (left[0] == "none" or _is_number(left[0])))
            made.words.append(f"{name}={ALONE[name]}" if alone else word)
            continue
        given = [value] if equals else _taken(name, left, made.command)
        if name in OF_SCENES or name.startswith(tuple(BEHIND)):
            behind[name] = ",".join(given) or (left.pop(0) if left else "")
            continue
        made.words += _one(made, name, given, offered)
    _put_behind(made, behind)
    return made


def _taken(name: str, left: list[str], command: str) -> list[str]:
    """The words that a former option took."""
    if name in LISTS and command == "sweep":
        end = next((at for at, word in enumerate(left) if word.startswith("-") and not _is_number(word)), len(left))
        return [left.pop(0) for _ in range(end)]
    most = COUNTS.get(name, 0)
    taken: list[str] = []
    while left and len(taken) < most and _is_number(left[0]):
        taken.append(left.pop(0))
    return taken


def _one(made: Rewritten, name: str, given: list[str], offered: Callable[[str, str], bool]) -> list[str]:
    """An option as it is written now; as it was where it is not a former one."""
    joined = ",".join(given)
    if name == "--slice" and made.command == "slice":
        return [f"--plane={joined}"]
    if name == "--frames" and made.command == "sweep":
        made.told.append(f"--frames is now --moments {joined}")
        return [f"--moments={joined}"]
    new, form = RENAMED.get(name, (name, "{}"))
    if new != name and not offered(made.command, new):
        return [name, *given]
    if name not in RENAMED:
        of_list = name in LISTS and made.command == "sweep"
        if len(given) > 1 and name not in SILENT:
            made.told.append(f"{name} {' '.join(given)} is now {name} {joined}")
        return [f"{name}={joined}"] if given or of_list else [name]
    if name not in SILENT:
        said = form if name in FLAGS else form.format(joined) if given else ""
        made.told.append(f"{name} is now {new} {said}".strip())
    if name in FLAGS or form in ("", "all"):
        return [f"{new}={form}" if form else new]
    return [f"{new}={form.format(joined)}"] if given else [new]


def _put_behind(made: Rewritten, behind: dict[str, str]) -> None:
    """Former options of scenes and of files beside the source, behind these."""
    for name, value in behind.items():
        if name in OF_SCENES:
            _behind_scenes(made, name, value)
            continue
        start = next(start for start in BEHIND if name.startswith(start))
        option, known = BEHIND[start]
        key = name.removeprefix(start)
        if key not in known:
            made.words.append(f"{name}={value}")
            continue
        places = [at for at, word in enumerate(made.words) if word == option or word.startswith(f"{option}=")]
        if not places:
            raise UsageError(f"{name} is for {option} FILE, and there is none")
        made.told.append(f"{name} {value} is now {option} FILE:{key}={value}")
        for at in places:
            at += made.words[at] == option
            if at < len(made.words):
                _, _, options = made.words[at].partition(":")
                made.words[at] += f"{',' if '=' in options else ':'}{key}={value}"


def _behind_scenes(made: Rewritten, name: str, value: str) -> None:
    places = [at for at, word in enumerate(made.words) if word.startswith(SCENE)]
    if not places:
        raise UsageError(f"{name} is for built-in scenes, not for files")
    key = name.removeprefix("--")
    made.told.append(f"{name} {value} is now scene:NAME:{key}={value}")
    for at in places:
        made.words[at] += f"{',' if made.words[at].count(':') > 1 else ':'}{key}={value}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
