"""Work for other processes, in a module that they import quickly."""

import os
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path


@dataclass(frozen=True)
class Square:
    number: int

    @property
    def label(self):
        return f"square of {self.number}"


ASKED = []
"""Numbers whose squares this process was asked for."""


def square(cell):
    ASKED.append(cell.number)
    return [{"number": cell.number, "square": cell.number**2}]


def die_of_one(cell):
    if cell.number == 1:
        os._exit(3)
    return square(cell)


FOLDER = "MIRROR_PPL_TEST_JOBS"
"""Variable of the environment with the folder in which it is marked who has died."""


def die_once(cell):
    """Kills its process the first time, as a system without memory does."""
    mark = Path(os.environ[FOLDER]) / f"died-{cell.number}"
    if cell.number == 1 and not mark.exists():
        mark.touch()
        os._exit(3)
    return square(cell) + [{"square": os.getpid()}]


def ends(number):
    raise SystemExit(number)


def pair(number):
    return number, number**2


MARK = "MIRROR_PPL_TEST_WORKERS"
"""Variable of the environment by which workers of a test are found."""


@dataclass(frozen=True)
class NoOptions:
    pass


def at_work():
    """Be a command that says that its workers work, which takes them a minute."""
    from mirror_ppl.console import run
    from mirror_ppl.workers import run_tasks

    os.environ[MARK] = sys.argv[1]

    def main(options):
        for _ in run_tasks([partial(time.sleep, 0.1), *[partial(time.sleep, 60)] * 2], 2):
            print("at work", flush=True)

    raise SystemExit(run(NoOptions, main, prog="x", description="x", args=[]))
