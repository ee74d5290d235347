"""What a refusal has to be like, wherever it comes from."""

import pytest

from mirror_ppl.errors import MirrorError


def refused(call, message):
    """Make sure that a call raises an error of the package with one short, printable line.

    Args:
        call: what has to be refused.
        message: a part of the line, with what was expected and what was given.
    """
    with pytest.raises(MirrorError) as error:
        call()
    line = str(error.value)
    assert message in line
    assert line.isprintable() and len(line) < 400
