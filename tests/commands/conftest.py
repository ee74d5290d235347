"""What tests of commands share: processes that are started once."""

import os
import signal

import pytest
from forks import Forks


@pytest.fixture(scope="session")
def forks():
    """Starts commands in processes of their own, which have their imports done."""
    started = Forks()
    yield started
    started.close()


@pytest.fixture
def cluster(forks):
    """Address of a Dask cluster of two workers: instead of a single one joblib works here.

    They start at once, and while they wait they are not idle.
    """
    processes, addresses = [], []

    def start(*args):
        read, write = os.pipe()
        with open(read) as told:
            with open(write, "w") as out, open(os.devnull, "w") as nowhere:
                processes.append(forks.start("forks:dask", *args, stdout=out, stderr=nowhere))
            addresses.append(told.readline().strip())

    start()
    for _ in range(2):
        start(addresses[0])
    yield addresses[0]
    for process in processes:
        os.kill(process, signal.SIGKILL)
        forks.status(process)
