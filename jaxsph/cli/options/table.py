"""The commands that there are.

Flow: [table] -> main, help, files of options.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

from cyclopts import App, Parameter

from jaxsph.numerics import __version__


class Command(NamedTuple):
    """A command.

    Attributes:
        kind: by which commands are told apart in the help.
        text: what it does.
        examples: how it is called.
    """

    kind: str
    text: str
    examples: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """What it does, as a sentence."""
        return f"{self.text[0].upper()}{self.text[1:]}."

    @property
    def shown(self) -> str:
        """Its examples, as help begins with them."""
        return "\n".join(["Examples:", *(f"  {example}" for example in self.examples)])


PICTURES, DATA, PARTS, QUALITY, SYSTEM = "Pictures", "Data", "Parts", "Quality", "System"
MODULES = {"merge": "render", "info": "data", "transfer": "data", "explain": "checks", "demo": "checks", "doctor": "checks"}
"""Of commands, each a function, that have none of their own; a module is imported when one of its commands is asked for."""
COMMANDS = {
    "render": Command(
        PICTURES,
        "make a picture; what you do not say is chosen, and said",
        (
            "jaxsph render snap_042.hdf5",
            "jaxsph render snap_042.hdf5 --color-by Temperature --opacity-by Density --annotate",
            "jaxsph render snap_042.hdf5 --center densest --width 30kpc --background white -o fig1.png",
        ),
    ),
    "project": Command(
        PICTURES,
        "integrate along rays: column densities, means",
        ("jaxsph project snap_042.hdf5 --view z -o column.png", "jaxsph project snap_042.hdf5 --of Temperature --weight mass"),
    ),
    "slice": Command(
        PICTURES,
        "show a quantity on a plane",
        ("jaxsph slice snap_042.hdf5 -o slice.png", "jaxsph slice snap_042.hdf5 --plane 0,0,0,1,0,0 --color-by Density"),
    ),
    "movie": Command(
        PICTURES,
        "make a movie of a file, or of a sequence of files",
        ("jaxsph movie snap_042.hdf5 --orbit 360", "jaxsph movie snap_*.hdf5 -o run.mp4"),
    ),
    "view": Command(
        PICTURES,
        "look around in the browser, and change colours and opacity",
        ("jaxsph view snap_042.hdf5", "jaxsph view scene:mixer --size 800x600 --port 8765 --no-browser"),
    ),
    "info": Command(DATA, "say what a file holds, and what `render` would show of it", ("jaxsph info snap_042.hdf5",)),
    "transfer": Command(
        DATA,
        "draw a transfer function over what rays meet",
        ("jaxsph transfer snap_042.hdf5 --save look.json", "jaxsph transfer look.json"),
    ),
    "merge": Command(PARTS, "make a picture of the parts of `render --tile`", ("jaxsph merge part_*.exr -o whole.exr",)),
    "sweep": Command(QUALITY, "measure error against tolerance against time", ("jaxsph sweep scene:mixer -o sweep",)),
    "explain": Command(
        QUALITY,
        "explain a pixel: its error bound by source, and what its ray meets",
        (
            "jaxsph explain snap_042.hdf5 --pixel 120 200",
            "jaxsph explain scene:mixer --pixel 256 256 --tolerance 0.01 -o pixel.png",
        ),
    ),
    "demo": Command(QUALITY, "render a built-in scene and measure its error", ("jaxsph demo -o demo",)),
    "doctor": Command(
        SYSTEM, "say versions, devices and the cache", ("jaxsph doctor", 'eval "$(jaxsph doctor --completion bash)"')
    ),
}
EXIT_CODES = (
    "Exit codes: 0 done, 1 the work failed, 2 wrong usage, 130 interrupted, 143 asked to end; one line on stderr says why. "
    "Results are on stdout, all else is on stderr. After a command, -h shows less than --help."
)


@functools.cache
def app() -> App:
    """All commands; none of their modules is imported before it is asked for."""
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
        path = f"jaxsph.cli.commands.{MODULES.get(name, name)}:{name}"
        made.command(path, name=name, help=command.sentence, group=command.kind, help_prologue=command.shown)
    return made
