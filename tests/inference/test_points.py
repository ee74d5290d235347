"""Points: models whose perception reads continuous sites, against exact and slower answers."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_far import CUTS, SHARES, TRUE, Able, Far, Glasses, Rare, Scaled, Vector
from example_programs import DistractedPerson
from few_reaches import robot_of_few_reaches
from paths import DOCS, EXAMPLES
from scipy import integrate, stats

import mirror_ppl
from mirror_ppl.communication.hearing import HearingPerson
from mirror_ppl.communication.objectives import predicted_choices
from mirror_ppl.communication.person import Person, PlanningContext
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.evaluation.fit_report import show_fit
from mirror_ppl.inference import point_proposals
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.inference.results.identifiability import identify
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.likelihood.combinations import log_priors, needs_points, perceived_names
from mirror_ppl.likelihood.compiled import Sequential
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.points import FIRST_POINTS, PriorPoints, whole_grid
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.spans import Span
from mirror_ppl.models.toy import RATES, ToyHuman, toy_posterior
from mirror_ppl.training.guide import GuideOptions, train_guide


@pytest.fixture(scope="module")
def toy(self_model):
    return ToyHuman(self_model)


@pytest.fixture(scope="module")
def played(toy):
    generator = torch.Generator().manual_seed(5)
    return play_rounds(toy, TRUE | {"otherwise": torch.tensor([[0.1]])}, 6, "fog", generator)


def likelihoods(toy, rounds):
    """Evidence of the rounds given each reach."""
    found = toy_posterior(toy, rounds)
    return (found.log_evidence[0] + found.reach[0].log() + math.log(len(SHARES))).exp()


def shares(mean=0.0, spread=1.0):
    edges = [-math.inf, *CUTS.tolist(), math.inf]
    return torch.tensor(stats.norm.cdf(edges, mean, spread)).diff()


def exact_joint(kind, toy, rounds):
    """Joint probability of each reach and the actions, by arithmetic or quadrature."""
    if kind is Glasses:
        prior = 0.3 * SHARES
        prior[0] += 0.7
        return prior * likelihoods(toy, rounds)
    if kind is Scaled:
        density = stats.lognorm(0.5, scale=math.exp(-0.5)).pdf
        own, _ = integrate.quad_vec(lambda spread: density(spread) * shares(0, spread), 1e-3, 20)
        return own * likelihoods(toy, rounds)
    if kind is Able:
        # The posterior of in_sight given a reach is a Beta density.
        rates, found = toy_posterior(toy, rounds).rates["in_sight"][0], []
        for reach, (one, two) in enumerate(rates.tolist()):
            density = stats.beta(one, two).pdf
            found.append(
                integrate.quad(
                    lambda rate, density=density, reach=reach: (
                        density(rate) * float(shares(2 * rate - 1)[reach])
                    ),
                    0,
                    1,
                )[0]
            )
        return torch.tensor(found) * likelihoods(toy, rounds)
    return SHARES * likelihoods(toy, rounds)


@pytest.mark.parametrize("kind", [Far, Vector, Glasses, Scaled, Able])
def test_the_posterior_and_the_evidence_are_exact(kind, toy, played, seed):
    human = kind(toy.self_model)
    draws = 2000
    found = infer(human, played, InferenceOptions("importance", draws), seed)
    joint = exact_joint(kind, toy, played)
    error = float(found.evidence_error[0])
    assert error < 0.15
    assert abs(float(found.log_evidence[0]) - float(joint.sum().log())) < 4 * error
    own = {name: value[:, 0, 0] for name, value in found.draws.items()}
    reach = torch.bucketize(human.place(own).double(), CUTS)
    often = torch.bincount(reach, minlength=len(joint)) / draws
    # Draws are chosen from points that count as 1 / error² independent ones.
    expected = joint / joint.sum()
    tolerance = 4 * (expected * (1 - expected) * (error**2 + 1 / draws)).sqrt() + 4 / draws
    assert ((often - expected).abs() < tolerance).all()
    assert float(found.pareto_k[0]) < 0.7
    if kind is not Able:
        rates = toy_posterior(toy, played).rates["in_sight"][0]
        mean, deviation = own["in_sight"].mean(), float(own["in_sight"].std())
        exact = float(expected @ (rates[:, 0] / rates.sum(-1)))
        assert abs(float(mean) - exact) < 4 * deviation * math.hypot(error, draws**-0.5)


def test_without_new_points_the_error_is_large(toy, played, monkeypatch):
    """And is said to be large: the first points hardly contain such a person."""
    monkeypatch.setattr(point_proposals, "STAGES", 0)
    found = infer(Vector(toy.self_model), played, InferenceOptions("importance", 50), 0)
    assert float(found.evidence_error[0]) > 0.2


class Chained(DistractedPerson):
    """Attention that is summed out exactly: read throughout the round."""

    def spans(self, observation):
        return {"away": Span(0, len(observation["ego"]), 2)}


class ChainedBesidePoints(Chained):
    """A distracted person with two numbers that change nothing."""

    spans = Chained.spans

    def prior(self):
        two = dist.Normal(torch.zeros(2), 1.0).to_event(1)
        return super().prior() | {"far": pyro.sample("far", two)}

    def sees(self, implants, observation, step):
        near = implants["far"].sum(-1, keepdim=True) < 99
        return {
            name: mask & near for name, mask in super().sees(implants, observation, step).items()
        }


def test_attention_is_summed_out_beside_points(recordings):
    """Its evidence is that of the model without the two numbers."""
    few = robot_of_few_reaches()
    rounds = recordings.select_people(["person-02"]).select_rounds([0, 1])
    options = InferenceOptions("importance", 50)
    plain, found = (infer(kind(few), rounds, options, 0) for kind in (Chained, ChainedBesidePoints))
    error = math.hypot(float(plain.evidence_error[0]), float(found.evidence_error[0]))
    assert error < 0.15
    assert abs(float(found.log_evidence[0]) - float(plain.log_evidence[0])) < 4 * error
    draws = {name: value[:2] for name, value in found.draws.items()}
    assert predict_rounds(ChainedBesidePoints(few), rounds, draws).isfinite().all()


def test_people_do_not_depend_on_each_other(toy, played):
    human = Far(toy.self_model)
    generator = torch.Generator().manual_seed(6)
    implants = {name: value.expand(2, 1) for name, value in TRUE.items()}
    two = play_rounds(toy, implants, 2, "fog", generator)
    both = infer(human, two, InferenceOptions("importance", 20), 0)
    alone = infer(human, two.select_people(two.people[1:]), InferenceOptions("importance", 20), 0)
    for name, value in alone.draws.items():
        assert torch.equal(both.draws[name][:, 1:], value)


def test_online_is_as_offline(toy, played):
    human = Far(toy.self_model)
    online = OnlinePosterior(human)
    for number in range(played.shape[1]):
        online.add(played.select_rounds([number]))
    reach = torch.bucketize(online.draws(2000)["far"].flatten().double(), CUTS)
    joint = exact_joint(Far, toy, played)
    often = torch.bincount(reach, minlength=len(joint)) / len(reach)
    # As good as 200 independent points: 4 standard errors of a share of a half.
    assert ((often - joint / joint.sum()).abs() < 4 * 0.5 / math.sqrt(200)).all()
    assert online.pareto_k < 0.7


@pytest.fixture(scope="module")
def in_cells(self_model):
    file = EXAMPLES / "sight_in_cells.py"
    return load_human_model(f"{file}:SightInCells", self_model)


def test_a_model_with_reaches_in_cells_is_checked_and_compiled(in_cells, recordings):
    check_contract(in_cells)
    assert needs_points(in_cells)
    read = {"assumes_clear", "assumes_closing", "ahead", "behind"}
    assert set(perceived_names(in_cells)) == read
    grid = whole_grid(in_cells)
    assert (grid.number, grid.sizes, set(grid)) == (FIRST_POINTS, None, read)
    assert identify(in_cells, recordings, draw_prior(in_cells, 1, 2, 0), 0) is None


def test_predictions_are_those_of_the_program(in_cells, recordings):
    rounds = recordings.select_people(recordings.people[:2]).select_rounds([0, 1])
    draws = draw_prior(in_cells, 2, 6, 1)
    draws = {name: torch.cat([value, value[:2]]) for name, value in draws.items()}  # some twice
    expected = Sequential(in_cells, rounds).predict(draws)
    found = predict_rounds(in_cells, rounds, draws)
    torch.testing.assert_close(found[:, rounds.mask], expected[:, rounds.mask], rtol=0, atol=1e-4)


def test_the_planner_predicts_as_the_program_does(in_cells, recordings):
    one = recordings.select_people(recordings.people[:1]).select_rounds([0])
    draws = draw_prior(in_cells, 1, 8, 2)
    expected = Sequential(in_cells, one).predict(draws)[:, 0, 0]  # [S, T, A]
    person = Person(in_cells, draws)
    assert person.percept_count == 8
    observation = {name: value[0, 0] for name, value in one.observation().items()}
    past = RoundSoFar.begin(in_cells.domain, {n: value[0] for n, value in observation.items()})
    silence = torch.zeros(1, sum(len(m.communicated) for m in in_cells.domain.modalities)).bool()
    for step in range(4):
        found = predicted_choices(PlanningContext.of(person, past), silence)[:, 0]
        torch.testing.assert_close(found, expected[:, step].exp(), rtol=0, atol=1e-4)
        told = {m.name: torch.zeros(len(m.items)).bool() for m in in_cells.domain.modalities}
        following = {name: value[step + 1] for name, value in observation.items()}
        past = past.then(told, one.actions[0, 0, step], following)


def test_planners_infer_whom_messages_reach_beside_points(in_cells, recordings):
    one = recordings.select_people(recordings.people[:1]).select_rounds([0])
    person = HearingPerson(in_cells, draw_prior(in_cells, 1, 8, 2), 0.5)
    assert set(person.percepts) >= {"ahead", "behind", "hears_visual"}
    told = {name: torch.ones_like(mask[0, 0, 0]) for name, mask in one.told.items()}
    observation = {name: value[0, 0] for name, value in one.observation().items()}
    past = RoundSoFar.begin(in_cells.domain, {n: value[0] for n, value in observation.items()})
    past = past.then(told, one.actions[0, 0, 0], {n: value[1] for n, value in observation.items()})
    after = person.after(past)
    for site in ("ahead", "behind"):  # learned from recordings alone
        assert torch.equal(after.draws[site], person.draws[site])
    assert after.log_hears.isfinite().all()
    assert not torch.allclose(after.log_hears.softmax(-1), person.log_hears.softmax(-1))


@pytest.mark.parametrize("beyond", [1, 2, 6, 20, 200])
def test_few_of_the_first_points_suffice(beyond, toy, played):
    """Sites of twelve numbers, of which so many of the first points explain the rounds."""
    human = Rare(toy.self_model)
    first = whole_grid(human)["far"].sum(-1) / math.sqrt(12)
    human.beyond = float(first.double().sort().values[-beyond] - 1e-6)
    found = infer(human, played, InferenceOptions("importance", 200), 0)
    edges = [-math.inf, *(CUTS - CUTS[3] + human.beyond).tolist(), math.inf]
    prior = torch.tensor(stats.norm.cdf(edges)).diff()
    exact = float((prior * likelihoods(toy, played)).sum().log())
    error = float(found.evidence_error[0])
    assert error < 0.15
    assert abs(float(found.log_evidence[0]) - exact) < 4 * error
    assert float(found.pareto_k[0]) < 0.7


@pytest.mark.parametrize("spread", [1.0, 0.1, 0.03])
@torch.no_grad()
def test_first_points_are_drawn_from_the_density_that_divides_them(spread, toy):
    """Their mean weight, the prior's density relative to it, is 1."""

    class Narrow(Able):
        def prior(self):
            implants = self.rates()
            far = dist.Normal(2 * implants["in_sight"] - 1, spread)
            return implants | {"far": pyro.sample("far", far)}

    human = Narrow(toy.self_model)
    others = {n: v for n, v in draw_prior(human, 1, 400, 7).items() if n != "far"}
    weights = log_priors(human, whole_grid(human), others, 1)[:, 0].exp().sum(-1)  # [S]
    assert abs(float(weights.mean()) - 1) < 4 * float(weights.std()) / 20


class Shared(Far):
    """A site above what is seen and above another site stays out of the points."""

    def prior(self):
        mood = pyro.sample("mood", dist.Normal(0.0, 1.0))
        other = pyro.sample("other", dist.Normal(mood, 1.0))
        far = pyro.sample("far", dist.Normal(0.1 * mood, 1.0))
        return self.rates() | {"far": far, "other": other}

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        return torch.log_softmax(found + 0 * implants["other"][..., None], -1)


def test_sites_above_others_too_are_no_points(toy, played):
    human = Shared(toy.self_model)
    assert set(whole_grid(human)) == {"far"}
    found = infer(human, played, InferenceOptions("importance", 20), 0)
    assert found.draws["mood"].shape == (20, 1, 1)


class ReadsConsistency(HumanModel):
    """Perception reads what ``act`` reads."""

    def sees(self, implants, observation, step):
        assert implants["consistency"].isfinite().all()
        return super().sees(implants, observation, step)


class Above(Far):
    """Another site depends on a continuous one that perception reads."""

    def prior(self):
        implants = super().prior()
        return implants | {"mood": pyro.sample("mood", dist.Normal(implants["far"], 1.0))}

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        return torch.log_softmax(found + 0 * implants["mood"][..., None], -1)


class Distracted(HumanModel):
    """Attention without spans, and a continuous site."""

    def prior(self):
        return super().prior() | {"far": pyro.sample("far", dist.Normal(0.0, 1.0))}

    def round_latents(self, implants):
        return {"away": pyro.sample("away", dist.Bernoulli(torch.tensor(0.2)))}

    def sees(self, implants, observation, step):
        here = (implants["away"] == 0) & (implants["far"] > -1)
        seen = super().sees(implants, observation, step)
        return {name: mask & here[..., None] for name, mask in seen.items()}


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (ReadsConsistency, r"act\(\) reads a site that perceive\(\) reads, too \(consistency\)"),
        (Distracted, "round_latents has no spans: declare them"),
    ],
)
def test_what_cannot_be_inferred_is_refused_before_any_work(kind, message, self_model):
    with pytest.raises(HumanModelError, match=message):
        check_contract(kind(self_model))


def test_sites_that_depend_on_what_is_seen_are_refused(toy, played):
    human = Above(toy.self_model)
    with pytest.raises(HumanModelError, match='the prior of "mood" depends on a site'):
        infer(human, played, InferenceOptions("importance", 5), 0)


@pytest.mark.parametrize("engine", ["svi", "nuts"])
def test_gradients_are_refused(engine, toy, played):
    with pytest.raises(HumanModelError, match="the continuous far: what is seen has no gradient"):
        infer(Far(toy.self_model), played, InferenceOptions(engine, 5), 0)


def test_the_network_is_refused(toy):
    with pytest.raises(HumanModelError, match="which the network cannot learn"):
        train_guide(Far(toy.self_model), GuideOptions(people=10), 0)


def test_points_that_were_not_compiled_are_refused(toy):
    grid = whole_grid(Far(toy.self_model))
    known = {"far": grid["far"][[3, 5]]}
    assert grid.place_of(known).tolist() == [3, 5]
    with pytest.raises(HumanModelError, match="values of far are none of the points"):
        grid.place_of({"far": torch.tensor([0.123])})


def test_rates_of_the_toy_are_not_points(toy):
    assert set(whole_grid(Far(toy.self_model))) == {"far"}
    assert set(whole_grid(Scaled(toy.self_model))) == {"spread", "far"}
    assert set(PriorPoints.of(Able(toy.self_model)).given) == set(RATES)


def test_a_fit_and_its_planner_work(recordings):
    rounds = recordings.select_people(["person-02"]).select_rounds([0, 1])
    human = f"{EXAMPLES}/sight_in_cells.py:SightInCells"
    fit = mirror_ppl.infer(rounds, human=human, draws=32, train_rounds=1, explore=0)
    assert {"ahead", "behind"} <= set(fit.person("person-02").implants.index)
    for picture, message in (("sight", "no picture sight"), ("identifiability", "continuous")):
        with pytest.raises(InputError, match=message):
            getattr(fit.plot, picture)()
    planner = mirror_ppl.Communicator(fit, "person-02", draws=16)
    observed = {name: value[0, 0, 0] for name, value in rounds.observation().items()}
    decision = planner.plan(RoundSoFar.begin(fit.human.domain, observed))
    assert len(decision.flags) == sum(len(m.communicated) for m in fit.human.domain.modalities)


def test_the_vector_of_the_page_is_fitted_and_named(recordings, capsys):
    text = (DOCS / "extending.md").read_text()
    block = next(b for b in text.split("```python")[1:] if "class SightByDirection" in b)
    source = (EXAMPLES / "sight_in_cells.py").read_text() + block.split("```")[0]
    exec(compile(source, "page", "exec"), spoken := {"__name__": "page"})
    rounds = recordings.select_people(["person-02"]).select_rounds([0, 1])
    human = spoken["SightByDirection"]
    fit = mirror_ppl.infer(rounds, human=human, draws=16, train_rounds=1, explore=0)
    assert fit.data["posterior"]["log_reach"].shape == (1, 16, 1, 4)
    assert fit.summary["several_numbers"] == {"log_reach": [4]}
    show_fit(fit.summary, "cells")
    assert "of several numbers are in posterior.nc alone: log_reach (4)" in capsys.readouterr().out
