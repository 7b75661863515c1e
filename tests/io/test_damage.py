import numpy as np
import pytest

import jaxsph.io as io
from jaxsph.io.damage import explained


def test_memory_that_runs_out_is_said_with_the_name_of_the_file():
    with pytest.raises(MemoryError, match=r"a\.h5: .*Unable to allocate"), explained("a.h5", "HDF5"):
        np.zeros((2**40, 2**18))


def test_what_belongs_to_the_caller_passes_as_it_is():
    for error in (FileNotFoundError("a"), PermissionError("b"), ImportError("c")):
        with pytest.raises(type(error)) as caught, explained("a.h5", "HDF5"):
            raise error
        assert caught.value is error


def test_a_refusal_keeps_its_words_and_other_failures_are_quoted():
    with pytest.raises(io.DataError, match=r"^a\.h5: is empty$"), explained("a.h5", "HDF5"):
        raise io.DataError("is empty")
    with (
        pytest.raises(ValueError, match=r"a\.h5: cannot be read as HDF5 \(KeyError: 'x'\); .*copy it again"),
        explained("a.h5", "HDF5"),
    ):
        {}["x"]
