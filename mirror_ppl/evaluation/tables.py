"""Tables of text, for terminals and for Markdown pages."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from mirror_ppl.console import console_for_tables

WIDTH = 110
Rows = list[dict[str, Any]]
"""A table of plain values."""


@dataclass(frozen=True)
class TextTable:
    """A table of text.

    Attributes:
        title: above the table.
        caption: meaning of the entries, below the table.
        heads: of the columns; all but the first have numbers.
        rows: entries, which may have several lines.
    """

    title: str
    caption: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def show(self) -> None:
        """Print it."""
        table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for place, head in enumerate(self.heads):
            table.add_column(head, justify="right" if place else "left")
        for row in self.rows:
            table.add_row(*map(Text, row))
        console = console_for_tables(WIDTH)
        # Printed apart, as the table would wrap them to its own width.
        console.print(self.title, style="italic", markup=False, highlight=False)
        console.print(table, end="")
        console.print(f"({self.caption})\n", style="dim", markup=False, highlight=False)

    @property
    def markdown(self) -> str:
        """The table as Markdown."""
        lines = [
            self.heads,
            ("---", *("---:" for _ in self.heads[1:])),
            *(
                tuple(entry.replace("|", "\\|").replace("\n", "<br>") for entry in row)
                for row in self.rows
            ),
        ]
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        return f"**{self.title}**\n\n{table}\n\n{self.caption[:1].upper()}{self.caption[1:]}.\n"


def comma_separated(rows: Rows) -> str:
    """Rows as comma-separated values; columns that a row lacks stay empty."""
    columns = dict.fromkeys(name for row in rows for name in row)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(columns))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def page(sentences: Sequence[str], tables: Sequence[TextTable]) -> str:
    """Sentences and tables as Markdown."""
    parts = ["\n".join(f"- {one}" for one in sentences) + "\n"] if sentences else []
    return "\n".join([*parts, *(table.markdown for table in tables)])
