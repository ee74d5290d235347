"""`python -m mirror_ppl`: the list of commands."""

import sys
from collections.abc import Sequence

from mirror_ppl.commands import COMMANDS
from mirror_ppl.console import guarded
from mirror_ppl.errors import OptionError
from mirror_ppl.version import __version__

PROGRAM = "python -m mirror_ppl"


def overview() -> str:
    """The commands with a line each, and how to call them."""
    width = max(map(len, COMMANDS))
    lines = [
        f"mirror_ppl {__version__}",
        "",
        *(f"  {PROGRAM}.{name:<{width}}  {purpose}" for name, purpose in COMMANDS.items()),
        "",
        "Each of them explains its options with --help.",
    ]
    return "\n".join(lines)


def main(args: Sequence[str]) -> int:
    """Print what is asked for and return the exit status."""
    match list(args):
        case [] | ["-h" | "--help"]:
            print(overview())
        case ["--version"]:
            print(f"mirror_ppl {__version__}")
        case [name, *_] if name in COMMANDS:
            print(f"error: a command is called as {PROGRAM}.{name}", file=sys.stderr)
            return 2
        case [*_, last]:
            raise OptionError(f'unknown argument "{last}"; try {PROGRAM} --help')
    return 0


if __name__ == "__main__":
    raise SystemExit(guarded(lambda: main(sys.argv[1:])))
