"""What runs on a GPU gives what the processor gives; skipped where there is none."""

import pytest
import torch

import mirror_ppl
from mirror_ppl.people import simulate

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")


@pytest.mark.parametrize("engine", ["importance", "amortized", "svi"])
def test_a_fit_on_a_gpu_finds_what_one_on_the_processor_finds(engine):
    people = simulate("driving", "fog", "paper", 2, 8, 100)
    means, errors = [], []
    for device in ("cpu", "cuda"):
        fit = mirror_ppl.infer(people, engine=engine, device=device, draws=200)
        site = fit.data.posterior["visual_threshold"].to_numpy()
        means.append(site.mean((0, 1)))
        errors.append(site.std((0, 1)))
    # Standard errors are a fourteenth of the deviation; half leaves room for SVI's optimizer.
    assert (abs(means[0] - means[1]) < 0.5 * errors[0] + 1e-3).all()


@pytest.mark.parametrize("domain", ["driving", "search_rescue", "bomb_defusal"])
def test_people_simulated_on_a_gpu_stay_there(domain):
    people = simulate(domain, people=2, rounds=2, device="cuda")
    assert people.actions.device.type == "cuda"


@pytest.mark.parametrize("domain", ["driving", "search_rescue", "bomb_defusal"])
def test_every_world_is_inferred_on_a_gpu(domain):
    people = simulate(domain, people=1, rounds=3)
    fit = mirror_ppl.infer(people, device="cuda", draws=50, train_rounds=2)
    assert len(fit.summary["people"]) == 1
