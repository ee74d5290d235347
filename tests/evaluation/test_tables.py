"""Tables of text: on a terminal and on a page."""

from __future__ import annotations

from mirror_ppl.evaluation.tables import TextTable, comma_separated, page

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


def test_a_page_says_what_a_terminal_says(capsys):
    assert TABLE.markdown == PAGE
    TABLE.show()
    shown = capsys.readouterr().out
    for text in (TABLE.title, TABLE.caption, *TABLE.heads, "+0.4", "[red]"):
        assert text in shown
    expected = f"- mirror is ahead\n- bc is not\n\n{PAGE}\n{PAGE}"
    assert page(["mirror is ahead", "bc is not"], [TABLE, TABLE]) == expected
    assert page([], [TABLE]) == PAGE


def test_rows_may_lack_columns():
    assert comma_separated([{"one": 1}, {"one": 2, "two": 3}]).split() == ["one,two", "1,", "2,3"]
