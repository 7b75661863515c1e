"""Promises of --devices: what is not there is refused before anything is read, in one line."""

import jax
import pytest

from jaxsph.cli import main as cli

TOO_MANY = str(len(jax.local_devices()) + 1)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ((TOO_MANY,), f"got {TOO_MANY}"),
        (("0",), "got 0"),
        (("some",), "must be all or a number of devices"),
        (("all", "--progressive"), "leave one of them out"),
    ],
)
def test_what_cannot_be_had_is_wrong_usage(tmp_path, capsys, given, why):
    output = tmp_path / "out.png"
    assert cli.main(["render", "scene:mixer", "-o", str(output), "--devices", *given]) == 2
    said = capsys.readouterr().err
    assert why in said and said.count("\n") == 1
    assert not output.exists()


@pytest.mark.slow
def test_a_picture_is_made_by_all_devices(tmp_path):
    output = tmp_path / "out.png"
    small = ["--size", "24x24", "--samples", "16"]
    assert cli.main(["render", "scene:mixer:particles=300", *small, "-o", str(output), "--devices", "all"]) == 0
    assert output.stat().st_size > 0
