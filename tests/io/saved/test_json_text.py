"""JSON files that people write: what is refused, in one line that names the file."""

import pytest

from jaxsph.io.saved.json_text import numbers_only, read_json


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 100_000, "too deeply"),
        ('{"a": ' * 100_000, "too deeply"),
        ("[" + "1" * 5000 + "]", "5000 digits"),
        ("[1" + "0" * 400 + "]", "401 digits"),
        ('{"keys": 1, "keys": 2}', '"keys" stands twice'),
        ("{", "is no JSON"),
    ],
    ids=lambda text: text[:12],
)
def test_what_is_refused_names_the_file_in_one_line(tmp_path, text, said):
    path = tmp_path / "look.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=said) as error:
        read_json(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value) and len(str(error.value)) < 300


def test_rows_of_numbers_hold_numbers_alone():
    numbers_only("colors", [[0, 1.5], [2, 3]])
    for odd in ("1", True, None, {}):
        with pytest.raises(ValueError, match='"colors" must hold numbers'):
            numbers_only("colors", [[0, odd]])
