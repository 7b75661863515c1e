"""Freed memory does not stay with the process."""

from pathlib import Path

import numpy as np
import pytest

from jaxsph.numerics import free_memory

STATM = Path("/proc/self/statm")


def resident():
    return int(STATM.read_text().split()[1]) * 4096


@pytest.mark.skipif(not STATM.exists(), reason="only Linux says how much is resident")
def test_what_is_freed_is_given_back_at_once():
    with free_memory.given_back_at_once():
        before = resident()
        arrays = [np.ones(1 << 19) for _ in range(16)]  # 4 MiB each
        held = resident()
        del arrays
        assert held > before + (60 << 20) and resident() < before + (8 << 20)


def test_another_c_library_is_no_error(monkeypatch):
    free_memory._of_libc.cache_clear()
    monkeypatch.setattr(free_memory.ctypes, "CDLL", lambda _: object())
    try:
        free_memory.give_back()
        with free_memory.given_back_at_once():
            pass
    finally:
        free_memory._of_libc.cache_clear()
