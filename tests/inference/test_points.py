"""Points: models whose perception reads continuous sites, against exact and slower answers."""

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from paths import DOCS, EXAMPLES
from pyro import poutine
from scipy import integrate, stats
from torch.distributions import constraints

import mirror_ppl
from mirror_ppl.communication.objectives import predicted_choices
from mirror_ppl.communication.person import Person, PlanningContext
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.evaluation.fit_report import show_fit
from mirror_ppl.inference import point_proposals
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.inference.point_proposals import Coordinates, Kernels, Whitening
from mirror_ppl.inference.results.identifiability import identify
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.inference.weighted import tempered
from mirror_ppl.likelihood.combinations import log_priors, needs_points, perceived_names
from mirror_ppl.likelihood.compiled import Sequential
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.grid import Grid
from mirror_ppl.likelihood.points import FIRST_POINTS, PriorPoints, whole_grid
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import RATES, ToyHuman, toy_posterior
from mirror_ppl.training.guide import GuideOptions, train_guide

SHARES = torch.tensor([0.97, 0.02, 0.006, 0.002, 0.001, 0.0007, 0.0003], dtype=torch.double)
"""Prior probabilities of reaches: of 8,192 points, 8 have that of the recorded person."""
CUTS = torch.tensor(stats.norm.ppf(SHARES.cumsum(0)[:-1]))
TRUE = {"reach": torch.tensor([[4]]), "in_sight": torch.tensor([[0.9]])}


class Far(ToyHuman):
    """The toy, whose reach is an interval of a continuous site."""

    def rates(self):
        with poutine.block(hide=["reach"]):
            return {name: value for name, value in super().prior().items() if name != "reach"}

    def prior(self):
        return self.rates() | {"far": pyro.sample("far", dist.Normal(0.0, 1.0))}

    def place(self, implants):
        return implants["far"]

    def perceive(self, implants, knowledge, observation, told, step):
        reach = {"reach": torch.bucketize(self.place(implants).double(), CUTS)}
        return super().perceive(reach, knowledge, observation, told, step)


class Vector(Far):
    """The reach depends on the sum of twelve numbers."""

    def prior(self):
        return self.rates() | {
            "far": pyro.sample("far", dist.Normal(torch.zeros(12), 1.0).to_event(1))
        }

    def place(self, implants):
        return implants["far"].sum(-1) / math.sqrt(12)


class Glasses(Far):
    """Without glasses a person sees nothing."""

    def prior(self):
        return super().prior() | {
            "glasses": pyro.sample("glasses", dist.Categorical(torch.tensor([0.7, 0.3])))
        }

    def place(self, implants):
        return torch.where(implants["glasses"] > 0, implants["far"], -9.0)


class Scaled(Far):
    """The spread of people is inferred, too; nothing else reads it."""

    def prior(self):
        spread = pyro.sample("spread", dist.LogNormal(-0.5, 0.5))
        return self.rates() | {"far": pyro.sample("far", dist.Normal(0.0, spread))}


class Able(Far):
    """Who acts well sees far: the reach depends on a site that ``act`` reads."""

    def prior(self):
        implants = self.rates()
        far = dist.Normal(2 * implants["in_sight"] - 1, 1.0)
        return implants | {"far": pyro.sample("far", far)}


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
    # Points are fewer than draws: the error of a share is that of 1 / error² independent ones.
    expected = joint / joint.sum()
    tolerance = 4 * (expected * (1 - expected)).sqrt() * error + 0.02
    assert ((often - expected).abs() < tolerance).all()
    assert float(found.pareto_k[0]) < 0.7
    in_sight = own["in_sight"].mean()
    exact = (toy_posterior(toy, played).rates["in_sight"][0] @ torch.tensor([1.0, 0]).double()) / (
        toy_posterior(toy, played).rates["in_sight"][0].sum(-1)
    )
    if kind is not Able:
        assert abs(float(in_sight) - float(expected @ exact)) < 4 * error * 0.2 + 0.01


def test_without_new_points_the_error_is_large(toy, played, monkeypatch):
    """And is said to be large: the first points hardly contain such a person."""
    monkeypatch.setattr(point_proposals, "STAGES", 0)
    found = infer(Vector(toy.self_model), played, InferenceOptions("importance", 50), 0)
    assert float(found.evidence_error[0]) > 0.2


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
    assert ((often - joint / joint.sum()).abs() < 0.15).all()
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


class Rare(Vector):
    """Far reaches are as rare as the instance says."""

    beyond = 0.0

    def place(self, implants):
        return super().place(implants) - self.beyond + CUTS[3]


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
    assert abs(float(found.log_evidence[0]) - exact) < 4 * error + 0.05
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
    assert abs(float(weights.mean()) - 1) < 4 * float(weights.std()) / 20 + 0.01


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


class Mixed(Far):
    """Sites of several kinds and supports."""

    def prior(self):
        one = torch.ones(3)
        return self.rates() | {
            "far": pyro.sample("far", dist.Normal(0.0, 1.0)),
            "share": pyro.sample("share", dist.Beta(2.0, 1.0)),
            "mix": pyro.sample("mix", dist.Dirichlet(one)),
            "kind": pyro.sample("kind", dist.Categorical(one / 3)),
        }

    def place(self, implants):
        seen = implants["share"] + implants["mix"][..., 0] + implants["kind"]
        return implants["far"] + 0.1 * seen


@torch.no_grad()
def test_kernels_are_a_density(toy):
    """Importance weights average to one, and give the prior's moments."""
    human = Mixed(toy.self_model)
    prior = PriorPoints.of(human)
    points = prior.draw(2000, 0)
    whitening = Whitening.of(Coordinates.of(human, points), points)
    likely = torch.softmax(-((points["far"].double() - 1) ** 2) * 8 - 4 * points["share"], 0)
    kernels = Kernels.around(whitening, points, torch.arange(2000), likely)
    number = 20_000
    drawn = kernels.draw(number)
    assert ((drawn["far"] - 1).abs() < 1).double().mean() > 0.8
    others = torch.arange(2000, 2000 + number)
    assert constraints.simplex.check(drawn["mix"]).all()
    weights = (prior.log_density(drawn).double() - kernels.log_density(drawn, others)).exp()
    near = ((drawn["far"] - 1).abs() < 0.5).double() * (drawn["share"] < 0.5)
    expected = (stats.norm.cdf(1.5) - stats.norm.cdf(0.5)) * 0.25  # Beta(2, 1) below .5
    found = weights * near
    error = float(found.std()) / math.sqrt(number)
    assert error < 0.1 * expected
    assert abs(float(found.mean()) - expected) < 4 * error


@torch.no_grad()
def test_points_at_a_boundary_are_none_of_the_kernels(toy):
    human = Mixed(toy.self_model)
    points = PriorPoints.of(human).draw(100, 0)
    points["mix"][7] = torch.tensor([0.0, 0.5, 0.5])
    whitening = Whitening.of(Coordinates.of(human, points), points)
    assert whitening.factor.isfinite().all()
    numbers, likely = torch.arange(100), torch.full((100,), 0.01).double()
    kernels = Kernels.around(whitening, points, numbers, likely)
    assert len(kernels.numbers) == 99 and kernels.spread.isfinite().all()
    found = kernels.log_density(points, numbers)
    assert (found == -math.inf).nonzero().flatten().tolist() == [7]


@torch.no_grad()
def test_points_do_not_count_their_own_kernels(toy):
    human = Far(toy.self_model)
    points = PriorPoints.of(human).draw(50, 0)
    whitening = Whitening.of(Coordinates.of(human, points), points)
    likely = torch.softmax(-8 * points["far"].double().abs(), 0)
    own = torch.arange(50)
    kernels = Kernels.around(whitening, points, own, likely)
    some = Grid({site: value[:1] for site, value in points.items()})
    without = own[1:]
    others = Kernels(
        whitening,
        points.chosen(without),
        without,
        kernels.log_weights[1:].log_softmax(0),
        kernels.directions,
        kernels.centres[1:],
        kernels.spread,
    )
    as_another = torch.tensor([99])
    found = kernels.log_density(some, own[:1])
    assert float(found) == pytest.approx(float(others.log_density(some, as_another)), abs=1e-9)
    assert float(kernels.log_density(some, as_another)) != pytest.approx(float(found), abs=1e-3)


@torch.no_grad()
def test_nothing_is_left_of_a_single_kernel_at_its_point(toy):
    points = PriorPoints.of(Vector(toy.self_model)).draw(50, 0)
    whitening = Whitening.of(Coordinates.of(Vector(toy.self_model), points), points)
    one, number = points.chosen(torch.tensor([3])), torch.tensor([3])
    kernels = Kernels.around(whitening, one, number, torch.ones(1).double())
    assert kernels.log_density(one, number).tolist() == [-math.inf]
    assert kernels.log_density(one, number + 1).isfinite().all()


def test_probabilities_are_tempered_as_far_as_needed():
    found = tempered(torch.tensor([0.0, -10, -20, -30]), 3.0)
    assert float(1 / found.exp().square().sum()) == pytest.approx(3, abs=1e-3)
    even = torch.full((4,), math.log(1 / 4))
    torch.testing.assert_close(tempered(even, 2.0), even)


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
