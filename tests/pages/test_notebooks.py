"""Notebooks: they run from top to bottom, match their paired scripts, and hold their outputs."""

import re

import jupytext
import matplotlib
import nbformat
import pytest
from nbclient import NotebookClient
from paths import ROOT

FOLDER = ROOT / "notebooks"
SCRIPTS = sorted(FOLDER.glob("*.py"))
LARGEST = 2_000_000
"""Bytes that a notebook may have, with its outputs."""

notebooks = pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)


def committed(script):
    return nbformat.read(script.with_suffix(".ipynb"), as_version=4)


def outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def warnings_in(notebook):
    return [o["text"] for o in outputs(notebook) if o.get("name") == "stderr"]


def pictures_in(notebook):
    return [o for o in outputs(notebook) if "image/png" in o.get("data", {})]


def test_there_are_notebooks_and_each_has_its_script():
    assert SCRIPTS
    assert [path.stem for path in sorted(FOLDER.glob("*.ipynb"))] == [p.stem for p in SCRIPTS]


@notebooks
def test_notebook_and_script_are_the_same(script):
    def content(notebook):
        return [(cell.cell_type, cell.source.strip()) for cell in notebook.cells]

    assert content(committed(script)) == content(jupytext.read(script))


@notebooks
def test_committed_notebook_holds_its_outputs(script):
    notebook = committed(script)
    nbformat.validate(notebook)
    kernel = notebook.metadata["kernelspec"]
    assert (kernel["name"], kernel["language"]) == ("python3", "python")
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert pictures_in(notebook)
    assert not warnings_in(notebook)
    path = script.with_suffix(".ipynb")
    assert path.stat().st_size < LARGEST
    # Places on the machine where it was run, in outputs or sources.
    assert not re.search(r'["\s(](/home|/root|/tmp|/work|/usr|[A-Z]:\\\\)', path.read_text())


@pytest.mark.slow
@notebooks
def test_script_runs_as_a_notebook_without_warnings(script, tmp_path, monkeypatch):
    monkeypatch.setenv("MIRROR_PPL_QUICK", "1")
    # As readers run it, with figures inline; and as if for the first time on that day, which is
    # when ArviZ announces its next version.
    monkeypatch.delenv("MPLBACKEND")
    monkeypatch.setenv("MPLCONFIGDIR", matplotlib.get_cachedir())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    notebook = jupytext.read(script)
    NotebookClient(
        notebook,
        kernel_name="python3",
        timeout=240,
        resources={"metadata": {"path": str(FOLDER)}},
    ).execute()
    assert not warnings_in(notebook)
    assert len(pictures_in(notebook)) == len(pictures_in(committed(script)))
