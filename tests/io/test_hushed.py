"""Errors of libraries are said once, by the exception."""

import os

import numpy as np
import pytest

import jaxsph as js
from jaxsph.io.hushed import hushed


def test_what_is_written_past_python_is_not_seen_inside_and_is_again_behind(capfd):
    with hushed():
        os.write(2, b"of a library")
        os.write(1, b"of a library")
    os.write(2, b"of ours")
    assert capfd.readouterr() == ("", "of ours")


def test_a_damaged_exr_is_refused_in_one_message_and_prints_nothing(tmp_path, capfd):
    rng = np.random.default_rng(0)
    layer = rng.random((48, 64)).astype(np.float32)
    image = js.Image(rng.random((48, 64, 3)).astype(np.float32), layer, layer, layer, layer, True, 0, {}, ())
    js.io.write_image(tmp_path / "a.exr", image)
    content = bytearray((tmp_path / "a.exr").read_bytes())
    content[len(content) // 2] ^= 255
    (tmp_path / "a.exr").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.exr: cannot be read as OpenEXR"):
        js.io.read_image(tmp_path / "a.exr")
    assert capfd.readouterr() == ("", "")
