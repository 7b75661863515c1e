"""Several files at once on the command line: a picture of each, by the same options.

Flow: files -> [cli_several] -> render, one after another -> what could not be done.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxsph.cli.console import UsageError, say

NAME = "{}"
"""What stands in OUT for the name of a file."""
SCENE = "scene:"


def render_each(options: argparse.Namespace, render: Callable[[argparse.Namespace], None]) -> None:
    """Render each of `options.source`; one that fails keeps none of the others from being done.

    Raises:
        UsageError: OUT is not for several files, or two files have the same name.
        RuntimeError: some failed; the message says which, and why.
    """
    sources = options.source
    if len(sources) < 2:
        render(_alone(options, sources[0] if sources else None, options.output))
        return
    outputs, failed = outputs_of(sources, options.output), []
    for nth, (source, output) in enumerate(zip(sources, outputs, strict=True), 1):
        say("", f"{nth} of {len(sources)}: {source}")
        output.parent.mkdir(parents=True, exist_ok=True)
        try:
            render(_alone(options, source, output))
        except (ValueError, OSError, RuntimeError) as error:
            if isinstance(error, UsageError):
                raise
            failed.append(f"{source}: {error}")
            say("failed", str(error))
    if failed:
        raise RuntimeError(f"{len(failed)} of {len(sources)} failed: {'; '.join(failed)}")


def outputs_of(sources: Sequence[str], output: Path | None) -> list[Path]:
    """Where the picture of each goes: into a folder, or by a name with `{}` in it; here without."""
    names = [stem_of(source) for source in sources]
    if len(set(names)) < len(names):  # equal names in two folders
        names = [f"{Path(source).parent.name}_{name}".strip("_") for source, name in zip(sources, names, strict=True)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"two pictures would be called {twice}: render these files one by one, with -o")
    if output is None:
        return [Path(f"{name}.png") for name in names]
    if NAME in output.name:
        return [output.with_name(output.name.replace(NAME, name)) for name in names]
    if output.suffix.lower() in (".png", ".exr"):
        raise UsageError(f"-o {output} is one picture, but there are {len(sources)}; give a folder, or a name with {{}} in it")
    return [output / f"{name}.png" for name in names]


def stem_of(source: str) -> str:
    """The name of a picture: that of its source, without a suffix; a number behind a point is none, as in `snap.00001`."""
    path = Path(source.removeprefix(SCENE))
    return path.name if path.suffix[1:].isdecimal() else path.stem


def _alone(options: argparse.Namespace, source: str | None, output: Path | None) -> argparse.Namespace:
    return argparse.Namespace(**{**vars(options), "source": source, "output": output})
