import os
import re
import stat
import time

import pytest

from jaxsph.io import replace
from jaxsph.io.replace import MARK, STALE_SECONDS, written_whole


def test_a_file_is_replaced_when_the_block_succeeds_and_stays_when_it_fails(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(ZeroDivisionError), written_whole(target) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert target.read_text() == "old" and list(tmp_path.iterdir()) == [target]
    with written_whole(target) as temporary:
        temporary.write_text("new")
        assert temporary.suffix == ".txt" and target.read_text() == "old"
    assert target.read_text() == "new" and list(tmp_path.iterdir()) == [target]
    (tmp_path / "b.txt").write_text("ordinary")  # others may read it as far as the user wishes
    assert stat.S_IMODE(os.stat(target).st_mode) == stat.S_IMODE(os.stat(tmp_path / "b.txt").st_mode)


@pytest.mark.parametrize(("where", "why"), [("gone/a.png", "folder .*gone does not exist"), ("", "it is a folder")])
def test_a_place_that_cannot_be_written_to_is_refused_by_name(where, why, tmp_path):
    with pytest.raises(ValueError, match=why), written_whole(tmp_path / where):
        pass


def leave(folder, name, days=2.0):
    """A file that nobody has written to for some days."""
    path = folder / name
    path.write_text("half")
    os.utime(path, (time.time() - days * STALE_SECONDS,) * 2)
    return path


def test_what_a_killed_process_has_left_is_removed_at_the_next_write_of_that_name(tmp_path):
    mark = "-jaxsph-0123456789abcdef"
    gone = [f".a{mark}.txt", ".a-jaxsph-0000000000000000.txt"]
    of_users = [f"a{mark}.txt", ".a.0123abcd.txt", ".a.txt"]
    kept = [f".another{mark}.txt", f".a.b{mark}.txt", f".a{mark}.png", f".a{mark}.bak.txt", *of_users]
    for name in gone + kept:
        leave(tmp_path, name)
    fresh = leave(tmp_path, ".a-jaxsph-0123456789abcde0.txt", days=0.9)  # of a process that is at work
    folder = tmp_path / ".a-jaxsph-0123456789abcde1.txt"
    folder.mkdir()
    os.utime(folder, (0, 0))
    with written_whole(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", fresh.name, folder.name, *kept}


@pytest.mark.parametrize(
    "name", ["a.txt", "a", "long" * 60 + ".txt", "n" * 251 + ".txt", "\N{GREEK SMALL LETTER RHO}" * 120 + ".txt", "a.tar.txt"]
)
def test_temporary_files_of_any_name_are_told_from_those_of_users(name, tmp_path):
    with written_whole(tmp_path / name) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == (tmp_path / name).suffix and re.search(MARK, temporary.name)
        replace._left_in.cache_clear()
        replace._sweep(tmp_path / name)
        assert temporary.exists()
        leave(tmp_path, temporary.name)
        replace._sweep(tmp_path / name)
        assert not temporary.exists()
        temporary.touch()
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_of_a_link_the_file_that_it_points_to_is_written(tmp_path):
    (tmp_path / "there").mkdir()
    link = tmp_path / "link.png"
    link.symlink_to("there/target.png")
    for text in ("first", "second"):
        with written_whole(link) as temporary:
            temporary.write_text(text)
        assert link.is_symlink() and (tmp_path / "there" / "target.png").read_text() == text
