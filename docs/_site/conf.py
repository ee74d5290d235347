"""The documentation site: `make docs` builds it into build/site; a broken link or reference fails.

Sphinx with MyST rather than MkDocs Material, after a look at both:

- The root of the repository is the folder of sources. README.md and the like, docs/ and
  notebooks/ become pages where they are, so links that are written for a code host work here
  unchanged and are checked; files that are no pages become downloads. MkDocs knows one folder of
  pages, and needs code that rewrites such links.
- MyST reads CommonMark as code hosts do, so lists and tables look the same in both places.
- Roles in docstrings, such as :func:`infer`, are links without further code; stored outputs of
  notebooks have the look of the other pages.
- Material for MkDocs ends on May 5, 2027, and MkDocs 1.6 has had no release since 2024.
"""

import sys
from pathlib import Path

from pygments.lexers.shell import BashLexer
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from commands_page import commands_sections  # noqa: E402

from mirror_ppl.version import __version__  # noqa: E402

project = "mirror_ppl"
author = "mirror_ppl contributors"
version = release = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
include_patterns = ["*.md", "docs/**", "notebooks/*.ipynb"]
exclude_patterns = [".*", "build", "docs/_site", "runs"]
root_doc = "README"

SITE = {
    "Start": ["Overview <self>", "Tour <docs/tour>"],
    "Tutorials": [
        "notebooks/01_inspect_implants",
        "notebooks/02_communicate",
        "notebooks/03_trust_the_posterior",
        "notebooks/04_your_own_model",
    ],
    "How to": [
        "Use your recordings <docs/demonstrations>",
        "Write a human model <docs/extending>",
        "Add a world <docs/adding_a_world>",
        "Plan in a robot's loop <docs/communicator>",
    ],
    "Concepts": [
        "docs/human_model",
        "docs/self_model",
        "docs/people",
        "docs/trust",
        "docs/glossary",
    ],
    "Worlds": ["docs/driving", "docs/search_rescue", "docs/bomb_defusal", "docs/highway"],
    "Results": ["docs/results", "docs/performance"],
    "Reference": ["docs/reference/index", "docs/fit_files"],
    "More": [
        "Gallery <docs/gallery>",
        "Decisions <docs/decisions>",
        "Changes <CHANGELOG>",
        "CONTRIBUTING",
    ],
}
"""Pages by section; a page that is nowhere fails the build."""
BELOW = {
    "docs/results": ["/docs/results/*"],
    "docs/reference/index": [
        *(
            f"/docs/reference/{name}"
            for name in (
                "mirror_ppl",
                "domains",
                "models",
                "inference",
                "communication",
                "data",
                "plots",
                "commands",
            )
        ),
        "Statuses, files, limits </docs/commands>",
    ],
}
"""Pages below a page."""

# Notebooks are stored with their outputs.
nb_execution_mode = "off"
# Anchors of headings, as code hosts make them.
myst_heading_anchors = 4
copybutton_exclude = ".linenos, .gp, .go"

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_use_ivar = True
napoleon_custom_sections = ["Departures"]
python_maximum_signature_line_length = 80
add_module_names = False
# `x` in docstrings is code.
default_role = "literal"

html_theme = "furo"
html_title = f"mirror_ppl {__version__}"
html_show_sourcelink = False
html_copy_source = False


def toctree(entries: list[str], caption: str = "") -> str:
    """A hidden list of pages, for the site's sidebar."""
    options = [":hidden:", ":glob:", *([f":caption: {caption}"] if caption else [])]
    return "\n".join(["", "```{toctree}", *options, "", *entries, "```", ""])


def add_to_sources(app: Sphinx, page: str, source: list[str]) -> None:
    """What the site needs in pages, and a code host would show as code."""
    if page == root_doc:
        source[0] += "".join(toctree(entries, caption) for caption, entries in SITE.items())
    if page in BELOW:
        source[0] += toctree(BELOW[page])
    if page == "docs/reference/commands":
        source[0] += commands_sections()


def write_entry(app: Sphinx, error: Exception | None) -> None:
    """Let index.html lead to the first page."""
    if error is None and app.builder.format == "html":
        refresh = f'<meta http-equiv="refresh" content="0; url={root_doc}.html">'
        (Path(app.outdir) / "index.html").write_text(f"<!doctype html>{refresh}\n")


def setup(app: Sphinx) -> None:
    """Register the functions above."""
    app.add_lexer("console", BashLexer)  # commands without a prompt
    app.connect("source-read", add_to_sources)
    app.connect("build-finished", write_entry)
