"""What `make results` runs: one part for each JSON of `results/`, what makes it, what that needs, and about how long it takes."""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib.util
import json
import pathlib
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator
from typing import Any

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import report

HERE = pathlib.Path(__file__).parent
ROOT, RESULTS = HERE.parent, HERE / "results"
PACKAGE = "jaxsph"
DATA, PEER = "{data}", "{peer}"  # in a command: the folder of particle files, and a Python that has sarracen
BUSY = 2  # processes a core: above that a part takes longer than it does on an idle machine
BACKEND = "import jax; print(jax.default_backend())"
FILES = {  # of others, or too large to be kept here, and where they are from
    "ddb60k_dye_003.npz": "a dam break with dye, simulated for this project",
    "dsph_dambreak3d_fluid.csv": "a tutorial of DualSPHysics, exported by ParaView",
    "gadget2_binary_gas_9030.gadget": "test data of pynbody",
    "gadget4_galaxies_008.hdf5": "colliding galaxies, an example of GADGET-4",
    "gadget4_lcdm_gas_snapshot_002.hdf5": "G2-lcdm-gas, an example of GADGET-4",
    "mixer_001.npz": "the stirred tank, simulated for this project",
    "mixer_002.npz": "the stirred tank, simulated for this project",
    "pbf_dam_break_048.vtk": "a dam break of position-based fluids, simulated for this project",
    "phantom_dustmixture_00000.h5": "tests of plonk",
    "phantom_mhd_00000.h5": "tests of plonk",
    "sphviewer_dm_halo.hdf5": "py-sphviewer",
    "splashsurf_dam_break_f9.bgeo": "splashsurf",
    "splashsurf_double_dam_break_f26.vtk": "splashsurf",
    "splashsurf_fluid_encoded_250.vtu": "splashsurf",
    "splishsplash_bunny.bgeo": "SPlisHSPlasH",
}
LIQUIDS = "splashsurf_dam_break_f9.bgeo", "splashsurf_double_dam_break_f26.vtk", "mixer_002.npz"
WITH_INTEGRALS = "mixer_001.npz", "splashsurf_fluid_encoded_250.vtu", "ddb60k_dye_003.npz", "sphviewer_dm_halo.hdf5"
PROJECTED = "phantom_mhd_00000.h5", "gadget4_lcdm_gas_snapshot_002.hdf5"
SHOWN_FIRST = (
    "dsph_dambreak3d_fluid.csv", "gadget2_binary_gas_9030.gadget", "gadget4_galaxies_008.hdf5",
    "gadget4_lcdm_gas_snapshot_002.hdf5", "mixer_001.npz", "pbf_dam_break_048.vtk", "phantom_dustmixture_00000.h5",
    "phantom_mhd_00000.h5", "sphviewer_dm_halo.hdf5", "splashsurf_dam_break_f9.bgeo", "splashsurf_fluid_encoded_250.vtu",
    "splishsplash_bunny.bgeo",
)  # fmt: skip


def in_data(files: Iterable[str]) -> str:
    """Particle files, in a command."""
    return " ".join(f"{DATA}/{file}" for file in files)


@dataclasses.dataclass(frozen=True)
class Part:
    """Commands that write `results/NAME.json`."""

    name: str
    commands: tuple[str, ...]
    estimate: float  # minutes on two cores, as long as no result says how long it took
    packages: tuple[str, ...] = ()  # modules besides those of the package
    accelerator: bool = False
    compiles: bool = False  # the result tells how long compiling takes, so that nothing is compiled before
    folders: tuple[str, ...] = ()  # in `results/`, where a run that was interrupted goes on

    @property
    def result(self) -> pathlib.Path:
        return RESULTS / f"{self.name}.json"

    @property
    def scripts(self) -> list[str]:
        return list(dict.fromkeys(shlex.split(command)[0] for command in self.commands))

    @property
    def files(self) -> list[str]:
        words = [word for command in self.commands for word in shlex.split(command)]
        return [word.removeprefix(f"{DATA}/") for word in words if word.startswith(DATA)]

    def lacks(self, data: pathlib.Path | None, peer: str | None) -> list[str]:
        """What is not there and has to be, in words."""
        lacking = [name for name in self.files if data is None or not (data / name).is_file()]
        told = [f"{name} ({FILES[name]})" for name in lacking]
        where = [f"in the folder of --data: {', '.join(told)}"] if told else []
        missing = [package for package in self.packages if importlib.util.find_spec(package) is None]
        where += [f"Python packages: {', '.join(missing)}"] if missing else []
        asks_peer = any(PEER in command for command in self.commands)
        where += ["--peer-python PYTHON, one that has sarracen"] if asks_peer and peer is None else []
        return [*where, "an accelerator that JAX finds"] if self.accelerator and backend() == "cpu" else where


def script(name: str, minutes: float, arguments: str = "", **needs: Any) -> Part:
    """Part of the name of its only script."""
    return Part(name, (f"{name}.py {arguments}".strip(),), minutes, **needs)


def trade(name: str, minutes: float, arguments: str) -> Part:
    return Part(name, (f"trade.py {arguments} -o benchmarks/results/{name}",), minutes, folders=(name,))


MILLION = "--scenes mixer --size 1024 --repeats 2 --baselines"
PARTS = (
    script("imports", 2),
    script("snapshots", 3, "--check"),
    script("mixing", 2, "--check"),
    script("step_doubling", 8),
    script("two_quantities", 6),
    script("launches", 2),
    script("scale", 10, "--check"),
    script("cluster", 8),
    script("project_over_frame", 3),
    Part(
        "projections",
        (f"projections.py {in_data(PROJECTED)} --peer-python {PEER}",),
        20,
        packages=("swiftsimio",),
        compiles=True,
    ),
    script("first_frames", 8, "--check", compiles=True),
    script("first_pictures", 6, f"{in_data(SHOWN_FIRST)} --waits", compiles=True),
    Part(
        "looking_around",
        (
            "looking_around.py scene:mixer",
            f"looking_around.py {in_data(['sphviewer_dm_halo.hdf5'])} --inputs 1000",
            f"looking_around.py scene:mixer {in_data(['pbf_dam_break_048.vtk'])} --browser",
        ),
        6,
        packages=("anywidget",),
    ),
    script("gradients", 10, "--repeats 2 --check", compiles=True),
    script("peers", 10, "--repeats 2 --check", packages=("numba",), compiles=True),
    script("access", 20, "--check"),
    script("surfaces", 5, in_data(LIQUIDS), packages=("pysplashsurf", "trimesh", "embreex")),
    script("vtk_grid", 8, "--repeats 1", packages=("vtk",)),
    script("points_and_grids", 10, "--check"),
    script("oracle", 3),
    script("tolerance", 10, "--repeats 3 --check"),
    script("levels", 10),
    Part("at_size", ("tolerance.py --at-size --repeats 3 --check",), 10),
    script("pilot", 15, "--repeats 1 --sequences"),
    trade("trade", 20, "--repeats 2"),
    trade("trade_200k", 10, f"{MILLION} --particles 200000"),
    trade("trade_1m", 20, f"{MILLION} --particles 1000000"),
    trade("sequences", 20, "--frames 0 1 2 --size 256 --repeats 1 --baselines --converged 1"),
    script("table2", 30),
    Part("table3", ("table2.py --frames 60",), 90),
    script("scaling", 15, "--repeats 1"),
    script("screen", 40),
    script("convergence", 40),
    Part(
        "truth",
        (f"truth.py mixer checker_board radial dam_break flubber letters {in_data(WITH_INTEGRALS)} --cache build/integrals",),
        60,
        compiles=True,
    ),
    Part("calibration", ("calibrate.py",), 20),
    Part("calibration_screen", ("calibrate_screen.py",), 20),
    Part("calibration_segments", ("calibrate_segments.py",), 20),
    script("accelerator", 10, "--check", accelerator=True, compiles=True),
)


@functools.cache
def backend() -> str:
    """Where JAX computes, asked in a process of its own: it may take all memory of an accelerator."""
    return subprocess.run([sys.executable, "-c", BACKEND], capture_output=True, text=True).stdout.strip() or "cpu"


@functools.cache
def sources(script: str) -> tuple[str, ...]:
    """A script of this folder and all others that it imports, in the end."""
    there, waiting = {script}, [script]
    while waiting:
        for name in _imported(HERE / waiting.pop()):
            if name not in there and (HERE / name).is_file():
                there.add(name)
                waiting.append(name)
    return tuple(sorted(there))


def _imported(file: pathlib.Path) -> Iterator[str]:
    """Names of files that a file may import from beside it."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (f"{alias.name}.py" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield f"{node.module}.py"


def run_of(part: Part) -> dict[str, Any]:
    """What the result says of the run that made it: commit, device, date, seconds and more; of none, nothing."""
    if not part.result.exists():
        return {}
    return json.loads(part.result.read_text(encoding="utf-8"))["run"]


def is_of_this_code(commit: str | None, part: Part) -> bool:
    """Nothing of the package, and of what the part runs, is other than it was at a commit."""
    if not commit or commit.endswith("-dirty"):
        return False
    paths = [PACKAGE, *(f"benchmarks/{name}" for script in part.scripts for name in sources(script))]
    return subprocess.run(["git", "-C", str(ROOT), "diff", "--quiet", commit, "--", *paths], capture_output=True).returncode == 0


def pages(part: Part) -> list[str]:
    """Names of the pages that tell figures of the result, as their comments say; of the page of results if a section does."""
    hand_written = [page for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if page != report.PAGE]
    named = re.compile(rf"<!-- figures:[^>]*\b{part.result.name}\b")
    written = [report.PAGE.name] if part.name in report.SECTIONS else []
    return written + [page.name for page in hand_written if named.search(page.read_text(encoding="utf-8"))]


def minutes(part: Part) -> float:
    """How long the part takes: as long as the last time, where its result says so; no longer than estimated if others worked."""
    run = run_of(part)
    if "seconds" not in run:
        return part.estimate
    was_busy = run["load"][0] > BUSY * run["cores"]
    return min(run["seconds"] / 60, part.estimate) if was_busy else run["seconds"] / 60
