"""docs/gallery.md: it draws everything that there is to draw, by the lines that it shows."""

import importlib.util
import inspect
from io import BytesIO

import numpy as np
import pytest
from matplotlib.image import imread
from paths import ROOT

from mirror_ppl import plots

PAGE = (ROOT / "docs/gallery.md").read_text()


@pytest.fixture(scope="module")
def gallery():
    spec = importlib.util.spec_from_file_location("gallery", ROOT / "docs/_site/gallery.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_gallery_has_everything_that_is_drawn():
    methods = [name for name, _ in inspect.getmembers(plots.FitPlots, inspect.isfunction)]
    drawn = {f"fit.plot.{name}(" for name in methods if not name.startswith("_")}
    drawn |= {f"{name}(" for name in plots.__all__ if name.startswith("plot_")}
    # The first three are drawn by methods of a fit, the next two by reports of studies.
    elsewhere = {"plot_identifiability(", "plot_implants(", "plot_model_check("}
    elsewhere |= {"plot_curves(", "plot_relevance(", "fit.plot.files("}
    assert {name for name in drawn if name not in PAGE} == elsewhere
    assert PAGE.count(".plot.sight()") == 3  # a world each
    assert PAGE.count('REPORTS["') == 2


def test_every_picture_is_on_the_page_once(gallery):
    paths = [path for _, path in gallery.BLOCK.findall(PAGE) if path]
    assert len(set(paths)) == len(paths) == PAGE.count("![")
    kept = {f"images/gallery/{file.name}" for file in (ROOT / "docs/images/gallery").iterdir()}
    assert kept == set(paths)


@pytest.mark.slow
def test_pictures_are_drawn_by_the_lines_above_them(gallery, tmp_path, monkeypatch):
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    for path, picture in gallery.pictures():
        kept = imread(ROOT / "docs" / path)
        if isinstance(picture, np.ndarray):
            np.testing.assert_allclose(kept[..., :3] * 255, picture, atol=0.5)
        else:
            assert imread(BytesIO(picture.content())).shape == kept.shape, path
