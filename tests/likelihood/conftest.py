"""What several tests of likelihoods start from; files with others of these names use their own."""

import pytest

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.models.variants import PerItem
from mirror_ppl.models.weights import load_self_model, shipped_weights


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def per_item(self_model):
    return PerItem(self_model)


@pytest.fixture(scope="module")
def recordings():
    return load_demonstrations(asset_path("driving_fog_paper.nc"))
