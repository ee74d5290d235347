"""Tables of text: on a terminal and on a page."""

from __future__ import annotations

from mirror_ppl.evaluation.tables import TextTable, write_page, write_rows

TABLE = TextTable(
    "driving: NLL",
    "mean over people; 90% interval",
    ("model", "1 round", "2 rounds"),
    (("mirror", "0.2", "0.1|0"), ("bc", "0.6\n+0.4", "[red]")),
)
PAGE = """**driving: NLL**

| model | 1 round | 2 rounds |
| --- | ---: | ---: |
| mirror | 0.2 | 0.1\\|0 |
| bc | 0.6<br>+0.4 | [red] |

Mean over people; 90% interval.
"""


def test_a_page_says_what_a_terminal_says(tmp_path, capsys):
    assert TABLE.markdown == PAGE
    TABLE.show()
    shown = capsys.readouterr().out
    for text in (TABLE.title, TABLE.caption, *TABLE.heads, "+0.4", "[red]"):
        assert text in shown
    write_page(tmp_path / "page.md", ["mirror is ahead", "bc is not"], [TABLE, TABLE])
    page = (tmp_path / "page.md").read_text()
    assert page == f"- mirror is ahead\n- bc is not\n\n{PAGE}\n{PAGE}"
    write_page(tmp_path / "page.md", [], [TABLE])
    assert (tmp_path / "page.md").read_text() == PAGE


def test_rows_may_lack_columns(tmp_path):
    write_rows(tmp_path / "rows.csv", [{"one": 1}, {"one": 2, "two": 3}])
    assert (tmp_path / "rows.csv").read_text().split() == ["one,two", "1,", "2,3"]
