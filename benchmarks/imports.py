"""What importing costs: `import jaxsph` alone takes no tenth of `import jax`, with the names of a first picture at most 3 of it.

Each is a process of its own, in turns; medians. Writes `results/imports.json`.

    python benchmarks/imports.py
"""

import argparse
import pathlib
import statistics
import subprocess
import sys
import time

from kept import keep

USED = ("Particles", "TransferFunction", "Camera", "Scene", "Settings", "render", "io.write_image")
RESULTS = pathlib.Path(__file__).with_name("results") / "imports.json"
CONTENDERS = {
    "nothing": "pass",
    "jax": "import jax, jax.numpy",
    "jaxsph": "import jaxsph",
    "a first picture": f"import jaxsph as js; {', '.join(f'js.{name}' for name in USED)}",
}


def seconds(code: str) -> float:
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    repeats = parser.parse_args().repeats
    taken = [{name: seconds(code) for name, code in CONTENDERS.items()} for _ in range(repeats + 1)][1:]
    found = {name: statistics.median(one[name] for one in taken) for name in CONTENDERS}
    bare = found["nothing"]
    over = {name: (found[name] - bare) / (found["jax"] - bare) for name in CONTENDERS}
    for name in CONTENDERS:
        print(f"{name:16} {found[name]:6.3f} s, {over[name]:5.2f} of jax")
    keep(RESULTS, CONTENDERS, repeats=repeats, seconds=found, over_jax=over)
    assert over["jaxsph"] < 0.1, over
    assert over["a first picture"] < 3, over


if __name__ == "__main__":
    main()
