"""Recordings of people: the type, its files, and what ships with the package."""

from importlib import resources
from pathlib import Path

from mirror_ppl.checks import as_path
from mirror_ppl.data.demonstrations import Demonstrations, concatenate
from mirror_ppl.data.files import (
    from_dataset,
    load_demonstrations,
    save_demonstrations,
    to_dataset,
)
from mirror_ppl.errors import AssetError


def asset_path(name: str) -> Path:
    """Path of a file that ships with the package.

    Raises:
        AssetError: no such file ships; the message lists those that do.
    """
    folder = Path(str(resources.files(__name__))) / "assets"
    path = folder / as_path(name, "name")
    if not path.is_file():
        shipped = sorted(
            file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()
        )
        raise AssetError(f'no file "{name}" ships; there are: {", ".join(shipped) or "none"}')
    return path


__all__ = [
    "Demonstrations",
    "asset_path",
    "concatenate",
    "from_dataset",
    "load_demonstrations",
    "save_demonstrations",
    "to_dataset",
]
