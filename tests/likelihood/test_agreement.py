"""Human models of which engines would compute something else than the program are refused."""

from dataclasses import replace
from types import MethodType

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_models import SHIPPED
from pyro import poutine

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.engines import InferenceOptions, infer, run_identity
from mirror_ppl.inference.sampler import Sampler
from mirror_ppl.likelihood.combination_sets import fixed_prior
from mirror_ppl.likelihood.combinations import perceived_sites
from mirror_ppl.likelihood.compiled import compile
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.grid import grid_of
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import build_view_table, rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.user_code import is_of_package

PER_ITEM = VARIANTS["per-item"]


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def rounds():
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return recordings.select_people([0]).select_rounds([0, 1])


@pytest.mark.parametrize(
    ("world", "name"),
    SHIPPED,
)
def test_models_that_ship_agree(world, name):
    human = load_human_model(name, load_self_model(shipped_weights(world))[0])
    assert is_of_package(human) and is_of_package(human.self_model) and is_of_package(human.domain)
    check_contract(human, shipped=True)


def test_models_that_ship_are_not_checked_in_fits(self_model, monkeypatch):
    def check(human):
        raise AssertionError("checked")

    def act(self, *given):
        return HumanModel.act(self, *given)

    class Mine(HumanModel):
        pass

    monkeypatch.setattr("mirror_ppl.likelihood.contract.check_agreement", check)
    human, changed = HumanModel(self_model), HumanModel(self_model)
    check_contract(human)
    changed.act = MethodType(act, changed)
    for other in (Mine(self_model), changed):
        with pytest.raises(HumanModelError, match="checked"):
            check_contract(other)
    monkeypatch.setattr(HumanModel, "believe", act)
    assert not is_of_package(human)


# --- refused ------------------------------------------------------------------------------------


class SumOfPeople(ToyHuman):
    def prior(self):
        implants = super().prior()
        pyro.factor("q", 3 * implants["in_sight"].sum())
        return implants


class SmallSum(ToyHuman):
    def prior(self):
        implants = super().prior()
        pyro.factor("q", 0.001 * implants["in_sight"].sum())
        return implants


class AllOrNobody(ToyHuman):
    def prior(self):
        implants = super().prior()
        if (implants["in_sight"] > 0.3).all():
            pyro.factor("q", implants["in_sight"])
        return implants


class SomebodyInAct(ToyHuman):
    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        return found if bool((implants["in_sight"] < 0.5).all()) else found.flip(-1)


class Wavering(ToyHuman):
    def act(self, implants, belief, values):
        either = 0.1 * torch.randn(()) * torch.tensor([1.0, -1.0])
        return (super().act(implants, belief, values) + either).log_softmax(-1)


class SomebodySeesAll(ToyHuman):
    """If anybody sees far, everybody sees everything."""

    def perceive(self, implants, knowledge, observation, told, step):
        view, knowledge = super().perceive(implants, knowledge, observation, told, step)
        if bool((implants["reach"] > 3).any()):
            view = view.map(torch.ones_like)
        return view, knowledge


class SmallWeights(HumanModel):
    def prior(self):
        implants = super().prior()
        pyro.factor("small", -5 * implants["residual_out"].square().sum())
        return implants


class SumOfPeopleInAct(ToyHuman):
    def act(self, implants, belief, values):
        pyro.factor("q", 3 * implants["in_sight"].sum())
        return super().act(implants, belief, values)


class Clamped(ToyHuman):
    def prior(self):
        implants = super().prior()
        return implants | {"reach": implants["reach"].clamp(max=1)}


class NoticesAtOnce(PER_ITEM):
    def round_latents(self, implants):
        return {name: value * 0 for name, value in super().round_latents(implants).items()}

    spans = PER_ITEM.spans


class Assuming(PER_ITEM):
    """Returns what it did not sample; the program would show it to ``perceive``."""

    def prior(self):
        with poutine.block(hide=["assumes_clear"]):
            return super().prior()


class PlateInAct(ToyHuman):
    def act(self, implants, belief, values):
        with pyro.plate("items", 3):
            pyro.sample("gaze", dist.Normal(implants["in_sight"], 0.5), obs=torch.ones(3, 1, 1))
        return super().act(implants, belief, values)


class PlateInRounds(PER_ITEM):
    def round_latents(self, implants):
        latents = super().round_latents(implants)
        with pyro.plate("questions", 3):
            pyro.sample("said", dist.Normal(implants["consistency"], 0.5), obs=torch.tensor(1.0))
        return latents

    spans = PER_ITEM.spans


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (SumOfPeople, 'the log density of "q" in prior is .* of one person alone and'),
        (SmallSum, 'the log density of "q" in prior is .* of one person alone and'),
        (SmallWeights, 'the log density of "small" in prior is .* of one person alone and'),
        (SumOfPeopleInAct, 'the log density of "q" in act is .* of one person alone and'),
        (AllOrNobody, 'prior has "q" of some people only'),
        (SomebodyInAct, 'the log density of "action" in act is .* of one person alone and'),
        (Wavering, 'act says something else of "action" when it is run again'),
        (SomebodySeesAll, "SomebodySeesAll says something that engines do not see"),
        (Clamped, 'prior returns other values of "reach" than those that it sampled'),
        (NoticesAtOnce, 'round_latents returns other values of "noticed_'),
        (Assuming, 'perceive.. reads "assumes_clear", which is no site'),
        (PlateInAct, '"gaze" is in the plate "items" at dimension -3'),
        (PlateInRounds, '"said" is in the plate "questions" at dimension -3'),
    ],
)
def test_what_is_of_others_or_not_followed_is_refused(kind, message, self_model):
    with pytest.raises(HumanModelError, match=message):
        check_contract(kind(self_model))


def test_sums_of_one_person_are_not_refused(self_model):
    class OwnSum(HumanModel):
        def prior(self):
            implants = super().prior()
            pyro.factor("small", -5 * implants["residual_out"].square().sum((-1, -2)))
            return implants

    check_contract(OwnSum(self_model))


def test_a_method_of_the_instance_counts(self_model):
    human = ToyHuman(self_model)

    def round_latents(self, implants):
        pyro.factor("sleepy", -implants["in_sight"])
        return {"tired": pyro.sample("tired", dist.Bernoulli(implants["in_sight"]))}

    human.round_latents = MethodType(round_latents, human)
    assert human.has_round_latents
    check_contract(human)


@pytest.mark.parametrize("engine", ["svi", "nuts"])
def test_a_scale_around_all_is_refused(self_model, rounds, engine):
    class Scaled(ToyHuman):
        def model(self, rounds, world=False):
            with poutine.scale(scale=0.2):
                super().model(rounds, world)

    message = f'Scaled scales "[a-z_]+", which is discrete.* as {engine} needs it; use importance'
    with pytest.raises(HumanModelError, match=message):
        infer(Scaled(self_model), rounds, InferenceOptions(engine, 5), 0)


# --- perception ---------------------------------------------------------------------------------


class Deaf(ToyHuman):
    """May not hear what is communicated; looks at that site only where something is."""

    ALONE = False

    def prior(self):
        return super().prior() | {"hears": pyro.sample("hears", dist.Bernoulli(torch.tensor(0.5)))}

    def perceive(self, implants, knowledge, observation, told, step):
        view, knowledge = super().perceive(implants, knowledge, observation, told, step)
        told_now = bool(told["visual"].any()) and not (self.ALONE and bool(told["verbal"].any()))
        if told_now and "hears" in implants:
            hears = (implants["hears"] == 1)[..., None]
            view = type(view)({"visual": view.visible["visual"] | (told["visual"] & hears)})
        return view, knowledge


class RarelyDeaf(Deaf):
    """And only where nothing is said besides, which is not tried before rounds are there."""

    ALONE = True


@torch.no_grad()
def test_what_is_read_only_with_a_message_is_found(self_model, rounds):
    human = Deaf(self_model)
    assert set(perceived_sites(human)) == {"reach", "hears"}
    everything = torch.ones_like(rounds.told["visual"]) & rounds.mask[..., None]
    told = replace(rounds, told={**rounds.told, "visual": everything})
    draws = draw_prior(human, 1, 4, 0)
    found = compile(human, told).log_joint(draws)[:, 0]
    for draw in range(4):
        own = {name: value[draw] for name, value in draws.items()}
        trace = poutine.trace(poutine.condition(human.model, data=own)).get_trace(told)
        torch.testing.assert_close(found[draw], trace.log_prob_sum(), rtol=0, atol=1e-4)


def test_what_is_read_in_some_rounds_only_is_refused(self_model, rounds):
    human = RarelyDeaf(self_model)
    everything = torch.ones_like(rounds.told["visual"]) & rounds.mask[..., None]
    told = replace(rounds, told={**rounds.told, "visual": everything})
    with pytest.raises(HumanModelError, match='perceive.. reads "hears" in some rounds only'):
        compile(human, told)


# --- priors that know more of people than what they sample ----------------------------------------


class LostInPart(ToyHuman):
    """Provenance of ``in_sight`` is lost, that of ``reach`` is not."""

    def prior(self):
        implants = super().prior()
        weight = torch.zeros_like(implants["in_sight"])
        weight[...] = implants["in_sight"]
        pyro.factor("q", 6 * weight * (implants["reach"] > 2))
        return implants


def test_priors_that_depend_on_what_provenance_loses_are_not_fixed(self_model):
    human = LostInPart(self_model)
    assert fixed_prior(human, grid_of(perceived_sites(human))) is None
    check_contract(human)


def answering(at, width):
    """A person whose consistency was measured."""

    class Answering(VARIANTS["perceptual-only"]):
        def prior(self):
            implants = super().prior()
            own = dist.Normal(implants["consistency"].log(), width)
            pyro.sample("answer", own, obs=torch.tensor(at))
            return implants

    return Answering


def test_policies_are_those_whom_the_program_makes_probable(self_model, rounds):
    human = answering(0.5, 0.05)(self_model)
    found = ViewTableBuilder(human, Screening()).policies["consistency"].log()
    assert (found - 0.5).abs().max() < 6 * 0.05
    plain = ViewTableBuilder(VARIANTS["perceptual-only"](self_model), Screening())
    expected = draw_prior(plain.human, 1, Screening.policies, Screening.seed)
    assert torch.equal(plain.policies["consistency"], expected["consistency"])


@torch.no_grad()
def test_nothing_is_given_up_where_no_draw_is_probable(self_model, rounds):
    human = answering(-9.0, 0.001)(self_model)
    builder = ViewTableBuilder(human, Screening())
    assert builder.screening is None
    builder.add(rounds_of(rounds, 0))
    assert len(builder.alive) == len(next(iter(builder.grid.values())))
    sampler = Sampler(human, builder.table())
    sampler.draw(64)
    before = len(sampler.combinations.members)
    sampler.prune(0.0)
    assert len(sampler.combinations.members) == before


@torch.no_grad()
def test_what_was_recorded_besides_actions_gives_nothing_up_for_others(self_model, rounds):
    """An observed site of ``act`` may favour one policy under which much is hopeless."""
    base = VARIANTS["perceptual-only"]

    class Tracked(base):
        def act(self, implants, belief, values):
            own = dist.Normal(implants["consistency"].log(), 0.3)
            pyro.sample("tracked", own, obs=torch.tensor(4.0))
            return super().act(implants, belief, values)

    alive = []
    for kind in (base, Tracked):
        builder = ViewTableBuilder(kind(self_model), Screening(margin=3.0))
        builder.add(rounds_of(rounds, 0))
        alive.append(set(builder.alive.tolist()))
    assert alive[0] <= alive[1]
    assert build_view_table(Tracked(self_model), rounds) is not None


# --- whose results may be continued -------------------------------------------------------------

NOTEBOOK = """
class Mine(ToyHuman):
    def prior(self):
        implants = super().prior()
        pyro.factor("q", {} * implants["in_sight"])
        return implants
"""


def test_a_redefined_program_of_a_notebook_is_another_one(self_model):
    found = []
    for weight in ("0.0", "40.0", "0.0"):
        scope = {"ToyHuman": ToyHuman, "pyro": pyro, "__name__": "a_notebook"}
        exec(NOTEBOOK.format(weight), scope)
        found.append(run_identity(scope["Mine"](self_model), None, ["x"]))
    assert found[0] != found[1]
    assert found[0] == found[2]


def test_what_a_program_leans_on_elsewhere_counts(self_model):
    class Leaning(ToyHuman):
        weight = 1.0

        def prior(self):
            implants = super().prior()
            pyro.factor("q", self.weight * implants["in_sight"])
            return implants

    one, other = Leaning(self_model), Leaning(self_model)
    other.weight = 2.0
    assert run_identity(one, None, ["x"]) != run_identity(other, None, ["x"])


def test_a_class_that_was_executed_without_a_module_is_a_users():
    names = {}
    exec("class Mine:\n    def method(self): pass", {"__builtins__": __builtins__}, names)
    made = names["Mine"]()
    assert not is_of_package(made)
