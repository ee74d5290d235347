"""The model of bomb defusal: what people seek, find, see and believe."""

import pyro
import pytest
import torch
from example_bomb import WAIT, WORLD, course, implants
from example_course import beliefs_of, perceived
from example_person import beliefs_before
from pyro import poutine

from mirror_ppl.communication import Person, RoundSoFar
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.bomb_defusal.human import BombDefusalHuman
from mirror_ppl.errors import LacksSitesOfWorld
from mirror_ppl.likelihood.attention import site_probabilities
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.self_model import SelfModel


@pytest.fixture(scope="module")
def defuser():
    torch.manual_seed(0)
    return BombDefusalHuman(SelfModel(WORLD))


def test_it_is_the_package_s_own_model_of_bomb_defusal(defuser):
    assert type(load_human_model(None, defuser.self_model)) is BombDefusalHuman
    assert type(load_human_model("mirror", defuser.self_model)) is BombDefusalHuman
    assert type(load_human_model(None, SelfModel(get_domain("driving")))) is HumanModel
    check_contract(defuser)
    assert defuser.has_round_latents


def test_what_is_looked_for_is_known_of_the_stages_that_were_reached(defuser):
    observation, states = course([WAIT, 1, 2, WAIT], rounds=5)
    covariates = defuser.covariates(observation)
    for stage in range(3):
        assert torch.equal(covariates[f"sought_{stage}"], states[0].live[:, stage])
    # Of later stages it is taken to be as at the last one.
    early = {name: value[:, :3] for name, value in observation.items()}
    covariates = defuser.covariates(early)
    assert torch.equal(covariates["sought_1"], states[0].live[:, 1])
    assert torch.equal(covariates["sought_2"], states[0].live[:, 1])


def test_terminals_share_a_mean_as_far_as_they_are_alike(defuser):
    """Beta densities of mean ``notice_mean`` that are worth ``notice_concentration`` searches."""
    given = {"notice_mean": torch.tensor([[0.04]]), "notice_concentration": torch.tensor([[50.0]])}
    with (
        torch.random.fork_rng(),
        poutine.trace() as trace,
        poutine.condition(data=given),
        pyro.plate("person", 1, dim=-2),
    ):
        defuser.prior()
    for terminal in range(1, 7):
        prior = trace.trace.nodes[f"notices_terminal {terminal}"]["fn"]
        assert float(prior.concentration1) == pytest.approx(2.0)
        assert float(prior.concentration0) == pytest.approx(48.0)
    assert float(trace.trace.nodes["notice_mean"]["fn"].mean) == pytest.approx(0.1)


def test_finding_is_geometric_with_the_probability_of_what_is_looked_for(defuser):
    """By the covariates of the round: 0.1 of terminal 1, 0.5 of terminal 2."""
    some = implants(defuser, **{"notices_terminal 1": 0.1, "notices_terminal 2": 0.5})
    ways = {name: value[None] for name, value in some.items()}
    covariates = {f"sought_{stage}": torch.tensor([[stage % 2]]) for stage in range(3)}
    found = site_probabilities(defuser, ways, covariates=covariates)
    for stage, p in enumerate((0.1, 0.5, 0.1)):
        expected = p * (1 - p) ** torch.arange(60.0)
        torch.testing.assert_close(found[f"found_{stage}"][:60], expected, rtol=1e-4, atol=1e-7)
    assert found["guess"].tolist() == [0.5, 0.5]


def test_what_counts_is_seen_once_found_and_at_no_other_stage(defuser):
    observation, states = course([WAIT, WAIT, 1, WAIT, WAIT])
    sites = {f"found_{stage}": torch.tensor([[when]]) for stage, when in enumerate((2, 1, 60))}
    for reads in (0, 1):
        seen = []
        for step in range(6):
            now = {name: value[:, step] for name, value in observation.items()}
            own = {name: value[0] for name, value in sites.items()}
            own["reads_type"] = torch.tensor([reads])
            visible = defuser.sees(own, now, step)
            assert visible["verbal"].tolist() == [[bool(reads)]]
            shown = visible["visual"][0].nonzero().flatten().tolist()
            live = int(states[step].live[0, min(int(states[step].stage[0]), 2)])
            assert shown in ([], [live])
            seen.append(bool(shown))
        # Three steps at the first stage, three at the second.
        assert seen == [False, False, True, False, True, True]


def test_an_unknown_type_is_taken_for_what_is_guessed(defuser):
    observation, _ = course([WAIT, WAIT])
    now = {name: value[:, 0] for name, value in observation.items()}
    nothing = {"visual": torch.zeros(1, 6, dtype=torch.bool), "verbal": torch.zeros(1, 1).bool()}
    own = {f"found_{stage}": torch.tensor([60]) for stage in range(3)}
    for guess in (0, 1):
        own |= {"guess": torch.tensor([guess]), "reads_type": torch.tensor([0])}
        knowledge = WORLD.nothing_known(1)
        view, knowledge = defuser.perceive(own, knowledge, now, nothing, 0)
        assert view.taken["verbal"].all() and not view.visible["verbal"].any()
        assert view.imagined["verbal"].flatten().tolist() == [guess]
        assert not view.taken["visual"].any()
        # It is believed as if it were told.
        told = {**nothing, "verbal": torch.ones(1, 1, dtype=torch.bool)}
        if guess == int(observation["verbal"][0, 0, 0, 0]):
            heard, _ = defuser.perceive(own, WORLD.nothing_known(1), now, told, 0)
            torch.testing.assert_close(defuser.evidence(heard, now), defuser.evidence(view, now))
        heard, _ = defuser.perceive(own, knowledge, now, told, 1)
        assert heard.visible["verbal"].all() and not heard.taken["verbal"].any()


def test_beliefs_stay_as_they_are_while_there_is_no_news(defuser):
    """News: the first look, the terminal once found, what is told, and the next stage."""
    actions = [WAIT] * 5 + [2] + [WAIT] * 4
    observation, _ = course(actions)
    own = {f"found_{stage}": torch.tensor([when]) for stage, when in enumerate((2, 60, 60))}
    own |= {"guess": torch.tensor([1]), "reads_type": torch.tensor([0])}
    told = {"visual": torch.zeros(1, 11, 6).bool(), "verbal": torch.zeros(1, 11, 1).bool()}
    told["verbal"][0, [4, 5]] = True
    view = perceived(defuser, own, observation, told)
    assert view.still is not None
    news = (~view.still[0]).nonzero().flatten().tolist()
    assert news == [0, 2, 4, 6]
    belief = beliefs_of(defuser, view, observation, torch.tensor([[*actions, WAIT]]))[0]
    assert (belief[1:] != belief[:-1]).any(-1).nonzero().flatten().tolist() == [1, 3, 5]
    # The same by the robot's own networks, of whole rounds.
    model, done = defuser.self_model, torch.tensor([actions])
    evidence = defuser.evidence(view, observation) + model.encoder.previous_actions(done)
    torch.testing.assert_close(model.believe(evidence, view.still)[0], belief)


def test_beliefs_that_stay_are_the_same_whenever_they_were_formed(defuser):
    """Two courses reach the same belief, one of them a step later: there is one of it."""
    some = implants(defuser)
    draws = {name: value.expand(2, *value.shape).clone() for name, value in some.items()}
    person = Person(defuser, draws)
    observation, _ = course([WAIT] * 3)
    now = {name: value[0, :1] for name, value in observation.items()}
    eyes = {f"found_{stage}": torch.tensor([0, 1]) for stage in range(3)}
    eyes |= {"guess": torch.tensor([1, 1]), "reads_type": torch.tensor([0, 0])}
    person.percepts, person.percept, person.percept_count = eyes, torch.arange(2), 2
    rounds = RoundSoFar.begin(WORLD, {name: value[0, 0] for name, value in observation.items()})
    beliefs, own = beliefs_before(person, rounds)
    quiet = {"visual": torch.zeros(2, 6).bool(), "verbal": torch.zeros(2, 1).bool()}
    numbers = []
    for step in range(3):
        last = 5 if step == 0 else WAIT
        now = {name: value[0, step : step + 1] for name, value in observation.items()}
        step_of = person.transition(torch.arange(2), torch.full((2,), last), now, quiet)
        beliefs, own = beliefs.at(own).after(step_of).distinct()
        numbers.append((len(beliefs.mean), own.tolist()))
    # One found it at once, the other after a step: as that says other things, they never agree.
    assert [number for number, _ in numbers] == [2, 2, 2]
    # Had both been told, they would have formed it at the same time, and it stays one.
    both = {"visual": torch.ones(2, 6).bool(), "verbal": torch.ones(2, 1).bool()}
    beliefs, own = beliefs_before(person, rounds)
    for step in range(3):
        last = 5 if step == 0 else WAIT
        now = {name: value[0, step : step + 1] for name, value in observation.items()}
        # Later the second course is in another future, in which all is as in the first.
        two = {name: value.repeat(2, *(1,) * (value.dim() - 1)) for name, value in now.items()}
        rows, heard = (torch.arange(2), quiet) if step else (own * 0, both)
        step_of = person.transition(torch.arange(2), torch.full((2,), last), two, heard, rows)
        beliefs, own = beliefs.at(own).after(step_of).distinct()
        assert len(beliefs.mean) == 1
        assert own.tolist() == [0, 0]


def test_a_model_that_lacks_the_sites_of_the_world_is_warned_of(defuser, tmp_path):
    file = tmp_path / "own.py"
    file.write_text(
        "from mirror_ppl.models import HumanModel\n\n\nclass Own(HumanModel):\n    pass\n"
    )
    message = "Own lacks the sites in which people of bomb_defusal differ; derive it from .*Human"
    with pytest.warns(LacksSitesOfWorld, match=message):
        load_human_model(f"{file}:Own", defuser.self_model)
    load_human_model(f"{file}:Own", SelfModel(get_domain("driving")))
