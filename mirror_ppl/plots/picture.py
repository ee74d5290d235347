"""Figures that notebooks show."""

from io import BytesIO

from matplotlib.figure import Figure


class Picture(Figure):
    """A matplotlib figure that belongs to no backend, and that a notebook shows all the same.

    It need not be closed: nothing but its user refers to it.
    """

    def _repr_png_(self) -> bytes:
        content = BytesIO()
        self.savefig(content, format="png")
        return content.getvalue()
