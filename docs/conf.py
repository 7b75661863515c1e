"""How `make docs` makes the site: the pages are the README, docs/*.md, the notebooks, and docstrings.

The folder above is Sphinx's source folder, so that links on the site are those that lead from file to file.
"""

from __future__ import annotations

import pathlib
import re
import sys
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
from jaxsph import __version__ as release  # noqa: E402

project, author, copyright = "jaxsph", "jaxsph contributors", "jaxsph contributors"
root_doc = "README"
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md", "notebooks/*.ipynb"]
exclude_patterns = [".*", "benchmarks", "build", "dist", "jaxsph", "site", "tests"]  # folders not to be walked through
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
suppress_warnings = ["misc.highlighting_failure"]  # of examples with placeholders

html_theme, html_title = "furo", f"jaxsph {release}"
html_show_sphinx = False
html_math_renderer = "mathml"  # what browsers know themselves: nothing is fetched
html_static_path, html_css_files = ["site_static"], ["site.css"]

myst_enable_extensions = ["dollarmath", "html_image"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # the suite runs them

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
python_maximum_signature_line_length = 100
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_custom_sections = ["Differentiation"]
napoleon_use_ivar, napoleon_attr_annotations = True, False

CONTENTS = {
    "Tutorials": "/notebooks/000_first_image /notebooks/010_your_snapshot /notebooks/020_colours_and_opacity "
    "/notebooks/030_column_density /notebooks/040_a_movie /notebooks/050_liquids /notebooks/060_figure_with_units "
    "/notebooks/070_from_pandas_and_yt /notebooks/100_tolerance /notebooks/200_inverse /notebooks/210_jax_ways "
    "/notebooks/300_the_trade /notebooks/400_progressive /notebooks/500_points_and_grids /notebooks/600_surfaces",
    "How to": "choosing questions rendering colours selecting projections surfaces volumes points movies viewing error_control "
    "python gradients many_machines",
    "Reference": "api command_line files glossary packaging /CHANGELOG",
    "Explanation": "what_is_computed papers accuracy_and_limits speed for_jax_users extending /CONTRIBUTING",
    "Results": "how_accurate_how_fast gallery",
}
HIDDEN = "\n\n```{{toctree}}\n:hidden:\n:caption: {}\n\n{}\n```\n"
REDIRECT = '<!DOCTYPE html><meta http-equiv="refresh" content="0; url=README.html"><a href="README.html">jaxsph</a>\n'
INNER = "jaxlib._jax.Array"  # what `jax.Array` says it is
MARKED = re.compile(r"(``.+?``|`[^`\n]+`|\$[^$]+\$|\[[^]]+\]\(https?://[^)]+\))")


def with_contents(app: Any, page: str, source: list[str]) -> None:
    """The table of contents belongs to the front page, and is not shown where that is read as a file."""
    if page == root_doc:
        for caption, names in CONTENTS.items():
            entries = (name if name.startswith("/") else f"/docs/{name}" for name in names.split())
            source[0] += HIDDEN.format(caption, "\n".join(entries))


def restructured(text: str) -> str:
    """A line of a docstring, which is written as Markdown, as reStructuredText."""
    parts = []
    for place, part in enumerate(MARKED.split(text)):
        if place % 2 == 0:
            parts.append(re.sub(r"(?<=\w)_(?!\w)", r"\_", part.replace("|", r"\|")))
        elif part.startswith("$"):
            parts.append(rf"\ :math:`{part[1:-1]}`\ ")
        elif part.startswith("["):
            label, address = part[1:-1].split("](")
            parts.append(rf"\ `{label} <{address}>`__\ ")
        else:
            parts.append(rf"\ ``{part.strip('`')}``\ ")
    return "".join(parts)


def as_restructured(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Docstrings: marks, tables and blocks of Markdown; before napoleon makes lists of their sections."""
    made: list[str] = []
    table: list[str] = []
    fenced = False
    for line in [*lines, ""]:
        if line.strip().startswith("```"):
            fenced = not fenced
            made += ["", ".. code-block::", ""] if fenced else [""]
        elif fenced:
            made.append(f"   {line}")
        elif line.startswith("|"):
            table.append(line)
        else:
            if table:
                rows = [[restructured(cell.strip()) for cell in row.strip("|").split("|")] for row in table if "---" not in row]
                made += [".. list-table::", "   :header-rows: 1", ""]
                made += [f"   {'* -' if not place else '  -'} {cell}" for row in rows for place, cell in enumerate(row)] + [""]
                table = []
            made.append(restructured(line))
    lines[:] = made


def joined_equations(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Marks do not run over the end of a line: a line with an open one takes the next."""
    whole: list[str] = []
    for line in lines:
        if whole and (whole[-1].count("`") % 2 or whole[-1].count("$") % 2) and not whole[-1].strip().startswith("```"):
            whole[-1] += f" {line.strip()}"
        else:
            whole.append(line)
    lines[:] = whole


def shorter(app: Any, page: nodes.document) -> None:
    """Signatures name JAX's array as its users do."""
    for text in list(page.findall(nodes.Text)):
        if INNER in text:
            text.parent.replace(text, nodes.Text(text.replace(INNER, "Array")))


def inline_math(writer: Any, node: nodes.math) -> None:
    """An equation in a line."""
    writer.body.append(str(tex2mathml(node.astext())))
    raise nodes.SkipNode


def block_math(writer: Any, node: nodes.math_block) -> None:
    """An equation by itself."""
    writer.body.append(f"<div>{tex2mathml(node.astext(), as_block=True)}</div>")
    raise nodes.SkipNode


def with_entry(app: Any, error: Exception | None) -> None:
    """The page that a folder is opened at."""
    if error is None and app.builder.name == "html":
        (pathlib.Path(app.outdir) / "index.html").write_text(REDIRECT, encoding="utf-8")


def setup(app: Any) -> None:
    """What Sphinx is told."""
    app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))
    app.connect("source-read", with_contents)
    app.connect("autodoc-process-docstring", joined_equations, priority=100)
    app.connect("autodoc-process-docstring", as_restructured, priority=200)
    app.connect("doctree-read", shorter)
    app.connect("build-finished", with_entry)
