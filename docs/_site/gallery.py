"""Draws the pictures of docs/gallery.md by the lines that stand above them.

    python docs/_site/gallery.py

A block of Python whose last line is an expression draws the picture below it.
"""

import ast
import contextlib
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"```python\n(.*?)```\n(?:\n!\[[^\]]*\]\(([^)]+)\))?", re.DOTALL)


def pictures() -> Iterator[tuple[str, Any]]:
    """Every picture of the page, by its path in docs/, drawn as the page says.

    Files that blocks write are left in the present folder, where docs/ has to be found.
    """
    names: dict[str, Any] = {"__name__": "gallery"}
    for code, path in BLOCK.findall((DOCS / "gallery.md").read_text()):
        tree = ast.parse(code)
        last = tree.body.pop() if path else None
        exec(compile(tree, "docs/gallery.md", "exec"), names)
        if last is not None:
            assert isinstance(last, ast.Expr), f"{path} is not drawn by the lines above it"
            yield path, eval(compile(ast.Expression(last.value), "docs/gallery.md", "eval"), names)


def main() -> None:
    """Write them all."""
    import matplotlib.image
    import numpy as np

    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        Path("docs").symlink_to(DOCS)
        for path, picture in pictures():
            file = DOCS / path
            file.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(picture, np.ndarray):
                matplotlib.image.imsave(file, picture)
            else:
                picture.save(file)
            print(path, flush=True)


if __name__ == "__main__":
    main()
