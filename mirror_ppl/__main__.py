"""The console script `mirror-ppl`, and `python -m mirror_ppl`: every command, and their list."""

import sys
from collections.abc import Sequence
from typing import NoReturn

from mirror_ppl.commands import COMMANDS, call
from mirror_ppl.console import guarded
from mirror_ppl.errors import OptionError, UnknownNameError
from mirror_ppl.version import __version__

MODULE, SCRIPT = "python -m mirror_ppl", "mirror-ppl"


def spoken(program: str, name: str) -> str:
    """How a command is called: `mirror-ppl check-domain`, `python -m mirror_ppl.check_domain`."""
    return f"{SCRIPT} {name.replace('_', '-')}" if program == SCRIPT else f"{MODULE}.{name}"


def overview(program: str) -> str:
    """The commands with a line each, and how to call them."""
    calls = {spoken(program, name): purpose for name, purpose in COMMANDS.items()}
    width = max(map(len, calls))
    lines = [
        f"mirror_ppl {__version__}",
        "",
        *(f"  {one:<{width}}  {purpose}" for one, purpose in calls.items()),
        "",
        "Each of them explains its options with --help.",
    ]
    return "\n".join(lines)


def main(args: Sequence[str], program: str = MODULE) -> int:
    """Print what is asked for and return the exit status; commands end the process themselves."""
    match list(args):
        case [] | ["-h" | "--help"]:
            print(overview(program))
        case ["--version"]:
            print(f"mirror_ppl {__version__}")
        case [named, *rest] if (name := named.replace("-", "_")) in COMMANDS:
            call(name, spoken(program, name), rest)
        case [first, *_] if not first.startswith("-"):
            known = [name.replace("_", "-") if program == SCRIPT else name for name in COMMANDS]
            raise UnknownNameError.of("command", first, known)
        case [*_, last]:
            raise OptionError(f'unknown argument "{last}"; try {program} --help')
    return 0


def script() -> NoReturn:
    """Be the console script `mirror-ppl`."""
    raise SystemExit(guarded(lambda: main(sys.argv[1:], SCRIPT)))


if __name__ == "__main__":
    raise SystemExit(guarded(lambda: main(sys.argv[1:])))
