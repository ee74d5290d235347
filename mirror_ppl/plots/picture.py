"""Figures that notebooks show."""

from io import BytesIO
from pathlib import Path

from matplotlib.figure import Figure

from mirror_ppl.files import write_whole

DOTS_PER_INCH = 120


class Picture(Figure):
    """A matplotlib figure that belongs to no backend, and that a notebook shows all the same.

    It need not be closed: nothing but its user refers to it.
    """

    def save(self, path: Path) -> None:
        """Write it in the format of the path's suffix, whole or not at all.

        Raises:
            OutputError: the file cannot be written.
        """
        write_whole(path, self.content(path.suffix[1:]))

    def content(self, kind: str = "png") -> bytes:
        """What a file of that kind (png, pdf, svg) would hold."""
        content = BytesIO()
        self.savefig(content, dpi=DOTS_PER_INCH, format=kind)
        return content.getvalue()

    def _repr_png_(self) -> bytes:
        content = BytesIO()
        self.savefig(content, format="png")
        return content.getvalue()
