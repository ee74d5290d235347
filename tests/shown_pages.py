"""The pages of the documentation, and what they show: blocks, commands and tables."""

import importlib
import re

from paths import ROOT

TOP = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")
PAGES = [*(ROOT / name for name in TOP), *sorted((ROOT / "docs").glob("*.md"))]


def imported(module):
    """What `python -m module` runs, to call it here."""
    if module == "mirror_ppl":
        return importlib.import_module("mirror_ppl.__main__")
    return importlib.import_module(module.replace("mirror_ppl.", "mirror_ppl.commands."))


def page(name):
    return (ROOT / name).read_text()


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands():
    """Every line of a console block, with the page that it is on."""
    return [
        (p.name, line)
        for p in PAGES
        for block in blocks(p.read_text(), "console")
        for line in block.strip().splitlines()
    ]


def table_of(text, heading):
    """Rows of the first table whose header begins with ``heading``, as lists of cells."""
    table = re.search(rf"^\| {re.escape(heading)} \|.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.MULTILINE)
    assert table, f"no table {heading}"
    return [
        [cell.strip() for cell in row.strip("|").split(" |")]
        for row in table[1].strip().splitlines()
    ]
