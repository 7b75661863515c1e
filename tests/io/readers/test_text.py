import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io

points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.5]])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("bare.csv", "1,2,3,7\n4,5,6.5,8\n"),
        ("bare.txt", "1 2 3 7\n  4\t5 6.5 8\n"),
        ("semicolon.csv", "1;2;3;7\n4;5;6.5;8\n"),
        ("header.csv", "x,y,z,a\n1,2,3,7\n4,5,6.5,8\n"),
        ("quoted.csv", '"x","y","z","a"\n"1","2","3","7"\n"4","5","6.5","8"\n'),
        ("paraview.csv", '"a","Points:0","Points:1","Points:2"\n7,1,2,3\n8,4,5,6.5\n'),
        ("units.csv", "a (kg),x [m],y [m],z [m]\n7,1,2,3\n8,4,5,6.5\n"),
        ("header.txt", "x y z a\n1 2 3 7\n4 5 6.5 8\n"),
        ("comment.dat", "# made by hand\n# x y z a\n1 2 3 7\n4 5 6.5 8\n"),
        ("other_comment.dat", "# hello\n1 2 3 7\n4 5 6.5 8\n"),
        ("windows.csv", "\ufeffX,Y,Z,a\r\n1,2,3,7\r\n4,5,6.5,8\r\n"),
        ("words.csv", "kind,x,y,z,a\nwater,1,2,3,7\nwater,4,5,6.5,8\n"),
        ("element.xyz", "2\nhello\nAr 1 2 3 7\nAr 4 5 6.5 8\n"),
        ("bare.xyz", "2\nhello there\n1.0 2 3 7\n4 5 6.5 8\n"),
        ("number.xyz", "2\nhello\n18 1 2 3 7\n6 4 5 6.5 8\n"),
        ("extended_number.xyz", "2\nProperties=Z:I:1:pos:R:3:a:R:1\n18 1 2 3 7\n6 4 5 6.5 8\n"),
        ("blank.xyz", "2\n\nAr 1 2 3 7\nAr 4 5 6.5 8\n"),
        ("extended.xyz", "2\nProperties=species:S:1:pos:R:3:a:R:1\nAr 1 2 3 7\nAr 4 5 6.5 8\n"),
    ],
)
def test_points_and_a_scalar_are_found_in(name, content, tmp_path):
    (tmp_path / name).write_text(content, encoding="utf-8", newline="")
    table = io.read_table(tmp_path / name)
    np.testing.assert_array_equal(table.position, points)
    np.testing.assert_array_equal(table.columns[table.scalars[-1]], [7, 8])


def test_columns_of_words_are_left_out_and_said_so(tmp_path):
    (tmp_path / "a.csv").write_text("kind,x,y,z\nwater,1,2,3\n")
    table = io.read_table(tmp_path / "a.csv")
    assert table.columns == {} and "left out kind: not numbers" in table.conventions


def test_components_become_vectors_that_do_not_take_the_place_of_a_scalar(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,vx,vy,vz,B:0,B:1,B:2,C,C_x,C_y,C_z\n1,2,3,4,5,6,7,8,9,13,3,4,12\n")
    found = {name: column.tolist()[0] for name, column in io.read_table(tmp_path / "a.csv").columns.items()}
    assert found == {"v": [4, 5, 6], "B": [7, 8, 9], "C": 13, "C_xyz": [3, 4, 12]}


def test_a_line_without_an_end_is_pointed_out(tmp_path):
    (tmp_path / "a.csv").write_text("1,2,3\n4,5,6")
    assert any("check that the file is complete" in s for s in io.read_table(tmp_path / "a.csv").conventions)


ROUNDED = "has the whole number {} in the column `id`.*decimal point"
LARGE, LARGEST = str(2**53 + 1), str(2**64 + 1)


NAMES = ["x", "y", "z", "particle mass", "h", "density of gas", "v_x", "v_y", "v_z", "itype"]
HEADS = {
    "splash": "# " + " ".join(f"{name:>15}" for name in NAMES[:-1]) + " itype",
    "shifted": "#" + " ".join(f"{name:>15}" for name in NAMES[:-1]) + " itype",
    "left": "# " + " ".join(f"{name:<15}" for name in NAMES),
    "commas": "# " + ", ".join(NAMES),
    "brackets": "#" + "".join(f" [{nth + 1:02d} {name:>12}]" for nth, name in enumerate(NAMES)),
    "plain": " ".join(f"{name:>15}" for name in NAMES[:-1]) + " itype",
}


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("suffix", [".ascii", ".txt", ".dat"])
def test_names_with_blanks_are_those_of_their_fields(head, suffix, tmp_path):
    rows = np.random.default_rng(0).uniform(-1, 1, (4, 9))
    lines = [
        "# snap: created by SPLASH",
        "#",
        HEADS[head],
        *(" ".join(f"{value:15.7E}" for value in row) + "  1" for row in rows),
    ]
    (tmp_path / f"a{suffix}").write_text("\n".join(lines[2 * (head == "plain") :]) + "\n")
    table = io.read_table(tmp_path / f"a{suffix}")
    assert set(table.columns) == {"particle mass", "h", "density of gas", "v", "itype"}
    np.testing.assert_allclose(table.columns["v"], rows[:, 6:], atol=1e-6)
    assert "names" not in " ".join(table.conventions).partition("column `h`")[0]
    assert len(io.read_particles(tmp_path / f"a{suffix}", "particle mass", 0.5).to_numpy()["quantity"]) == 4


def test_a_comment_that_names_no_columns_is_said(tmp_path):
    (tmp_path / "a.txt").write_text("# made by hand\n1 2 3 4 5\n6 7 8 9 10\n")
    table = io.read_table(tmp_path / "a.txt")
    assert set(table.columns) == {"column4", "column5"}
    assert "names could not be had: `made by hand` does not name each of the columns" in table.conventions


def test_a_column_with_a_word_in_it_is_left_out(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,mass,note\n1,2,3,4,5\n6,7,8,9,\n1,1,1,1,n/a\n")
    table = io.read_table(tmp_path / "a.csv")
    assert set(table.columns) == {"mass"} and "left out note: not numbers" in table.conventions
    for name in ("y", "mass"):
        (tmp_path / "a.csv").write_text("x,y,z,mass\n1,2,3,4\n6,7,8,9\n1,1,1,1\n".replace("7" if name == "y" else "9", "none"))
        refused("cannot be read as text table", io.read_table, tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("1,2,3\n4,5\n", "has rows of 2 and 3 columns"),
        ("x,y,z\n1,2,water\n3,4,5\n", "(cannot be read as text table|holds no positions)"),
        ("x,y,z\n1,2,3\n3,4,water\n", "cannot be read as text table"), ("x,a\n1,2\n", "holds no positions: there are x, a"),
        ("x,y,z,z\n1,2,3,4\n", "has columns of the same name"), ("x,y,z\n1,2,3,4\n", "names 3 columns, but its first row has 4"),
        ("x,y,z\n1,2,nan\n", "positions must be finite"), ("3\n\nAr 1 2 3\n", "announces 3 particles, but 1 lines follow"),
        ("1,2\0,3\n", "is not text: it holds zero bytes"),
        ("1\nProperties=pos:R:3:a:R:10000000000\n1 2 3 4\n", "names 10000000003 "),
        ("0\nProperties=pos:R:3:a:R:10000000000\n\n", "names 10000000003 "),
        ("10000000000\n\nAr 1 2 3\n", "announces 10000000000 "),
        *(
            (f"1\nProperties={properties}\n1 2 3\n", "has `Properties=.*name:type:width")
            for properties in ("pos:R", "pos:R:three", "pos:R:3:a")
        ),
        ("x [m],y [m],z [m],a [kg],a [g]\n1,2,3,4,4000\n", "has the column `a` twice"),
        ("x,y,z,X,Y,Z\n1,2,3,4,5,6\n", "has positions twice, once more as X, Y, Z"),
        ("x,y,z,a_x,a_y,a_z,a.x,a.y,a.z,a:0,a:1,a:2\n1,2,3,4,5,6,7,8,9,1,2,3\n", "has the vector `a_xyz` twice"),
        *(
            (f"x,y,z,id\n1,2,3,{word}\n1,2,3,{other}\n", ROUNDED.format(word))
            for word, other in ((LARGEST, 1), (LARGE, 0.5), (LARGE, "nan"))
        ),
        ("Part,Np\n1,2\n\nx,y,z\n1,2,3\n4,5\n", ""),  # lines above names, where all below is no table
        ("a b\n1 2\nx,y,z\n1,2\n", ""), ("1,2\nx,y\n3,4\n", ""),
    ],
)  # fmt: skip
def test_bad_tables_are_refused_with_the_reason(content, reason, tmp_path):
    (tmp_path / "a.csv").write_text(content)
    refused(rf"a\.csv: {reason}", io.read_table, tmp_path / "a.csv")


def test_atomic_numbers_in_xyz_are_no_coordinates_and_said_so(tmp_path):
    (tmp_path / "a.xyz").write_text("2\n\n18 1 2 3\n6 4 5 6\n")
    table = io.read_table(tmp_path / "a.xyz")
    np.testing.assert_array_equal(table.position, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(table.columns["element"], [18, 6])
    assert any("whole numbers in the first column are taken for elements" in said for said in table.conventions)
    (tmp_path / "a.xyz").write_text("2\n\n1 2 3\n4 5 6\n")  # three columns can only be coordinates
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.xyz").position, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("ids", "kind"),
    [([2**53 + nth for nth in range(6)], np.int64), ([-(2**63), 2**63 - 1, 0], np.int64), ([2**64 - 1, 0, 2**63 + 1], np.uint64)],
)
@pytest.mark.parametrize("row", ["{},1,2,3\n", '"{}","1","2","3"\n', "{} 1 2 3\n"])
def test_whole_numbers_keep_all_their_digits(ids, kind, row, tmp_path):
    names = row.format("id").translate(str.maketrans("123", "xyz"))
    (tmp_path / "a.csv").write_text(names + "".join(map(row.format, ids)))
    column = io.read_table(tmp_path / "a.csv").columns["id"]
    assert column.dtype == kind and column.tolist() == ids


def test_numbers_that_float64_holds_stay_such(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,a,b,c\n1,2,3,4,1e300,9007199254740992\n1,2,3,5,1,2.5\n")
    columns = io.read_table(tmp_path / "a.csv").columns
    assert all(columns[name].dtype == np.float64 for name in "abc") and columns["c"].tolist() == [2.0**53, 2.5]


ROWS = "0.5,1,2,7\n3,4.5,5,8\n6,7,8.5,9\n"


@pytest.mark.parametrize(("names", "end"), [
    ("x [m],y [m],z [m],mass\n", ""), ("x [m],y [m],z [m],mass\n", ","), ("x,y,z,mass\n", ""), ("x,y,z,mass\n", ","),
    ("x,y,z,mass,\n", ","), (None, ""), (None, ","),
])  # fmt: skip
@pytest.mark.parametrize("above", ["", "Part,Time,Np\n3,0.25,3\n\n", "written by a program\n", "a;b\n1;2\n"])
@pytest.mark.parametrize("mark", [",", ";"])
def test_lines_above_the_names_and_separators_at_ends_are_no_columns(mark, above, names, end, tmp_path):
    text = (names or "") + ROWS.replace("\n", f"{end}\n")
    if names is None:
        above = ""
    (tmp_path / "a.csv").write_text(above + text.replace(",", mark))
    table = io.read_table(tmp_path / "a.csv")
    np.testing.assert_array_equal(table.position, [[0.5, 1, 2], [3, 4.5, 5], [6, 7, 8.5]])
    assert list(table.columns) == (["column4"] if names is None else ["mass"])
    assert any("above the names" in said for said in table.conventions) == bool(above)


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("x,y,z,name\n1,2,3,\n4,5,6,\n", []),  # a column that is empty has a name
        ("x y z\n1 2 3\n4 5 6\n", []),
        ("3\na b c d\nAr 1 2 3\nAr 4 5 6\nAr 7 8 9\n", []),
        ("x,y,z,kind\n1,2,3,gas\n4,5,6,star\n", []),
    ],
)
def test_plain_tables_are_read_as_ever(text, columns, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    table = io.read_table(tmp_path / "a.csv")
    assert list(table.columns) == columns and table.position[0].tolist() == [1, 2, 3]
    assert not any("above" in said for said in table.conventions)
