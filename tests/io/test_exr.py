import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsph
import jaxsph.io as io
from jaxsph.model.image import Image

OpenEXR = pytest.importorskip("OpenEXR")

METADATA = (
    ("tolerance", 0.004),
    ("estimator", "interval"),
    ("camera", "perspective 4x3"),
    ("samples", 256),
    ("x", None),
)


def make_image(**changes):
    rng = np.random.default_rng(0)
    layer = lambda: rng.random((3, 4), np.float32)  # noqa: E731
    depth = layer()
    depth[0, 0] = np.inf
    fields = {
        "color": rng.random((3, 4, 3), np.float32), "transmittance": layer(), "depth": depth, "error_bound": layer(),
        "evaluations": np.arange(12, dtype=np.float32).reshape(3, 4), "certified": True, "faults": 0, "stats": {},
        "metadata": METADATA,
    }  # fmt: skip
    return Image(**{**fields, **changes})


def test_every_layer_comes_back_as_it_was(tmp_path):
    image = make_image()
    io.write_image(tmp_path / "a.exr", image)
    got = io.read_image(tmp_path / "a.exr")
    for name in ("color", "depth", "error_bound", "evaluations"):
        np.testing.assert_array_equal(getattr(got, name), getattr(image, name))
        assert getattr(got, name).dtype == np.float32
    np.testing.assert_allclose(got.transmittance, image.transmittance, rtol=0, atol=np.finfo(np.float32).eps)
    assert got.certified is True and got.faults == 0


def test_metadata_comes_back_as_it_was_with_the_version_added(tmp_path):
    io.write_image(tmp_path / "a.exr", make_image())
    got = dict(io.read_image(tmp_path / "a.exr").metadata)
    assert {name: got[name] for name, _ in METADATA} == dict(METADATA)
    assert got["jaxsph.version"] == jaxsph.__version__ and got["certified"] is True


def test_the_channels_have_the_names_that_compositors_know(tmp_path):
    image = make_image()
    image.save(tmp_path / "a.exr")
    file = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True)
    assert set(file.channels()) == {"R", "G", "B", "A", "Z", "error.bound", "work.evaluations"}
    np.testing.assert_array_equal(file.channels()["A"].pixels, 1 - image.transmittance)
    assert {channel.pixels.dtype for channel in file.channels().values()} == {np.dtype(np.float32)}
    assert file.header()["certified"] == "true"


def test_layers_that_a_foreign_image_lacks_are_unknown(tmp_path):
    layer = np.ones((2, 2), np.float32)
    OpenEXR.File({}, {"R": layer, "G": layer, "B": layer}).write(str(tmp_path / "a.exr"))
    got = io.read_image(tmp_path / "a.exr")
    np.testing.assert_array_equal(got.color, np.ones((2, 2, 3)))
    assert np.isnan(got.transmittance).all() and got.certified is False


def test_an_image_without_colour_is_refused(tmp_path):
    OpenEXR.File({}, {"Z": np.ones((2, 2), np.float32)}).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"a\.exr: has no channel R G B, only Z"):
        io.read_image(tmp_path / "a.exr")


@given(fraction=st.floats(0, 1, exclude_max=True))
@settings(max_examples=15, deadline=None)
def test_an_image_cut_anywhere_is_refused_by_name(fraction, tmp_path_factory):
    path = tmp_path_factory.mktemp("cut") / "a.exr"
    io.write_image(path, make_image())
    whole = path.read_bytes()
    path.write_bytes(whole[: int(fraction * len(whole))])
    with pytest.raises(ValueError, match=r"a\.exr"):
        io.read_image(path)


def test_metadata_names_of_the_format_itself_are_refused(tmp_path):
    with pytest.raises(ValueError, match="'compression', which OpenEXR uses itself"):
        io.write_image(tmp_path / "a.exr", make_image(metadata=(("compression", "none"),)))
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_suffix_is_answered_with_the_known_ones(tmp_path):
    with pytest.raises(ValueError, match=r"a\.jpg: images are written and read as \.exr or \.png"):
        io.write_image(tmp_path / "a.jpg", make_image())
    with pytest.raises(ValueError, match=r"a\.jpg"):
        io.read_image(tmp_path / "a.jpg")


def test_a_missing_image_is_a_file_not_found_error(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.exr"):
        io.read_image(tmp_path / "gone.exr")
