"""The site: every public name has an entry with its signature, and what is built has no warning and no dead link."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxsph as js

ROOT = Path(__file__).parent.parent
ENTRIES = re.findall(r"^\.\. auto(\w+):: jaxsph\.(\w+)$", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.MULTILINE)


def ran(*words):
    return subprocess.run([sys.executable, *map(str, words)], cwd=ROOT, capture_output=True, text=True)


def test_every_public_name_has_one_entry_of_its_kind():
    assert sorted(name for _, name in ENTRIES) == sorted(js.__all__)
    kinds = {
        "function": callable,
        "class": lambda one: isinstance(one, type),
        "exception": lambda one: issubclass(one, Exception),
    }
    for kind, name in ENTRIES:
        assert kinds.get(kind, lambda one: hasattr(one, "__path__"))(getattr(js, name)), name


def test_every_public_name_says_what_it_is():
    for name in js.__all__:
        assert len((getattr(js, name).__doc__ or "").split()) >= 8, name


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    made = ran(
        "-m", "sphinx", "-q", "-W", "--keep-going", "-E", "-b", "html", "-c", "docs", "-d", folder / "trees", ".", folder / "html"
    )
    assert made.returncode == 0, made.stderr
    return folder / "html"


@pytest.mark.notebook
def test_the_site_is_built_without_warnings_and_its_links_lead_somewhere(site):
    checked = ran("docs/check_site.py", site)
    assert checked.returncode == 0, checked.stderr
    assert "README.html" in (site / "index.html").read_text()


@pytest.mark.notebook
def test_entries_have_signatures(site):
    page = (site / "docs" / "api.html").read_text(encoding="utf-8")
    for kind, name in ENTRIES:
        assert f'id="{"module-" if kind == "module" else ""}jaxsph.{name}"' in page, name
    assert "Float" in page and "jaxlib" not in page


@pytest.mark.notebook
def test_dead_links_and_what_is_fetched_are_found(tmp_path):
    (tmp_path / "a.html").write_text('<a href="b.html"></a><a href="#c"></a><script src="https://x.org/y.js"></script><p id="d">')
    checked = ran("docs/check_site.py", tmp_path)
    assert checked.returncode == 1 and len(checked.stderr.splitlines()) == 3
    (tmp_path / "a.html").write_text('<a href="#d"></a><a href="https://x.org"></a><p id="d">')
    assert ran("docs/check_site.py", tmp_path).returncode == 0
