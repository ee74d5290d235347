"""Searchers: when they find what counts, what they take a bomb for, and the rules they know."""

from dataclasses import replace
from itertools import permutations

import pyro
import pytest
import torch
from example_course import beliefs_of, perceived
from example_person import beliefs_before
from pyro import poutine

from mirror_ppl.communication import Person, RoundSoFar
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.bomb_defusal import BombDefusal
from mirror_ppl.domains.bomb_defusal.human import BombDefusalHuman
from mirror_ppl.domains.bomb_defusal.panel import BUTTONS, OLD_RULES, RULES, read_panel
from mirror_ppl.errors import LacksSitesOfWorld
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.results.summary import summarize
from mirror_ppl.likelihood.attention import Proposal, site_probabilities
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

WORLD = BombDefusal()
WAIT = 0
ORDERS = list(permutations(range(4)))
RESIDUAL = {"residual_in": (49, 8), "residual_out": (9, 5)}


@pytest.fixture(scope="module")
def defuser():
    torch.manual_seed(0)
    return BombDefusalHuman(SelfModel(WORLD))


def course(actions, seed=0, rounds=1):
    """Observations ``[rounds, T + 1, ...]`` of rounds in which this is done, and the states."""
    state = WORLD.initial(rounds, torch.Generator().manual_seed(seed))
    states = [state]
    for action in actions:
        states.append(WORLD.transition(states[-1], torch.full((rounds,), action)))
    observed = [WORLD.observe(state) for state in states]
    return {name: torch.stack([o[name] for o in observed], 1) for name in observed[0]}, states


def implants(defuser, seed=0, **values):
    """Sites of one person with given values."""
    given = {name: torch.tensor([[value]]) for name, value in values.items()}
    with (
        torch.random.fork_rng(),
        poutine.condition(data=given),
        pyro.plate("person", 1, dim=-2),
    ):
        torch.manual_seed(seed)
        return defuser.prior()


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


def test_who_is_asked_to_play_searches_for_what_each_stage_shows():
    """Terminal 1 is found at once, all others never: a stage ends if it shows terminal 1."""
    torch.manual_seed(0)
    human = BombDefusalHuman(Knowing(WORLD))
    quick = {f"notices_terminal {k}": torch.tensor([[1e-6]]) for k in range(2, 7)}
    quick |= {"notices_terminal 1": torch.tensor([[1 - 1e-6]])}
    quick |= {"consistency": torch.tensor([[20.0]]), "lapse": torch.tensor([[1e-6]])}
    quick |= {name: torch.zeros(1, 1, *shape) for name, shape in RESIDUAL.items()}
    played = play_rounds(human, quick, 200, "labelled", torch.Generator().manual_seed(0))
    live, _ = read_panel(played.observations["visual"][0])
    stage = played.ego[0, ..., 0]
    for first, after, where in zip(stage[:, 0], stage[:, 20], live[:, :20], strict=True):
        assert int(first) == 0
        assert int(after) == sum(bool((where[: number + 1] == 0).all()) for number in range(3))
    assert (stage[:, 20] > 0).float().mean() == pytest.approx(
        1 / 6, abs=4.5 * (5 / 36 / 200) ** 0.5
    )


def test_buttons_are_exchanged_by_the_rule_of_the_type_believed_in(defuser, monkeypatch):
    """Where the robot would press b, they press ORDERS[rule][b]: values go with the buttons."""
    values = torch.tensor([0.5, 1.0, 2.0, 3.0, 4.0]).expand(1, 1, 5)
    belief = torch.zeros(1, 1, 48)
    for kind, rule in ((0, 1), (1, 9)):
        monkeypatch.setattr(
            defuser, "believed_kind", lambda belief, kind=kind: torch.full((1, 1), float(kind))
        )
        some = implants(defuser, lapse=1e-9, consistency=1.0) | {
            **{name: torch.zeros(1, 1, *shape) for name, shape in RESIDUAL.items()},
            "rule_type_a": torch.tensor([[1]]),
            "rule_type_b": torch.tensor([[9]]),
        }
        found = defuser.act(some, belief, values).flatten()
        expected = torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0])
        for robot in range(4):
            expected[1 + ORDERS[rule][robot]] = 1.0 + robot
        torch.testing.assert_close(found, expected.log_softmax(0), rtol=0, atol=1e-4)


def test_rules_are_learned_from_rewards_and_planned_with():
    """Of forty rounds or so there is one set of rules that explains all rewards."""
    torch.manual_seed(0)
    human = BombDefusalHuman(SelfModel(WORLD))
    torch.testing.assert_close(human.rule_logits.exp().sum(-1), torch.ones(2))
    assert human.rule_logits.exp()[:, 0].tolist() == pytest.approx([0.5, 0.5])
    recorded = simulate("bomb_defusal", "labelled", people=3, rounds=20, seed=1)
    human.fit_world(recorded)
    learned = [ORDERS[int(logits.argmax())] for logits in human.rule_logits]
    assert human.rule_logits.exp().amax(-1).min() > 0.99
    for kind in range(2):
        for symbol in range(4):
            assert learned[kind][OLD_RULES[kind][symbol]] == RULES[kind][symbol]
    some = implants(human)
    assert human.planning_domain({name: value[None] for name, value in some.items()}).rules == RULES
    # Asked again it learns the same.
    before = human.rule_logits.clone()
    human.fit_world(recorded)
    assert torch.equal(human.rule_logits, before)
    # Without rewards there is nothing to learn.
    again = BombDefusalHuman(human.self_model)
    again.fit_world(replace(recorded, rewards=None))
    assert again.rule_logits.exp()[:, 0].tolist() == pytest.approx([0.5, 0.5])


def test_actions_identify_when_it_was_found(defuser):
    observation, _ = course([WAIT] * 4 + [2] + [WAIT] * 3)
    own = {name: value[0] for name, value in observation.items()}
    actions = torch.tensor([WAIT] * 4 + [2] + [WAIT] * 3)
    found = defuser.log_proposal(own, actions)
    # Pressed at the fifth step: found just then, rather than before or after.
    assert int(found["found_0"].argmax()) == 4
    assert set(found) == {"found_0", "found_1"}
    later = found["found_1"]
    assert later[3:].tolist() == [0.0] * 58 and (later[:2] < 0).all()
    proposal = Proposal(defuser, *(2 * [{n: v[None] for n, v in implants(defuser).items()}]), 64)
    covariates = {name: value.view(1, 1) for name, value in defuser.covariates(observation).items()}
    chosen = proposal.values(None, 0, covariates, found)
    weights = torch.bincount(chosen.values["found_0"], minlength=61)
    assert int(weights.argmax()) == 4
    assert chosen.covariates.keys() == covariates.keys()


def test_who_is_in_a_round_has_not_found_what_they_wait_for(defuser):
    """A consistent person who waited four steps: most draws have not found it yet."""
    some = implants(defuser, **{"notices_terminal 1": 0.2}, consistency=20.0, lapse=0.01)
    draws = {name: value.expand(40, *value.shape).clone() for name, value in some.items()}
    observation, _ = course([WAIT] * 4)
    rounds = RoundSoFar.begin(WORLD, {name: value[0, 0] for name, value in observation.items()})
    quiet = {"visual": torch.zeros(6, dtype=torch.bool), "verbal": torch.zeros(1).bool()}
    for step in range(1, 5):
        now = {name: value[0, step] for name, value in observation.items()}
        rounds = rounds.then(quiet, WAIT, now)
    person = Person(defuser, draws).in_round(rounds)
    found = person.percepts["found_0"][person.percept]
    assert len(found) == 40 and found.unique().numel() > 1


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


def test_a_person_s_probabilities_come_out_of_their_rounds():
    """With a self-model that presses when it knows and waits until then, by hand."""
    torch.manual_seed(0)
    human = BombDefusalHuman(Knowing(WORLD))
    recorded = simulate("bomb_defusal", "labelled", people=1, rounds=12, seed=0)
    human.fit_world(recorded)
    builder = ViewTableBuilder(human, Screening())
    builder.add(rounds_of(recorded, 0))
    found = sample_importance(human, builder.table(), ImportanceOptions(proposals=256))
    draws = found.sample(200, builder.grid)
    mean = torch.stack([draws[f"notices_terminal {k}"].mean() for k in range(1, 7)]).mean()
    # About 30 finds, and a prior worth one: a standard error of a fifth.
    truth = recorded.truth["notices_terminal 1"][0]
    assert abs((mean / truth).log()) < 4.5 / 30**0.5
    assert draws["reads_type"].float().mean() > 0.99


class Knowing(SelfModel):
    """A self-model that believes what there is to see, and values it by the old rules."""

    class Reader(torch.nn.Module):
        """Beliefs are values: those of a press are known of a lit terminal of a known type."""

        def __init__(self, action):
            super().__init__()
            self.action = action

        def embed(self, symbols):
            """Values of a bomb of either type ``[..., 1, 10]``, for every terminal."""
            ego = torch.nn.functional.pad(symbols["ego"].argmax(-1, keepdim=True).float(), [0, 1])
            values = []
            for kind in (0.0, 1.0):
                seen = {"ego": ego, "visual": symbols["visual"]}
                seen["verbal"] = torch.full((*ego.shape[:-1], 1, 1), kind)
                state = WORLD.state_behind(seen)
                values.append(WORLD.as_believed.reference_values(state, 0.9))
            lit = WORLD.sought({"ego": ego, **symbols})
            return {"ego": torch.cat(values, -1), "visual": lit, "verbal": symbols["verbal"]}

        def combine(self, embedded, visible, imagined=None, taken=None):
            kind = embedded["verbal"][..., 0, 1:]
            known = visible["verbal"].float()
            if imagined is not None:
                guess = imagined["verbal"][..., 0, 1:]
                kind, known = torch.where(visible["verbal"], kind, guess), torch.ones_like(known)
            first, second = embedded["ego"].split(5, -1)
            values = (1 - kind) * first + kind * second
            found = (visible["visual"] & embedded["visual"]).any(-1, keepdim=True) & (known > 0)
            wait = torch.tensor([0.0, -5.0, -5.0, -5.0, -5.0])
            values = torch.where(found, values, wait)
            kind = kind.expand(*values.shape[:-1], 1)
            return torch.nn.functional.pad(torch.cat([values, kind], -1), [0, 128 - 6])

        def previous_actions(self, actions):
            return torch.zeros(*actions.shape[:-1], actions.shape[-1] + 1, 128)

        def forward(self, previous, evidence):
            mean = evidence[..., :48]
            return Gaussian(mean, torch.ones_like(mean))

    def __init__(self, domain):
        super().__init__(domain)
        with torch.no_grad():
            self.encoder.action.weight.zero_()
        self.encoder = self.Reader(self.encoder.action)
        self.decoders["verbal"] = Kind()

    def action_values(self, belief):
        return belief[..., :5]


class Kind(torch.nn.Module):
    """Reads the type off a belief of `Knowing`."""

    def forward(self, belief):
        return type("Decoded", (), {"mean": belief[..., 5, None, None]})


def test_of_rules_the_most_probable_one_is_reported():
    human = BombDefusalHuman(load_self_model(shipped_weights("bomb_defusal"), "bomb_defusal")[0])
    names = human.value_names["rule_type_b"]
    assert len(names) == len(set(names)) == len(human.exchanges)
    # What is pressed for the robot's second button by the rule of that name.
    pressed = human.exchanges[9][:, 1].argmax()
    assert names[9].split()[1] == BUTTONS[pressed]
    assert names[0] == f"{' '.join(BUTTONS)} (as the robot)"
    recorded = load_demonstrations(asset_path("bomb_defusal_unlabelled_paper.nc"))
    train = recorded.select_people([0]).select_rounds([0])
    draws = {
        "rule_type_b": torch.tensor([[9], [9], [9], [2]]),
        "lapse": torch.tensor([[0.1], [0.2], [0.3], [0.4]]),
    }
    (person,) = summarize(draws, train, None, human.value_names)
    assert person["implants"]["rule_type_b"] == {
        "most_probable": names[9], "probability": 0.75, "truth": None
    }  # fmt: skip
    assert person["implants"]["lapse"]["median"] == pytest.approx(0.2)


def test_a_model_that_lacks_the_sites_of_the_world_is_warned_of(defuser, tmp_path):
    file = tmp_path / "own.py"
    file.write_text(
        "from mirror_ppl.models import HumanModel\n\n\nclass Own(HumanModel):\n    pass\n"
    )
    message = "Own lacks the sites in which people of bomb_defusal differ; derive it from .*Human"
    with pytest.warns(LacksSitesOfWorld, match=message):
        load_human_model(f"{file}:Own", defuser.self_model)
    load_human_model(f"{file}:Own", SelfModel(get_domain("driving")))
