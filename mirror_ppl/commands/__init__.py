"""The commands. Each parses its options, calls the public face, and prints what comes out."""

import gc
import signal
from collections.abc import Sequence
from importlib import import_module
from typing import NoReturn

from mirror_ppl.console import guarded, run

COMMANDS = {
    "fit": "infer what people see and how they decide from their recorded rounds",
    "assist": "pair communicators with people, and measure how much each helps",
    "calibrate": "test whether posteriors are calibrated, on simulated people",
    "compare": "compare human models by how well they predict what people do",
    "evaluate": "compare MIRROR with its ablations and baselines, as the paper does",
    "train": "train a domain's self-model, or the network of the amortized guide",
    "simulate": "record rounds of simulated people",
    "check_domain": "check a world of your own and list what it offers",
}


def call(name: str, prog: str | None = None, args: Sequence[str] | None = None) -> NoReturn:
    """Be the command of that name, from the command line to the exit status of the process.

    Args:
        name: one of `COMMANDS`.
        prog: how it was called, for its help; `python -m mirror_ppl.NAME` unless given.
        args: its arguments; those of the process unless given.
    """

    def command() -> int:
        # Imported here, so that an interruption meanwhile ends in a line, too.
        module = import_module(f"mirror_ppl.commands.{name}")
        return run(
            module.Options,
            module.main,
            prog=prog or module.PROGRAM,
            description=module.DESCRIPTION,
            args=args,
            examples=module.EXAMPLES,
        )

    status = guarded(command)
    # All is done and written. Python's own end takes a moment, in which nothing is to interrupt.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Half a second is saved where Python does not look for cycles in all that was imported.
    gc.freeze()
    raise SystemExit(status)
