"""What every test starts from: Pyro empty and validating, seeds set, one thread, no windows."""

import os
import sys

# In the environment, before the libraries are imported, so that it holds for subprocesses too.
os.environ["MPLBACKEND"] = "Agg"
os.environ["OMP_NUM_THREADS"] = "1"
# The suite's own workers use all cores; a test that is about processes says how many.
os.environ["LOKY_MAX_CPU_COUNT"] = "1"

import hypothesis
import numpy as np
import pyro
import pytest
import torch

from mirror_ppl.domains import registry

torch.set_num_threads(1)

# No deadline: the first call of a torch function takes far longer than the others.
# Derandomized: like every other test, a property is tried on the same examples each time.
hypothesis.settings.register_profile("mirror_ppl", deadline=None, derandomize=True)
hypothesis.settings.load_profile("mirror_ppl")


def pytest_addoption(parser):
    parser.addoption(
        "--seed",
        type=int,
        default=20220302,
        help="seed of every test; tests must pass with others too, within their error rates",
    )


@pytest.fixture
def seed(request):
    return request.config.getoption("--seed")


@pytest.fixture(autouse=True)
def fresh_start(seed):
    """Clear and seed what is global, so that a test's result is independent of those before it."""
    pyro.clear_param_store()
    pyro.set_rng_seed(seed)  # torch, numpy and random
    with pyro.validation_enabled(True):
        yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    registry._ADDED.clear()  # worlds that a test added


@pytest.fixture
def generator(seed):
    """A seeded generator of torch's own, for what takes `generator=`."""
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def rng(seed):
    """A seeded generator of numpy."""
    return np.random.default_rng(seed)
