"""Conditions mean what NumPy means by them, refuse all else by the place where it stands, and never run anything."""

import ast
import builtins

import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st

import jaxsph.io as io
from jaxsph.io.settle import where
from jaxsph.io.settle.matching import select
from jaxsph.io.settle.where import ConditionError

COUNT = 200


def table_of(count=COUNT):
    rng = np.random.default_rng(0)
    columns = {
        "Temperature": 10 ** rng.uniform(2, 6, count),
        "rho": rng.uniform(0, 4, count),
        "velocity": rng.normal(size=(count, 3)),
        "Star Formation Rate": rng.normal(size=count),
        "Größe": rng.uniform(0, 1, count),
        "id": np.arange(count),
    }
    return io.ParticleTable(rng.uniform(-1, 1, (count, 3)), columns, support=np.full(count, 0.3))


TABLE = table_of()
T, RHO, V, RATE, SIZE, ID = TABLE.columns.values()
X, Y, Z = TABLE.position.T

MEANT = {
    "Temperature > 1e4": T > 1e4,
    "temperature>1e4 and rho < 2": (T > 1e4) & (RHO < 2),
    "Temperature > 1e5 or rho < 2 and x > 0": (T > 1e5) | ((RHO < 2) & (X > 0)),
    "(Temperature > 1e5 or rho < 2) and x > 0": ((T > 1e5) | (RHO < 2)) & (X > 0),
    "not rho < 2 and x > 0": (RHO >= 2) & (X > 0),
    "not (rho < 2 and x > 0)": ~((RHO < 2) & (X > 0)),
    "-0.5 < x <= 0.5": (X > -0.5) & (X <= 0.5),
    "2 + 3 * x ** 2 > 4 - y / 2": 2 + 3 * X**2 > 4 - Y / 2,
    "-x ** 2 < -0.25": -(X**2) < -0.25,
    "2 ** 3 ** 0.5 * x > 1": 2 ** (3**0.5) * X > 1,
    "id % 3 == 0": ID % 3 == 0,
    "id != 7": ID != 7,
    "(x > 0) & (y > 0) | ~(z > 0)": ((X > 0) & (Y > 0)) | ~(Z > 0),
    "sqrt(x**2 + y**2) < 0.5": np.hypot(X, Y) < 0.5,
    "hypot(x, y) < max(abs(z), 0.2)": np.hypot(X, Y) < np.maximum(np.abs(Z), 0.2),
    "log10(Temperature) > 4 and exp(x) > 1": (T > 1e4) & (X > 0),
    "log(rho) < min(0.5, y)": np.log(RHO) < np.minimum(0.5, Y),
    "velocity.x > 0": V[:, 0] > 0,
    "vz > 0 and speed > 1": (V[:, 2] > 0) & (np.linalg.norm(V, axis=1) > 1),
    "density > 2": RHO > 2,
    "`Star Formation Rate` > 0": RATE > 0,
    "`Star Formation Rate` > 0 and `velocity`.y < 0": (RATE > 0) & (V[:, 1] < 0),
    "Größe > 0.5 and `Größe` < 0.9 and x > 0": (SIZE > 0.5) & (SIZE < 0.9) & (X > 0),
    "`log10:Temperature` > 4": T > 1e4,
    "  x > 0\n and\ty > 0 ": (X > 0) & (Y > 0),
    "1 < 2": np.ones(COUNT, bool),
    "sqrt(x) >= 0": X >= 0,  # what is no number meets no comparison
    " and ".join(["`x` > 0"] * 150): X > 0,
    "&".join(["(x>0)"] * 600): X > 0,
    "|".join(["(x>0)"] * 600): X > 0,
    "(" * 40 + "(x > 0) " + "& (y > 0)) " * 40: (X > 0) & (Y > 0),
    "(x > 0) & " + "((y > 0) | " * 30 + "(y > 0)" + ")" * 30: (X > 0) & (Y > 0),
}


@pytest.mark.parametrize("text", MEANT, ids=lambda text: text[:60])
def test_a_condition_is_what_numpy_makes_of_it(text):
    assert np.array_equal(select(TABLE, text)[0], MEANT[text])


def test_a_summed_density_is_taken_where_the_file_has_none_and_summed_once_however_often_it_is_named():
    bare, asked = io.ParticleTable(TABLE.position), []
    kept = select(bare, " & ".join(["(density > 1)"] * 5), density=lambda: asked.append(1) or RHO)[0]
    assert np.array_equal(kept, RHO > 1) and len(asked) == 1
    with pytest.raises(ConditionError, match="no quantity 'density'"):
        select(bare, "density > 1")


@pytest.mark.parametrize(
    ("text", "place", "why"),
    [
        ("Temperature >", "at its end", "invalid syntax"), ("rho > 1 Temperature", "at character 9", "invalid syntax"),
        ("(rho > 1", "at character 1", "never closed"),
        ("rho > 1 and pressure < 2", "at character 13, 'pressure'", "no quantity 'pressure'; there are Temperature"),
        ("Größe > 0 and größer < 2", "at character 15, 'größer'", "no quantity"),
        ("  `a b` > 1", "at character 3, '`a b`'", "no quantity 'a b'"),
        ("velocity > 1", "at character 1, 'velocity'", "3 components; choose one"),
        ("rho", "at character 1, 'rho'", "a number, not a condition"),
        ("x > 0 and rho", "at character 11, 'rho'", "a number, not a condition"),
        ("not rho", "at character 5, 'rho'", "a number, not a condition"),
        ("(x > 0) + 1 > 0", "at character 2, 'x > 0'", "a condition, not a number"),
        ("rho > 1 & x < 2", "at character 7, '1'", "put those in brackets"),
        ("rho = 1", "at character 5, '= 1'", "compare by =="), ("x > 0 && y > 0", "at character 8", "write and"),
        ("rho is 1", "at character 1", "< <= > >= == !="), ("rho @ 2 > 1", "at character 1, 'rho @ 2'", r"\+ - \* / "),
        ("rho < 'a'", "at character 7", "there may be names"),
        ("rho[0] > 1", "at character 1, 'rho\\[0\\]'", "there may be names"),
        ("rho < 1e3j", "at character 7", "there may be names"), ("rho < 9" + "9" * 400, "at character 7", "too large"),
        ("sqrt(rho, 2) > 1", "at character 1", "called with 1 number"),
        ("sqrt(x=1) > 1", "at character 1", "called with 1 number"),
        ("print(rho) > 1", "at character 1", "the functions are abs"),
        ("rho.sqrt(1) > 1", "at character 1", "the functions are abs"),
        ("(rho + 1).x > 1", "at character 1", "a point stands between"),
        ("__import__('os').system('true') == 0", "at character 1", "the functions are abs"),
        ("(lambda: 1)() > 0", "at character 1", "the functions are abs"),
        ("[1 for x in y] > 1", "at character 1", "there may be names"),
        ("x > 0 if y > 0 else z > 0", "at character 1", "there may be names"),
        ("(rho := 1) > 0", "at character 2", "there may be names"), ("True", "at character 1", "there may be names"),
        ("x > 0; y > 0", "at character 6", "invalid syntax"), ("", "condition is empty", "Temperature > 1e4"),
        ("x > 0" + " " * 5000, "4096 characters", "shorten it"),
        ("-" * 4000 + "x > 0", "condition '---", "cannot be read|nested too deeply|not understood"),
        ("not " * 900 + "(x > 0)", "condition 'not", "cannot be read|nested too deeply"),
    ],
    ids=lambda text: text[:40],
)  # fmt: skip
def test_what_is_no_condition_is_refused_where_it_stands(text, place, why):
    with pytest.raises(ConditionError, match=place) as error:
        select(TABLE, text)
    assert error.match(why)


TOKENS = st.sampled_from([
    "x", "rho", "`a b`", "velocity.x", "1", "1e400", "'s'", "and", "or", "not", "is", "in", "if", "else", "lambda:", "for", ":=",
    "\n", "+", "-", "**", "%", "&", "~", "<", "==", ".", ",", "(", ")", "[", "]", "{", "}", "`", "=", ";", "#", "\\", "\0", "é",
    "sqrt(", "abs(", "__import__(", "x.__class__", "eval(", "print(", "yield", "await", "*", "@", ":", "f'{x}'", "0x", "1_0",
])  # fmt: skip


@examples(300)
@given(st.one_of(st.lists(TOKENS, max_size=12).map(" ".join), st.lists(TOKENS, max_size=8).map("".join), st.text(max_size=30)))
def test_whatever_is_written_it_is_a_selection_or_a_condition_error(text):
    try:
        kept = select(TABLE, text)[0]
    except ConditionError as error:
        assert str(error)
    except io.DataError as error:
        assert "no particle is left" in str(error)
    else:
        assert kept.dtype == bool and kept.shape == (COUNT,)


@pytest.mark.parametrize("text", ["__import__('os').system('true') > 0", "eval('1') > 0", "x.__class__ > 0", "print(x) > 0"])
def test_nothing_is_run(text, monkeypatch):
    """Neither by Python's compiler nor by its evaluation: only a syntax tree is made."""
    compiled = builtins.compile

    def watched(source, name, mode, flags=0, *more, **others):
        assert flags & ast.PyCF_ONLY_AST
        return compiled(source, name, mode, flags, *more, **others)

    def refused(*given, **more):
        raise AssertionError("something was run")

    monkeypatch.setattr(builtins, "compile", watched)
    for name in ("eval", "exec", "print"):
        monkeypatch.setattr(builtins, name, refused)
    with pytest.raises(ConditionError):
        select(TABLE, text)
    assert not any(callable(getattr(where, name, None)) for name in ("eval", "exec"))


def test_an_empty_selection_says_how_many_each_part_leaves_out():
    hot, thin = int((T <= 1e4).sum()), int((RHO >= 2).sum())
    with pytest.raises(ValueError, match=f"no particle is left of {COUNT} where") as error:
        select(TABLE, "Temperature > 1e4 and rho < 2 and rho > 2")
    for said in (f"{hot} left out by Temperature > 1e4", f"{thin} left out by rho < 2", f"{COUNT - thin} left out by rho > 2"):
        assert said in str(error.value)
    (note,) = select(TABLE, "Temperature > 1e4")[1]
    assert f"{COUNT - hot} of {COUNT} particles; {hot} left out by Temperature > 1e4" in note
    assert select(io.ParticleTable(np.zeros((0, 3))), "x > 0")[0].shape == (0,)  # of nothing, nothing is left


def test_a_share_is_of_those_that_are_kept_and_always_the_same():
    kept, notes = select(TABLE, "x > 0", 0.25)
    assert kept.sum() == round(0.25 * (X > 0).sum()) and not kept[X <= 0].any()
    assert "for a quick look" in notes[1] and np.array_equal(select(TABLE, "x > 0", 0.25)[0], kept)
    assert select(TABLE, share=1.0)[0].all() and select(TABLE, share=1e-9)[0].sum() == 1
    assert not np.array_equal(np.flatnonzero(select(TABLE, share=0.5)[0]), np.arange(COUNT // 2))
    for none in (0, -0.1, 1.1, np.nan):
        with pytest.raises(ConditionError, match="`share` must be above 0 and at most 1"):
            select(TABLE, share=none)


def test_particles_are_chosen_after_all_have_made_volumes_and_supports(tmp_path):
    """So that the field at a particle that is shown is made of what it was made of before."""
    np.savez(tmp_path / "a.npz", position=TABLE.position, temperature=T)
    whole = io.read_particles(tmp_path / "a.npz", "temperature").to_numpy()
    some = io.read_particles(tmp_path / "a.npz", "temperature", where="temperature > 1e4").to_numpy()
    for name, column in whole.items():
        assert np.array_equal(column[T > 1e4], some[name]), name
    with pytest.raises(ConditionError, match=r"a\.npz: the condition"):
        io.read_particles(tmp_path / "a.npz", where="entropy > 1")


@pytest.mark.parametrize("part", ["7**7**7**7", "2/(3-3)", "log10(-(5))", "exp(900)", "1e999"])
def test_numbers_alone_that_are_none_are_quoted(part):
    for what in ("expression", "condition"):
        text = part if what == "expression" else f"a > {part}"
        with pytest.raises(ValueError, match=r"no finite number|too large") as refused:
            expression = where.Expression(text, lambda name: np.ones(3), what)
            expression.numbers() if what == "expression" else expression.of_particles(expression.parts()[0])
        assert text in str(refused.value)
