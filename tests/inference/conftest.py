"""What several tests of inference start from; files with others of these names use their own."""

import pytest
from example_combinations import LENGTHS
from example_views import Few, ragged

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def few(self_model):
    return Few(self_model)


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_paper.nc"))


@pytest.fixture(scope="module")
def rounds(recordings):
    return ragged(recordings, LENGTHS)


@pytest.fixture(scope="module")
def table(few, rounds):
    return build_view_table(few, rounds)
