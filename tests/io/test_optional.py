"""Libraries that may be missing: one sentence says which, what for, and how to install it."""

import pytest

from jaxsph.io.optional import require


@pytest.mark.parametrize("purpose", ["figures", "reading HDF5 files"])
def test_what_is_missing_is_said_for_one_purpose_and_for_several_things(purpose):
    with pytest.raises(ImportError) as raised:
        require("no_such_library.part", purpose, "color")
    assert str(raised.value) == f'the library `no_such_library` is needed for {purpose}: pip install "jaxsph[color]"'


def test_what_is_there_is_given():
    assert require("math", "numbers").pi > 3
