"""Units that people write: what the grammar lets through, and that nothing else reaches a library that evaluates text."""

import pytest

from jaxsph.io.table import LENGTH, CodeUnit
from jaxsph.io.units import checked_unit, named

LET_THROUGH = {
    "kpc": "kpc",
    "Msun/kpc**3": "Msun/kpc**(3)",
    " g * cm ^ -3 ": "g*cm**(-3)",
    "1/s": "1/s",
    "g**(1/2)*cm**(-1/2)/s": "g**(1/2)*cm**(-1/2)/s",
    "cm**0.5": "cm**(0.5)",
    "m_p/cm**3": "m_p/cm**(3)",
}
REFUSED = (
    "", "*", "kpc*", "/s", "1", "kpc kpc", "kpc**", "kpc**s", "s**(9**9**9)", "s**999", "s**13", "s**(1/0)", "s**99**99", "2*kpc",
    "f'{1}'", "kpc.real", "__import__", "a__b", "exit()", "lambda", "sqrt", "kpc[0]", "'kpc'", "kpc;s", "kpc\n\nkpc", "k" * 101,
    "*".join(["kpc"] * 40), "a   *" * 19,
)  # fmt: skip


@pytest.mark.parametrize("text", LET_THROUGH)
def test_names_with_powers_are_let_through(text):
    assert checked_unit(text) == LET_THROUGH[text]


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: text[:20])
def test_all_else_is_refused_in_one_line(text):
    with pytest.raises(ValueError, match=r"a unit may have 100|is no unit") as error:
        checked_unit(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ['f\'{open("ran", "w")}\'', "g/cm**3*s**(9**9**9)", "Symbol", "None", "S", "oo"])
def test_no_unit_runs_code_or_goes_on_for_ever(text, tmp_path, monkeypatch):
    pytest.importorskip("unyt")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"is no unit|does not agree"):
        named(CodeUnit(1.0, LENGTH), 1.0, text)
    assert not list(tmp_path.iterdir())
