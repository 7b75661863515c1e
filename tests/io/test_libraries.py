"""Optional libraries: what is missing is said once, with how to install it; errors are said once, by the exception."""

import os

import numpy as np
import pytest
from refusals import refused

import jaxsph as js
from jaxsph.io.libraries import hushed, require


@pytest.mark.parametrize("purpose", ["figures", "reading HDF5 files"])
def test_what_is_missing_is_said_for_one_purpose_and_for_several_things(purpose):
    with pytest.raises(ImportError) as raised:
        require("no_such_library.part", purpose, "color")
    assert str(raised.value) == f'the library `no_such_library` is needed for {purpose}: pip install "jaxsph[color]"'


def test_what_is_there_is_given():
    assert require("math", "numbers").pi > 3


def test_what_is_written_past_python_is_not_seen_inside_and_is_again_behind(capfd):
    with hushed():
        os.write(2, b"of a library")
        os.write(1, b"of a library")
    os.write(2, b"of ours")
    assert capfd.readouterr() == ("", "of ours")


def test_a_damaged_exr_is_refused_in_one_message_and_prints_nothing(tmp_path, capfd):
    color, layer = np.random.default_rng(0).random((48, 64, 3)).astype(np.float32), np.zeros((48, 64), np.float32)
    js.io.write_image(tmp_path / "a.exr", js.Image(color, layer, layer, layer, layer, True, 0, {}, ()))
    content = bytearray((tmp_path / "a.exr").read_bytes())
    content[len(content) // 2] ^= 255
    (tmp_path / "a.exr").write_bytes(content)
    refused(r"a\.exr: cannot be read as OpenEXR", js.io.read_image, tmp_path / "a.exr")
    assert capfd.readouterr() == ("", "")
