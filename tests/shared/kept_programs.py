"""`python kept_programs.py FOLDER WORKERS` prints where, in a folder, programs that tests compiled are kept for later runs.

JAX finds a program again by all that it is made of, the version of jaxlib included, but not by the processor, for whose
instructions it was compiled, nor by how many cores a worker has. So there is one folder for each of these. Together they keep
what was used last, up to a size that some thirty changes of everything fill.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
import sys
from pathlib import Path

MOST_BYTES = 2 * 10**9
PROCESSOR = ("model name", "flags", "CPU part", "Features")  # lines of /proc/cpuinfo, on x86 and on ARM


def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """The model of the processor and the instructions that it has."""
    if not cpuinfo.exists():
        return f"{platform.machine()} {platform.processor()}"
    lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    return "\n".join(sorted({line for line in lines if line.startswith(PROCESSOR)}))


def folder(parent: Path, workers: str, runs_on: str | None = None) -> Path:
    """Where programs are kept that `workers` processes on this machine compile."""
    runs_on = processor() if runs_on is None else runs_on
    digest = hashlib.sha256(runs_on.encode()).hexdigest()[:12]
    return parent / f"{importlib.metadata.version('jaxlib')}-{digest}-{workers}"


def trim(parent: Path, most: int = MOST_BYTES) -> None:
    """Delete what was used longest ago, as long as there are more bytes than `most`."""
    files = [(file, file.stat()) for file in parent.rglob("*") if file.is_file()]
    size = sum(stat.st_size for _, stat in files)
    for file, stat in sorted(files, key=lambda pair: max(pair[1].st_atime, pair[1].st_mtime)):
        if size <= most:
            return
        file.unlink(missing_ok=True)
        size -= stat.st_size


if __name__ == "__main__":
    parent, workers = Path(sys.argv[1]).absolute(), sys.argv[2]
    trim(parent)
    print(folder(parent, workers))
