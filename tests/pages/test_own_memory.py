"""The example with a memory of its own: what people see; fits and planners work with it."""

from dataclasses import replace

import torch
from paths import ROOT

import mirror_ppl
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights

EXAMPLE = f"{ROOT}/docs/examples/looks_away.py:LooksAway"
SITES = ("sight_front_own", "sight_front_other", "sight_back_own", "sight_back_other")
SITES = (*SITES, "assumes_clear", "assumes_closing")


def test_people_see_less_at_the_step_after_a_switch():
    """Three bins nearer, as people with such thresholds; otherwise as ever."""
    self_model = load_self_model(shipped_weights("driving"))[0]
    human, plain = load_human_model(EXAMPLE, self_model), HumanModel(self_model)
    observed = human.domain.observe(human.domain.initial(20, torch.Generator().manual_seed(0)))
    lane = observed["ego"][..., 0]
    told = {
        name: torch.zeros_like(mask) for name, mask in human.domain.communicable(observed).items()
    }

    def seen(model, sites, knowledge):
        view, _ = model.perceive(sites, knowledge, observed, told, 3)
        return torch.cat([*view.visible.values()], -1)

    own, nearer = (
        {site: torch.full((20,), bins if site.startswith("sight") else 0) for site in SITES}
        for bins in (4, 1)
    )
    expected = {False: seen(plain, own, plain.nothing_known(20))}
    expected[True] = seen(plain, nearer, plain.nothing_known(20))
    assert not torch.equal(expected[True], expected[False])
    known = human.nothing_known(20)
    for before, switched in ((known.lane, False), (lane, False), (1 - lane, True)):
        found = seen(human, own | {"blur": torch.full((20,), 3)}, replace(known, lane=before))
        assert torch.equal(found, expected[switched])


def test_fits_and_planners_work_with_a_number_for_each_person():
    rounds = mirror_ppl.load_recordings(setting="fog").select_people(["person-02"])
    fit = mirror_ppl.infer(
        rounds.select_rounds([0, 1]),
        human=EXAMPLE,
        engine="importance",
        draws=32,
        train_rounds=1,
        explore=0,
    )
    assert "blur" in fit.person("person-02").implants.index
    for picture in (fit.plot.sight(), fit.plot.samples()):
        note = "Thresholds alone: LooksAway.perceive() may change what people see"
        assert picture.get_suptitle().split("\n")[1] == note
    planner = mirror_ppl.Communicator(fit, "person-02", draws=16)
    observed = {name: value[0, 0, 0] for name, value in rounds.observation().items()}
    silence = {name: mask[0, 0, 0] & False for name, mask in rounds.told.items()}
    past = mirror_ppl.RoundSoFar.begin(fit.human.domain, observed)
    for step in range(2):
        decision = planner.plan(past)
        assert decision.gain.mean == decision.gain.mean  # not nan
        now = {name: value[0, 0, step + 1] for name, value in rounds.observation().items()}
        past = past.then(silence, int(rounds.actions[0, 0, step]), now)
