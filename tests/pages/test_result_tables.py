"""Pages of studies are what their rows say: `make tables` changes nothing."""

import pytest

from benchmarks.tables import DOCS, RESULTS, results_page, studies, study_page

STUDIES = studies()


@pytest.mark.parametrize("name", STUDIES)
def test_pages_are_what_their_rows_say(name):
    assert (RESULTS / f"{name}.md").read_text() == study_page(name, STUDIES[name])
    assert (RESULTS / f"{name}.png").stat().st_size > 0


def test_tables_of_the_page_of_results_are_what_their_rows_say():
    page = (DOCS / "results.md").read_text()
    assert results_page(page) == page
    assert page.count("<!-- end -->") >= 1


def test_a_number_that_is_not_in_the_rows_is_found():
    page = (DOCS / "results.md").read_text()
    before, end, after = page.partition("<!-- end -->")
    wrong = f"{before}| made up |\n{end}{after}"
    assert results_page(wrong) == page
