"""All recordings that the package ships are possible in their worlds, in every round."""

import pytest

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.data.contradictions import check_world

NAMES = sorted(path.name for path in asset_path("driving_fog_paper.nc").parent.glob("*.nc"))


@pytest.mark.parametrize("name", NAMES)
def test_recordings_that_ship_are_possible(name):
    assert check_world(load_demonstrations(asset_path(name))).share == 0
