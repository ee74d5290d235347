"""The family of human models: each by itself, and all of them as one program."""

import itertools
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from few_reaches import robot_of_few_reaches

import mirror_ppl
from mirror_ppl.communication import (
    Communicator,
    ExpectedUtility,
    Person,
    RoundSoFar,
    SimulatorWorld,
)
from mirror_ppl.data import asset_path, concatenate, load_demonstrations
from mirror_ppl.domains.bomb_defusal.human_variants import BombDefusalAnyKind
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models import HumanModel
from mirror_ppl.models.family import (
    FORGETS,
    KIND,
    LATE,
    NOTICES,
    SHARES_GOAL,
    AnyKind,
    Forgetting,
    HardOfHearing,
    Late,
    Noticing,
    Preferring,
    SeveralBeliefs,
)
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds, simulate_from_prior
from mirror_ppl.models.weights import load_self_model, shipped_weights

KINDS = tuple(AnyKind.members)
WORLDS = ("driving", "search_rescue", "bomb_defusal")


def self_model(world):
    return load_self_model(shipped_weights(world), world)[0]


@pytest.fixture(scope="module")
def driving():
    return self_model("driving")


@pytest.fixture(scope="module")
def few_reaches():
    return robot_of_few_reaches()


def beliefs(human, world):
    return torch.randn(1, 5, human.belief_size, generator=torch.Generator().manual_seed(1))


def probabilities(human, implants, belief):
    return human.act(implants, belief, human.action_values(belief))


@pytest.mark.parametrize(
    ("world", "kind"),
    [
        (world, kind)
        for world in WORLDS
        for kind in (BombDefusalAnyKind if world == "bomb_defusal" else AnyKind).members
    ],
)
def test_of_each_kind_all_is_that_model(world, kind):
    """With the beliefs that this model has, whatever the others are."""
    robot = self_model(world)
    everybody, own = load_human_model("all", robot), load_human_model(kind, robot)
    implants = {name: value[0] for name, value in draw_prior(everybody, 1, 1, 3).items()}
    implants[KIND] = torch.tensor([[everybody.family.index(kind)]])  # pyright: ignore
    belief = beliefs(everybody, world)
    found = probabilities(everybody, implants, belief)
    names = own.beliefs if isinstance(own, SeveralBeliefs) else ("now",)
    assert isinstance(everybody, SeveralBeliefs)
    parts = belief.chunk(len(everybody.beliefs), -1)
    part = torch.cat([parts[everybody.beliefs.index(name)] for name in names], -1)
    torch.testing.assert_close(found, probabilities(own, implants, part), atol=2e-4, rtol=1e-3)
    torch.testing.assert_close(found.exp().sum(-1), torch.ones(1, 5))


def test_of_many_draws_each_is_as_it_is_alone(driving):
    """Draws that never act on a belief are left out there: the others have what they had."""
    human = AnyKind(driving)
    draws = draw_prior(human, 1, 40, 3)
    belief = beliefs(human, "driving")
    together = probabilities(human, draws, belief)
    assert together.shape == (40, 1, 5, 2)
    for number in range(40):
        alone = {name: value[number] for name, value in draws.items()}
        torch.testing.assert_close(
            together[number], probabilities(human, alone, belief), atol=2e-4, rtol=1e-3
        )


class Blind(HumanModel):
    """Sees nothing by themselves."""

    def sees(self, implants, observation, step):
        seen = super().sees(implants, observation, step)
        return {name: torch.zeros_like(mask) for name, mask in seen.items()}


@pytest.mark.parametrize("world", WORLDS[:2])
def test_beliefs_are_those_of_a_person_who_missed_it_or_forgot_it(world):
    """Step by step by the package's own model, with views that are made by hand."""
    robot = self_model(world)
    base, noticing, forgetting = HumanModel(robot), Noticing(robot), Forgetting(robot)
    domain, generator = base.domain, torch.Generator().manual_seed(1)
    implants = {name: value[0, :, 0] for name, value in draw_prior(base, 1, 1, 3).items()}
    reach = {site: torch.full((1,), len(domain.reach_bins) - 1) for site in sight_sites(domain)}
    state = domain.initial(1, generator)
    nothing = {m.name: torch.zeros(1, len(m.items), dtype=torch.bool) for m in domain.modalities}
    before = torch.zeros(1, base.belief_size)
    action = torch.tensor([len(domain.actions)])
    kept = {"now": before, "missed": [before] * 3, "forgot": [before] * 3}
    several = [torch.zeros(1, one.belief_size) for one in (noticing, forgetting)]
    known, apart = [domain.nothing_known(1)] * 3, [False, False]
    knowledge = [one.nothing_known(1) for one in (noticing, forgetting)]
    for step in range(4):
        now = domain.observe(state)

        def seen(own, known, now=now, step=step):
            return base.perceive(implants | own, known, now, nothing, step)

        def inferred(belief, view, action=action, now=now):
            return base.belief_after(belief, base.evidence(view, now), action)

        view, after = seen(reach, known[0])
        unseen = [Blind(robot).perceive(implants, own, now, nothing, step) for own in known]
        # What was missed is not known either.
        known = [after, *(missed for _, missed in unseen[:2])]
        before_it = [kept["now"], *kept["missed"]]
        afresh, _ = seen(reach, domain.nothing_known(1))
        none = torch.tensor([len(domain.actions)])
        first = inferred(torch.zeros_like(before), afresh, none)
        kept = {
            "now": inferred(kept["now"], view),
            "missed": [
                inferred(own, one) for own, (one, _) in zip(before_it[:3], unseen, strict=True)
            ],
            "forgot": [
                first,
                *(inferred(own, afresh) if step else first for own in kept["forgot"][:2]),
            ],
        }
        apart[0] |= not torch.equal(kept["missed"][2], kept["now"])
        apart[1] |= not torch.equal(kept["forgot"][0], kept["now"])
        for place, human in enumerate((noticing, forgetting)):
            own, knowledge[place] = human.perceive(
                implants | reach, knowledge[place], now, nothing, step
            )
            several[place] = human.believe(several[place], human.evidence(own, now), action)
        torch.testing.assert_close(several[0], torch.cat([kept["now"], *kept["missed"]], -1))
        torch.testing.assert_close(several[1], torch.cat([kept["now"], *kept["forgot"]], -1))
        action = torch.tensor([step % 2])
        state = domain.transition(state, action)
    assert apart[0] and (apart[1] or world != "driving")  # where one step shows no speed


@pytest.mark.parametrize("human", [Late, Noticing, Forgetting, AnyKind])
def test_all_that_is_done_is_done_on_some_belief(driving, human):
    """Shares add up, and at the package's own values all is done on the belief of now."""
    model = human(driving)
    drawn = {name: value[0] for name, value in draw_prior(model, 1, 1, 3).items()}
    total = sum(model.shares(drawn).values())
    torch.testing.assert_close(total, torch.ones(1, 1))
    usual = drawn | {LATE: torch.zeros(1, 1), NOTICES: torch.ones(1, 1)}
    shares = model.shares(usual | {FORGETS: torch.zeros(1, 1)})
    assert float(shares.pop("now")) == 1
    assert not any(float(share) for share in shares.values())
    assert {*shares} == {*model.beliefs} - {"now"}


@pytest.mark.parametrize("name", ["noticing", "forgetting"])
def test_what_makes_no_sense_in_a_world_is_refused(name):
    with pytest.raises(HumanModelError, match=f"^{name}: in bomb_defusal "):
        load_human_model(name, self_model("bomb_defusal"))


@pytest.mark.parametrize(
    ("late", "shares"),
    [
        (0.0, (1, 0, 0, 0)),
        (0.5, (0.5, 0.5, 0, 0)),
        (1.0, (0, 1, 0, 0)),
        (2.25, (0, 0, 0.75, 0.25)),
        (3.0, (0, 0, 0, 1)),
    ],
)
def test_late_follows_the_beliefs_of_so_many_steps_before(driving, late, shares):
    human, base = Late(driving), HumanModel(driving)
    implants = {name: value[0] for name, value in draw_prior(human, 1, 1, 3).items()}
    belief = beliefs(human, "driving")
    found = probabilities(human, implants | {LATE: torch.tensor([[late]])}, belief).exp()
    each = [probabilities(base, implants, part).exp() for part in belief.chunk(4, -1)]
    expected = sum(share * own for share, own in zip(shares, each, strict=True))
    torch.testing.assert_close(found, expected)


def test_the_beliefs_before_are_kept(driving):
    human, base = Late(driving), HumanModel(driving)
    evidence = torch.randn(5, 3, driving.encoder.ego.out_features)
    action = torch.full((3,), len(human.domain.actions))
    own, found = torch.zeros(3, base.belief_size), torch.zeros(3, human.belief_size)
    kept = []
    for now in evidence:
        own, found = base.believe(own, now, action).mean, human.believe(found, now, action)
        kept = [own, *(kept or [own] * 3)][:4]
        torch.testing.assert_close(found, torch.cat(kept, -1))
        action = torch.zeros(3, dtype=torch.long)
    assert not any(torch.equal(*pair) for pair in itertools.pairwise(kept))


def test_who_shares_no_goal_does_not_look_at_values(driving):
    human = Preferring(driving)
    implants = {name: value[0] for name, value in draw_prior(human, 1, 1, 3).items()}
    implants |= {SHARES_GOAL: torch.zeros(1, 1), "prefers_switch": torch.full((1, 1), 1.5)}
    implants |= {"residual_in": torch.zeros(1, 1, 49, 8), "residual_out": torch.zeros(1, 1, 9, 2)}
    found = probabilities(human, implants, beliefs(human, "driving"))
    torch.testing.assert_close(found[..., 1] - found[..., 0], torch.full((1, 5), 1.5))


def test_messages_that_do_not_reach_a_person_change_nothing(driving):
    """Messages of one channel at a time, to a person who sees nothing, each of which changes."""
    human = HardOfHearing(driving)
    domain, generator = human.domain, torch.Generator().manual_seed(1)
    implants = {name: value[0, :, 0] for name, value in draw_prior(human, 1, 1, 3).items()}
    implants |= {site: torch.zeros(1, dtype=torch.long) for site in sight_sites(domain)}
    observation = domain.observe(domain.initial(1, generator))
    nothing = {m.name: torch.zeros(1, len(m.items), dtype=torch.bool) for m in domain.modalities}

    def seen(told, **hears):
        view, _ = human.perceive(
            implants | {name: torch.tensor([value]) for name, value in hears.items()},
            domain.nothing_known(1),
            observation,
            told,
            0,
        )
        return torch.cat([view.visible[name] for name in nothing], -1)

    silent = seen(nothing, hears_visual=1, hears_verbal=1)
    for name, other in (("visual", "verbal"), ("verbal", "visual")):
        told = nothing | {name: ~nothing[name]}
        deaf, hearing = {f"hears_{name}": 0, f"hears_{other}": 1}, {f"hears_{name}": 1}
        assert torch.equal(seen(told, **deaf), silent)
        assert not torch.equal(seen(told, **hearing, **{f"hears_{other}": 0}), silent)


def of_kind(human, seed, rounds=6, **known):
    implants = {name: value[0] for name, value in draw_prior(human, 2, 1, seed).items()}
    implants |= {name: torch.full((2, 1), value) for name, value in known.items()}
    return play_rounds(human, implants, rounds, "fog", torch.Generator().manual_seed(seed))


FEW = {"settings": {"proposals": 128, "enough": 25.0}, "draws": 100, "explore": 0}
"""Settings with which kinds that differ much are distinguished."""
PEOPLE = {
    "mirror": (HumanModel, 4, {}),
    "late": (Late, 5, {LATE: 0.95}),
    "noticing": (Noticing, 8, {NOTICES: 0.5}),
    "forgetting": (Forgetting, 4, {FORGETS: 0.7}),
    "preferring": (Preferring, 4, {SHARES_GOAL: -0.8}),
}
"""Model, number of rounds and known implants of somebody who is clearly of each kind."""


def test_a_fit_distinguishes_kinds_and_reports_how_probable_each_is(few_reaches):
    """One fit of five people, of whom each is of another kind."""
    people = [
        replace(
            of_kind(model(few_reaches), 100, rounds, consistency=4.0, **known).select_people([0]),
            people=(kind,),
        )
        for kind, (model, rounds, known) in PEOPLE.items()
    ]
    assert tuple(PEOPLE) == KINDS
    fit = mirror_ppl.infer(
        concatenate(people),
        human=AnyKind(few_reaches),
        engine="importance",
        train_rounds=8,
        **FEW,
        seed=1,
    )
    drawn = torch.from_numpy(fit.data["posterior"][KIND].values[0])  # [S, P]
    for number, (kind, person) in enumerate(zip(KINDS, fit.summary["people"], strict=True)):
        assert (drawn[:, number] == number).float().mean() > 0.5, kind
        assert person["pareto_k"] < 0.7
        models = person["check"]["models"]
        assert list(models) == list(KINDS) and sum(models.values()) == pytest.approx(1)
        assert person["implants"][KIND]["most_probable"] == kind
        assert person["implants"][KIND]["probability"] == pytest.approx(models[kind])
        assert fit.check[f"p({kind})"].iloc[number] == models[kind]
    assert fit.check["p(late)"].iloc[KINDS.index("late")] > 0.9


@pytest.mark.parametrize("known", [{SHARES_GOAL: -0.8}, {SHARES_GOAL: 1.0}])
def test_what_few_kinds_of_people_could_have_seen_is_not_given_up(few_reaches, known):
    """Policies of each kind tell what is given up; of few drawn from all, most are mirror's."""
    human, everybody = Preferring(few_reaches), AnyKind(few_reaches)
    implants = {name: value[0] for name, value in draw_prior(human, 1, 1, 100).items()}
    implants |= {name: torch.full((1, 1), value) for name, value in known.items()}
    rounds = play_rounds(human, implants, 12, "fog", torch.Generator().manual_seed(100))
    builder = ViewTableBuilder(everybody, Screening())
    builder.add(rounds_of(rounds, 0))
    true = builder.grid.place_of({site: implants[site][0, 0] for site in builder.grid})
    assert (builder.alive == true).any()
    kinds = builder.policies[KIND].flatten().tolist()
    assert kinds == [*range(len(KINDS))] * Screening().policies


def test_what_is_stratified_by_has_to_be_discrete(driving):
    class Wrong(HumanModel):
        stratified_by = "consistency"

    with pytest.raises(HumanModelError, match="stratified_by is 'consistency', no discrete"):
        ViewTableBuilder(Wrong(driving), Screening())


@pytest.mark.parametrize("world", ["driving", "bomb_defusal"])
def test_without_rounds_what_is_known_is_the_prior(world, few_reaches):
    """With both models of all kinds."""
    human = load_human_model("all", few_reaches if world == "driving" else self_model(world))
    rounds = simulate_from_prior(human, 1, 1, seed=1)
    fit = mirror_ppl.infer(rounds, human=human, engine="importance", train_rounds=0, **FEW)
    assert fit.summary["people"][0]["rounds"] == 0
    assert abs(fit.summary["people"][0]["log_evidence"]) < 0.05  # an average of weights
    assert fit.summary["people"][0]["check"]["verdict"] == "unchecked"
    assert "check.png" not in [name for name, _, _ in fit.plot.files()]
    assert "unexplained" not in repr(fit) and "suspect" not in repr(fit)
    with pytest.raises(InputError, match="without training rounds there is nothing to check"):
        fit.plot.check()


def test_evidence_is_of_actions_alone(few_reaches):
    class Asked(HumanModel):
        def prior(self):
            implants = super().prior()
            pyro.sample("asked", dist.Normal(implants["consistency"], 0.5), obs=torch.tensor(3.0))
            return implants

    rounds = of_kind(HumanModel(few_reaches), 100, 1).select_people([0])
    fit = mirror_ppl.infer(rounds, human=Asked(few_reaches), engine="importance", **FEW)
    assert fit.summary["people"][0]["log_evidence"] is None


def test_people_whom_no_channel_reaches_get_no_message(driving):
    """In the moments in which those who hear, alike in all else, are told something."""
    human = HardOfHearing(driving)
    draws = draw_prior(human, 1, 16, 1)
    draws |= {site: torch.zeros_like(draws[site]) for site in sight_sites(human.domain)}
    heard = {site: torch.ones_like(draws[site]) for site in ("hears_visual", "hears_verbal")}
    deaf = {site: torch.zeros_like(value) for site, value in heard.items()}
    only = heard | {"hears_verbal": deaf["hears_verbal"]}
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc"))
    told = []
    for hears in (heard, only, deaf):
        person = Person(human, draws | hears)
        communicator = Communicator(person, ExpectedUtility(SimulatorWorld(human.domain), 5))
        decisions = [
            communicator.plan(RoundSoFar.of(recordings, "person-01", number, 3))
            for number in range(6)
        ]
        told.append([{channel for channel, _ in one.message} for one in decisions])
    assert any(told[0])
    assert any(told[1]) and not any("verbal" in channels for channels in told[1])
    assert not any(told[2])
