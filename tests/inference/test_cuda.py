"""What runs on a GPU gives what the processor gives; skipped where there is none."""

import numpy as np
import pytest
import torch

import mirror_ppl
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.people import simulate

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")


@pytest.mark.parametrize("engine", ["importance", "amortized", "svi"])
def test_a_fit_on_a_gpu_finds_what_one_on_the_processor_finds(engine):
    people = simulate("driving", "fog", "paper", 2, 8, 100)
    fits = [
        mirror_ppl.infer(people, engine=engine, device=device, draws=200, train_rounds=6)
        for device in ("cpu", "cuda")
    ]
    for site in sight_sites(fits[0].human.domain):
        one, other = (fit.data.posterior[site].to_numpy() for fit in fits)
        # Standard errors are a fourteenth of the deviation; half leaves room for SVI's optimizer.
        # The larger deviation: a rare value can be missing from all draws of one fit.
        deviation = np.maximum(one.std((0, 1)), other.std((0, 1)))
        assert (abs(one.mean((0, 1)) - other.mean((0, 1))) < 0.5 * deviation + 1e-3).all()


@pytest.mark.parametrize("domain", ["driving", "search_rescue", "bomb_defusal"])
def test_people_simulated_on_a_gpu_stay_there(domain):
    people = simulate(domain, people=2, rounds=2, device="cuda")
    assert people.actions.device.type == "cuda"


@pytest.mark.parametrize("domain", ["driving", "search_rescue", "bomb_defusal"])
def test_every_world_is_inferred_on_a_gpu(domain):
    people = simulate(domain, people=1, rounds=3)
    fit = mirror_ppl.infer(people, device="cuda", draws=50, train_rounds=2)
    assert len(fit.summary["people"]) == 1


@pytest.mark.parametrize("how", [{"pooling": "partial"}, {"human": "all"}])
def test_whatever_is_inferred_is_inferred_on_a_gpu(how):
    people = simulate("driving", people=2, rounds=3)
    fit = mirror_ppl.infer(people, device="cuda", draws=50, train_rounds=2, **how)
    assert len(fit.summary["people"]) == 2
