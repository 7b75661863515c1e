"""Forty changes of a small file of every format, and 200 single bits of all that is compressed, counted by what comes of them.

Files are read in another process, so that a crash or a hang is counted, and ends no other file.
"""

import concurrent.futures
import multiprocessing

import pytest
from fuzzing import COMPRESSED, KINDS, OUTCOMES, counted, write_all

CHANGES, BITS = 40, 200
GUARD_SECONDS = 300


def counted_apart(runs):
    """What `counted` gives of every run, in a process that is started again where one dies or does not end."""
    pool = None
    for run in runs:
        pool = pool or concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
        try:
            yield pool.submit(counted, *run).result(GUARD_SECONDS)
        except (concurrent.futures.process.BrokenProcessPool, TimeoutError) as error:
            for process in (pool._processes or {}).values():
                process.kill()
            pool = None
            yield {"failed": 1}, [f"{run[0]}: the process died or did not end: {error!r}"]
    if pool:
        pool.shutdown()


@pytest.mark.slow
def test_no_change_that_a_file_betrays_is_read(samples, tmp_path):
    for library in ("nibabel", "nrrd", "h5py", "meshio", "OpenEXR"):
        pytest.importorskip(library)
    originals = tmp_path / "whole"
    originals.mkdir()
    write_all(originals, samples)
    runs = [(name, CHANGES, False) for name in KINDS] + [(name, BITS, True) for name in COMPRESSED]
    rows, wrong = [], []
    given = [(name, originals / name, tmp_path, number, 0, bits) for name, number, bits in runs]
    for (name, _, bits), (counts, said) in zip(runs, counted_apart(given), strict=True):
        rows.append((name, "bits" if bits else "changes", *(counts.get(outcome, 0) for outcome in OUTCOMES)))
        wrong += said
    sums = [("sum", what, *(sum(row[2 + n] for row in rows if row[1] == what) for n in range(5))) for what in ("changes", "bits")]
    print()
    for row in [("file", "what", *OUTCOMES), *rows, *sums]:
        print("".join(f"{cell!s:>14}" for cell in row))
    assert not wrong, "\n".join(wrong)
