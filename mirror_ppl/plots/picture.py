"""The figure class of the package, which notebooks show."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib import font_manager
from matplotlib.figure import Figure
from matplotlib.ft2font import FT2Font
from matplotlib.text import Text
from matplotlib.ticker import FixedFormatter, FuncFormatter

from mirror_ppl.files import write_whole

if TYPE_CHECKING:
    import arviz as az

DOTS_PER_INCH = 120
LONGEST = 40
"""Characters of a name that are shown."""


class Picture(Figure):
    """A matplotlib figure without a backend, which notebooks can show.

    It need not be closed, as pyplot does not refer to it. Text is shown literally, including
    dollars and backslashes; characters that no font has are shown by their number.
    """

    def draw(self, renderer: Any) -> None:
        """Draw the figure, see `matplotlib.figure.Figure.draw`."""
        numbers = self._numbers()
        for text in self.findobj(Text):
            assert isinstance(text, Text)
            if text not in numbers:
                text.set_parse_math(False)
                text.set_text(displayable(text.get_text(), text.get_fontproperties()))
        with warnings.catch_warnings():
            # For labels of ticks, whose texts are made while they are drawn.
            warnings.filterwarnings("ignore", "Glyph .* missing from font")
            super().draw(renderer)

    def _numbers(self) -> set[Text]:
        """Labels of ticks that are numbers, which matplotlib may write as formulas."""
        axes = [axis for ax in self.axes for axis in (ax.xaxis, ax.yaxis)]
        ticks = [
            tick
            for axis in axes
            if not isinstance(axis.get_major_formatter(), FixedFormatter | FuncFormatter)
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks())
        ]
        return {label for tick in ticks for label in (tick.label1, tick.label2)}

    def save(self, path: Path) -> None:
        """Write the figure atomically, in the format of the path's suffix.

        Raises:
            OutputError: the file cannot be written.
        """
        write_whole(path, self.content(path.suffix[1:]))

    def content(self, kind: str = "png") -> bytes:
        """Return the content of a file of that kind (png, pdf, svg)."""
        content = BytesIO()
        self.savefig(content, dpi=DOTS_PER_INCH, format=kind)
        return content.getvalue()

    def _repr_png_(self) -> bytes:
        content = BytesIO()
        self.savefig(content, format="png")
        return content.getvalue()


@dataclass(frozen=True)
class SightPicture:
    """A picture of what people see.

    Attributes:
        possible: returns True if a posterior can be drawn this way.
        draw: draws it.
        shows: description in words.
        thresholds: True if it shows what is within the thresholds of sight.
    """

    possible: Callable[[az.InferenceData], bool]
    draw: Callable[[az.InferenceData], Picture]
    shows: str
    thresholds: bool = True


def displayable(text: str, font: font_manager.FontProperties | None = None) -> str:
    """Replace characters that the font lacks by their numbers, such as [U+1F600]."""
    if text.isascii():
        return text
    font = font or font_manager.FontProperties()
    known: set[int] = set()
    for family in font.get_family():
        own = font.copy()
        own.set_family(family)
        known |= FT2Font(font_manager.findfont(own)).get_charmap().keys()
    return "".join(
        character if ord(character) in known or character.isspace() else f"[U+{ord(character):04X}]"
        for character in text
    )


def label_of(name: str) -> str:
    """Label of a tick for a person's id or another name, of which a long one is cut."""
    return displayable(
        name if len(name) <= LONGEST else name[: LONGEST - 1] + "\N{HORIZONTAL ELLIPSIS}"
    )
