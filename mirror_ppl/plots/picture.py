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
        write_whole(path, lambda temporary: self.savefig(temporary, dpi=DOTS_PER_INCH))

    def _repr_png_(self) -> bytes:
        content = BytesIO()
        self.savefig(content, format="png")
        return content.getvalue()
