import os
import stat

import pytest

from jaxsph.io.replace import written_whole


def test_a_file_is_replaced_when_the_block_succeeds(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with written_whole(target) as temporary:
        temporary.write_text("new")
        assert temporary.suffix == ".txt" and target.read_text() == "old"
    assert target.read_text() == "new" and list(tmp_path.iterdir()) == [target]


def test_the_old_file_stays_and_nothing_is_left_when_the_block_fails(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(ZeroDivisionError), written_whole(target) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert target.read_text() == "old" and list(tmp_path.iterdir()) == [target]


def test_others_may_read_the_file_as_far_as_the_user_wishes(tmp_path):
    with written_whole(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
    (tmp_path / "b.txt").write_text("ordinary")
    modes = [stat.S_IMODE(os.stat(tmp_path / name).st_mode) for name in ("a.txt", "b.txt")]
    assert modes[0] == modes[1]


@pytest.mark.parametrize(("where", "why"), [("gone/a.png", "folder .*gone does not exist"), ("", "it is a folder")])
def test_a_place_that_cannot_be_written_to_is_refused_by_name(where, why, tmp_path):
    with pytest.raises(ValueError, match=why), written_whole(tmp_path / where):
        pass


def test_of_a_link_the_file_that_it_points_to_is_written(tmp_path):
    (tmp_path / "there").mkdir()
    link = tmp_path / "link.png"
    link.symlink_to("there/target.png")
    for text in ("first", "second"):
        with written_whole(link) as temporary:
            temporary.write_text(text)
        assert link.is_symlink() and (tmp_path / "there" / "target.png").read_text() == text


def test_a_name_may_be_as_long_as_the_disk_takes(tmp_path):
    path = tmp_path / ("n" * 251 + ".txt")
    with written_whole(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"
