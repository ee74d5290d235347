"""Checkpoints of long work, from which a stopped run can continue."""

import io
import os
from hashlib import sha256
from typing import Any

from mirror_ppl.errors import CheckpointError
from mirror_ppl.files import read_whole, write_whole

DIGEST = 32
"""Bytes of the checksum at the end of a checkpoint."""


def save_checkpoint(path: str | os.PathLike[str], run: Any, content: dict[str, Any]) -> None:
    """Write a checkpoint atomically.

    Args:
        path: the file.
        run: what identifies the run.
        content: tensors, plain values, and lists and dicts of them.

    Raises:
        OutputError: the file cannot be written.
    """
    write_whole(path, checkpoint_content(run, content))


def checkpoint_content(run: Any, content: dict[str, Any]) -> memoryview:
    """Content of a checkpoint's file; arguments as of `save_checkpoint`."""
    import torch

    buffer = io.BytesIO()
    torch.save({"run": run, **content}, buffer)
    # torch does not check all of what it reads.
    buffer.write(sha256(buffer.getbuffer()).digest())
    return buffer.getbuffer()


def read_checkpoint(path: str | os.PathLike[str], run: Any) -> dict[str, Any]:
    """Read what `save_checkpoint` wrote.

    Raises:
        CheckpointError: the file is damaged or of another run.
    """
    import torch

    whole = read_whole(path, CheckpointError)
    content, digest = whole[:-DIGEST], whole[-DIGEST:]
    if sha256(content).digest() != digest:
        raise CheckpointError(f"{path} is not a checkpoint of this program; remove it")
    found = torch.load(io.BytesIO(content), weights_only=True)
    if found["run"] != run:
        raise CheckpointError(
            f"{path} belongs to a run with other options, seed or recordings; remove it, or "
            "write elsewhere"
        )
    return found
