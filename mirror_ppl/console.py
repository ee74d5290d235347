"""What the commands share: how they start and end, and what they print to."""

import contextlib
import errno
import io
import os
import re
import shlex
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from mirror_ppl.errors import HumanModelError, MirrorError, MirrorWarning, OptionError
from mirror_ppl.user_code import describe, passed_user_code

if TYPE_CHECKING:
    from rich.console import Console

Options = TypeVar("Options")

EXIT_BAD_INPUT = 2
# As shells report a process that a signal ended: 128 + the signal's number.
EXIT_INTERRUPTED = 128 + 2
EXIT_BROKEN_PIPE = 128 + 13
EXIT_TERMINATED = 128 + 15
NO_EXAMPLES: Mapping[str, str] = {}
NUMBERS = {
    "a whole number": r"invalid literal for int\(\) with base 10",
    "a number": "could not convert string to float",
}
"""What a text must be, of which Python says this where it is none."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT)
"""Errors of writing that are not the code's."""
NO_MEMORY = ("can't allocate memory", "CUDA out of memory")
"""How torch says that there is too little memory."""


def run(
    options_class: type[Options],
    main: Callable[[Options], int | None],
    *,
    prog: str,
    description: str,
    args: Sequence[str] | None = None,
    examples: Mapping[str, str] = NO_EXAMPLES,
    threads: int = 1,
) -> int:
    """Parse the command line into options, call `main` with them, and return the exit status.

    A command's file ends in `raise SystemExit(run(...))`.

    Args:
        options_class: a frozen dataclass; the docstrings of its fields become the help. A
            `ValueError` from its `__post_init__` is reported as an argument error.
        main: does the work; what it returns is the exit status, None counting as 0.
        prog: the program's name in the help, such as "python -m mirror_ppl.fit".
        description: what the command does, for the help.
        args: the arguments; by default those of the process.
        examples: arguments, by what they are for; `--help` ends with them.
        threads: how many threads torch gets, unless OMP_NUM_THREADS is set. The networks here are
            too small to gain from more than one.

    Returns:
        What `main` returns; 2 after an argument error, a `MirrorError`, a fault in a file of the
        user, or where there is too little memory or room, which is reported in one line on stderr;
        130 after an interruption and 143 after SIGTERM; 141 when the reader of stdout went away.
        Other exceptions are mistakes of the code and pass through.
    """
    return guarded(lambda: _run(options_class, main, prog, description, args, examples, threads))


def guarded(call: Callable[[], int]) -> int:
    """The exit status of a call: its own, or that of how it ended; see `run`."""
    _open_streams()
    with _terminable(), _warnings_in_one_line():
        try:
            status = call()
            sys.stdout.flush()
            _leave_streams()  # what stderr cannot take does not make good work fail
            return status
        except (KeyboardInterrupt, Exception) as error:
            ending = _ending(error)
            if ending is None:
                raise
            status, message = ending
            # What was printed before goes first, where it still goes anywhere.
            with contextlib.suppress(OSError, ValueError):
                sys.stdout.flush()
            with contextlib.suppress(OSError, ValueError):
                print(message, end="\n" if message else "", file=sys.stderr, flush=True)
            _leave_streams()
            return status


def _run(
    options_class: type[Options],
    main: Callable[[Options], int | None],
    prog: str,
    description: str,
    args: Sequence[str] | None,
    examples: Mapping[str, str],
    threads: int,
) -> int:
    import tyro

    from mirror_ppl.option_help import description_of, examples_of, registry_for

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            options = tyro.cli(
                options_class,
                prog=prog,
                description=description_of(description),
                args=args,
                registry=registry_for(options_class),
                config=(tyro.conf.FlagCreatePairsOff,),  # no --no-OPTION beside --OPTION
            )
    except SystemExit as end:
        if end.code:
            raise OptionError(_argument_error(said.getvalue(), prog)) from end
        if examples:  # after --help
            print(f"\n{examples_of(prog, examples)}")
        return 0
    # After parsing, so that --help and argument errors do not wait for the import of torch.
    _use_threads(threads)
    try:
        return main(options) or 0
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):  # rich ends the program then
            raise end.__context__ from end
        raise HumanModelError(describe(end)) from end


def _argument_error(box: str, prog: str) -> str:
    """What tyro says in a box, in one line."""
    # Between a title and the last line; drawn by plain characters where there are no others.
    text = "\n".join(line.strip("│| ") for line in box.splitlines()[1:-1])
    parts = [" ".join(part.split()) for part in re.split(r"(?m)^\s*[─-]{3,}\s*$", text)]
    parts = [part for part in parts if part] or [" ".join(box.split())]
    meant = [word for part in parts if part.startswith("Perhaps") for word in part.split()]
    options = dict.fromkeys(word.rstrip(",") for word in meant if word.startswith("--"))
    # Of an option that may be left out, tyro lists every type that the value was tried as.
    tried = re.match(r"(Error parsing \S+: ).* - <class '\w+'>: (?!\[)(.*)", parts[0])
    message = ("".join(tried.groups()) if tried else parts[0]).rstrip(".")
    for kind, said in NUMBERS.items():
        if found := re.fullmatch(rf"Error parsing (\S+): {said}: '(.*)'", message):
            message = f"{found[1]} must be {kind}, not {found[2]}"
    if options:
        message += f"; perhaps you meant {' or '.join(options)}"
    return f"{message}; see {prog} --help"


def _ending(error: BaseException) -> tuple[int, str] | None:
    """Exit status and line of an exception; None of a mistake of the code."""
    if isinstance(error, MirrorError):
        text = " ".join(str(error).split()) or type(error).__name__
        return EXIT_BAD_INPUT, f"error: {_printable(text)}"
    if isinstance(error, _Terminated):
        return EXIT_TERMINATED, "terminated"
    if isinstance(error, KeyboardInterrupt):
        return EXIT_INTERRUPTED, "interrupted"
    if isinstance(error, BrokenPipeError):  # as in `... | head`
        return EXIT_BROKEN_PIPE, ""
    if passed_user_code(error):
        return EXIT_BAD_INPUT, f"error: {_printable(describe(error))}"
    if isinstance(error, OSError) and error.errno in NO_ROOM:
        where = f": {error.filename}" if error.filename else ""
        return EXIT_BAD_INPUT, f"error: cannot write: {error.strerror or error}{where}"
    if isinstance(error, MemoryError) or any(sign in str(error) for sign in NO_MEMORY):
        return EXIT_BAD_INPUT, f"error: there is too little memory {' '.join(str(error).split())}"
    return None


def _printable(text: str) -> str:
    """A text without what would change a terminal."""
    return "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


class _Terminated(KeyboardInterrupt):
    """The process was asked to end, by SIGTERM; work ends as after an interruption."""


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    def terminate(number: int, frame: object) -> None:
        raise _Terminated

    try:
        before = signal.signal(signal.SIGTERM, terminate)
    except ValueError:  # not the main thread, which alone can
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _warnings_in_one_line() -> Iterator[None]:
    """Print the package's warnings without the place in its code that they come from."""
    usual = warnings.formatwarning

    def formatted(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        line: str | None = None,
    ) -> str:
        if issubclass(category, MirrorWarning):
            return f"warning: {_printable(' '.join(str(message).split()))}\n"
        return usual(message, category, filename, lineno, line)

    warnings.formatwarning = formatted
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _open_streams() -> None:
    """Streams that were closed lead nowhere, and characters that one lacks are escaped."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - to the process's end
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115 - to the process's end
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _leave_streams() -> None:
    """Let what a stream cannot take go nowhere: the interpreter flushes them at its end."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            with contextlib.suppress(OSError, ValueError), open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), stream.fileno())


def _use_threads(threads: int) -> None:
    if "OMP_NUM_THREADS" not in os.environ:
        import torch

        torch.set_num_threads(threads)


def command_line(program: str, options: Mapping[str, Any]) -> str:
    """The command with these options, without those that are None, quoted for a shell."""
    words = program.split()
    for name, value in options.items():
        if value is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def console_for_tables(width: int) -> "Console":
    """A console as wide as the terminal, or of a given width where there is none.

    It shows names as they are, whatever brackets or colons are in them.
    """
    from rich.console import Console

    own = None if sys.stdout.isatty() else width
    return Console(width=own, markup=False, emoji=False, highlight=False)
