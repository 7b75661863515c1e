"""Freed memory does not stay with the process."""

import subprocess
import sys
from pathlib import Path

import pytest

from jaxsph.engine.runtime import programs

STATM = Path("/proc/self/statm")
IN_A_NEW_PROCESS = """
import numpy as np
from pathlib import Path
from jaxsph.engine.runtime import programs

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

with programs.given_back_at_once():
    before = resident()
    arrays = [np.ones(1 << 19) for _ in range(16)]
    held = resident()
    del arrays
    print(held - before, resident() - before)
"""


@pytest.mark.skipif(not STATM.exists(), reason="only Linux says how much is resident")
def test_what_is_freed_is_given_back_at_once():
    """64 MiB in arrays of 4 MiB; in a process of its own, as one that has freed much serves them from that."""
    told = subprocess.run([sys.executable, "-c", IN_A_NEW_PROCESS], check=True, capture_output=True, text=True).stdout
    held, kept = map(int, told.split())
    assert held > 60 << 20 and kept < 8 << 20


def test_another_c_library_is_no_error(monkeypatch):
    programs._of_libc.cache_clear()
    monkeypatch.setattr(programs.ctypes, "CDLL", lambda _: object())
    try:
        programs.give_back()
        with programs.given_back_at_once():
            pass
    finally:
        programs._of_libc.cache_clear()
