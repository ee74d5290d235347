"""What a user writes counts in every engine, or is refused with the reason."""

import pyro
import pyro.distributions as dist
import pytest
import torch
from few_reaches import robot_of_few_reaches

from mirror_ppl import load_recordings
from mirror_ppl.domains.bomb_defusal.human import BombDefusalHuman
from mirror_ppl.domains.bomb_defusal.human_variants import BombDefusalNoImplants
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.calibration.study import CalibrationOptions, calibrate
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.sampler import Sampler
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.likelihood.compiled import compile
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models import HumanModel
from mirror_ppl.models.dependencies import dependencies
from mirror_ppl.models.human import has_own_program
from mirror_ppl.models.variants import PerItem
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate


@pytest.fixture(scope="module")
def self_model():
    return load_self_model(shipped_weights("driving"))[0]


@pytest.fixture(scope="module")
def few_reaches():
    return robot_of_few_reaches()


class Blind(HumanModel):
    """Known to see nothing ahead, whatever they did."""

    def prior(self):
        implants = super().prior()
        pyro.factor("blind", -500.0 * (implants["sight_front_own"] != 0))
        return implants


class Gaze(HumanModel):
    """Watched by an eye tracker whose log density is in the thousands."""

    def prior(self):
        implants = super().prior()
        reading = dist.Normal(implants["sight_front_own"].float(), 0.01)
        pyro.sample("gaze", reading, obs=torch.tensor(0.5))
        return implants


PRUNED = SVIOptions(steps=30, prune_every=10, prune_margin=2)


@pytest.mark.parametrize(
    ("number", "options"),
    [
        (20, InferenceOptions("importance", 50)),
        (20, InferenceOptions("svi", 50, PRUNED)),
        (4, InferenceOptions("svi", 50, PRUNED, screening=None)),
    ],
)
@pytest.mark.parametrize(("kind", "bins"), [(Blind, {0}), (Gaze, {0, 1})])
def test_what_the_prior_says_of_sight_outweighs_rounds(kind, bins, number, options, few_reaches):
    rounds = load_recordings().select_people(["person-01"]).select_rounds(range(number))
    drawn = infer(kind(few_reaches), rounds, options, 0).draws["sight_front_own"]
    assert set(drawn.flatten().tolist()) <= bins


def test_people_are_not_drawn_from_a_prior_that_is_more_than_it_samples(self_model):
    options = CalibrationOptions(people=1, rounds=(1,))
    with pytest.raises(HumanModelError, match='"blind" of Blind.prior is a factor, observed'):
        calibrate(Blind(self_model), lambda rounds, seed: None, options, "fog", 0)


class Assigns(HumanModel):
    """Reads sight in ``act`` and a lapse in ``prior``, by assignment to parts of tensors."""

    def prior(self):
        implants = super().prior()
        probabilities = torch.full((*implants["lapse"].shape, 2), 0.5)
        probabilities[..., 1] = implants["lapse"]
        return implants | {"dozes": pyro.sample("dozes", dist.Categorical(probabilities))}

    def act(self, implants, belief, values):
        logits = super().act(implants, belief, values).clone()
        logits[..., 0] = logits[..., 0] + implants["sight_front_own"]
        return torch.log_softmax(logits, -1)


def test_dependencies_are_found_where_provenance_is_lost(self_model):
    found = dependencies(Assigns(self_model))
    assert "sight_front_own" in found.actions
    assert "lapse" in found.prior["dozes"]


class Whispers(HumanModel):
    def perceive(self, implants, knowledge, observation, told, step):
        pyro.factor(f"whisper_{step}", torch.tensor(-1.0))
        return super().perceive(implants, knowledge, observation, told, step)


def test_sites_in_perceive_are_refused(self_model):
    with pytest.raises(HumanModelError, match=r'site "whisper_0", which engines would leave out'):
        check_contract(Whispers(self_model))


@pytest.mark.parametrize("name", ["infer", "belief_after"])
def test_what_is_made_of_believe_is_not_overridden(name):
    with pytest.raises(HumanModelError, match=r"override believe\(\) instead"):
        type("Mine", (HumanModel,), {name: lambda self, *given: None})


def test_a_program_of_one_object_is_a_program_of_its_own(self_model):
    human = HumanModel(self_model)
    assert not has_own_program(human)
    object.__setattr__(human, "model", lambda rounds, world=False: None)
    assert has_own_program(human)


class ReadsClock(BombDefusalNoImplants):
    """Its evidence has what the encoder's symbols lack: since when the stage is under way."""

    def evidence(self, view, observation):
        found = super().evidence(view, observation)
        return found + 0.3 * observation["ego"][..., 1:2]


def test_evidence_of_a_user_may_read_the_whole_observation():
    rounds = simulate("bomb_defusal", "labelled", "paper", 1, 1, 100)
    human = ReadsClock(load_self_model(shipped_weights("bomb_defusal"))[0])
    tables = compile(human, rounds)
    torch.manual_seed(0)
    draws = {name: value[:, None] for name, value in _one(human).items()}
    with pyro.poutine.block(), pyro.poutine.trace() as trace:
        pyro.poutine.condition(human.model, data={k: v[0] for k, v in draws.items()})(rounds)
    program = trace.trace.log_prob_sum()
    torch.testing.assert_close(tables.log_joint(draws)[0, 0], program, rtol=0, atol=1e-3)


def _one(human):
    from mirror_ppl.models.prior import draw_prior

    return {name: value[0] for name, value in draw_prior(human, 1, 1, 0).items()}


class Drawing(HumanModel):
    """Samples the site ``own`` from a distribution that tests set."""

    own: dist.Distribution = dist.Normal(0.0, 1.0)
    scale = 1.0

    def prior(self):
        implants = super().prior()
        with pyro.poutine.scale(scale=self.scale):
            return implants | {"own": pyro.sample("own", self.own)}


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (dist.Normal(0.0, 1.0).mask(False), "is of a masked distribution"),
        (dist.Normal(torch.zeros(2), 1.0).mask(False).to_event(1), "is of a masked distribution"),
        (dist.Delta(torch.tensor(0.7)), "is of dist.Delta"),
        (dist.VonMises(0.0, 1.0), "is an angle"),
        (dist.OneHotCategorical(torch.ones(3) / 3), "is discrete with event shape (3,)"),
        (dist.Categorical(torch.ones(2, 3)).to_event(1), "is discrete with event shape (2,)"),
        (
            dist.MixtureSameFamily(
                dist.Categorical(torch.ones(2)), dist.Normal(torch.zeros(2), 1.0)
            ),
            "cannot be transformed to the whole line",
        ),
    ],
)
def test_distributions_that_engines_cannot_treat_are_refused(self_model, own, message):
    human = Drawing(self_model)
    human.own = own
    with pytest.raises(HumanModelError, match=message.replace("(", r"\(").replace(")", r"\)")):
        check_contract(human)


@pytest.mark.filterwarnings("ignore::mirror_ppl.errors.UnreadSite")
def test_a_scaled_discrete_site_is_drawn_by_importance_alone(self_model):
    human, rounds = Drawing(self_model), load_recordings().select_people([0]).select_rounds([0])
    human.own, human.scale = dist.Categorical(torch.ones(3) / 3), 0.3
    for engine in ("svi", "nuts"):
        with pytest.raises(HumanModelError, match='scales "own".*use importance'):
            infer(human, rounds, InferenceOptions(engine, 4), 0)


@pytest.mark.filterwarnings("ignore::mirror_ppl.errors.UnreadSite")
def test_sites_of_several_numbers_keep_their_precision(self_model):
    """Eight significant bits cannot represent 1000 with a standard deviation of .5."""
    human, nobody = Drawing(self_model), load_recordings().select_people([0]).select_rounds([])
    human.own = dist.Normal(torch.tensor([500.0, 1000.0]), 0.5).to_event(1)
    draws = infer(human, nobody, InferenceOptions("importance", 400), 0).draws["own"][:, 0, 0]
    # Standard errors of 400 independent draws: .025 of the mean, .018 of the standard deviation.
    torch.testing.assert_close(draws.mean(0), torch.tensor([500.0, 1000.0]), rtol=0, atol=0.13)
    torch.testing.assert_close(draws.std(0), torch.tensor([0.5, 0.5]), rtol=0, atol=0.09)


class Torn(HumanModel):
    """Cannot have done what was recorded."""

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        return torch.where(torch.arange(2) == 0, 0.0, -torch.inf).expand_as(found)


@pytest.mark.filterwarnings("ignore::mirror_ppl.errors.UnreadSite")
def test_recorded_actions_without_probability_are_reported(self_model):
    rounds = load_recordings().select_people([0]).select_rounds([0, 1])
    with pytest.raises(HumanModelError, match="recorded actions have probability 0"):
        infer(Torn(self_model), rounds, InferenceOptions("importance", 20), 0)


class Strict(HumanModel):
    """Never does what is less probable than one in seven."""

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        return found.masked_fill(found < -2, -torch.inf).log_softmax(-1)


def test_what_recorded_actions_rule_out_under_some_policies_is_kept(self_model):
    """Under others it may be the most probable; what they rule out in each case has no weight."""
    rounds = load_recordings().select_people([0]).select_rounds([0, 1])
    human = Strict(self_model)
    found = infer(human, rounds, InferenceOptions("importance", 50), 0)
    assert (found.pareto_k < 0.7).all()
    assert compile(human, rounds).log_joint(found.draws).isfinite().all()
    plain = infer(human, rounds, InferenceOptions("importance", 50, screening=None), 0)
    # The same draws; steps are merged on a grid of .03 nats.
    torch.testing.assert_close(found.log_evidence, plain.log_evidence, rtol=0, atol=0.01)


def test_what_is_impossible_under_some_policies_is_not_dropped(self_model):
    human = Strict(self_model)
    rounds = load_recordings().select_people([0]).select_rounds([0, 1])
    builder = ViewTableBuilder(human, Screening(margin=1, early=0))
    builder.add(rounds_of(rounds, 0))
    impossible = builder.score.isneginf().any(0).nonzero().flatten()
    assert len(impossible) > 0 and len(builder.alive) < builder.score.shape[1]
    assert torch.isin(impossible, builder.alive).all()
    sampler = Sampler(human, builder.table())
    sampler.draw(64)
    before = sampler.weighted().log_joint.isneginf().any(0)
    sampler.prune(1.0)
    after = sampler.weighted().log_joint.isneginf().any(0)
    assert len(after) < len(before) and 0 < before.sum() == after.sum()


class StrictItems(Strict, PerItem):
    """With values of attention that are sampled."""


class StrictDefuser(BombDefusalHuman):
    """Never does what is very improbable, with attention that is summed out exactly."""

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        return found.masked_fill(found < -6, -torch.inf).log_softmax(-1)


def test_impossible_actions_are_sampled_with_attention(self_model):
    """Combinations that are impossible whatever they attend to have no expected counts."""
    rounds = load_recordings().select_people([0]).select_rounds(range(8))
    found = infer(StrictItems(self_model), rounds, InferenceOptions("importance", 20), 0)
    assert (found.pareto_k < 0.7).all()


def test_impossible_actions_are_summed_out_with_attention():
    human = StrictDefuser(load_self_model(shipped_weights("bomb_defusal"))[0])
    rounds = load_recordings(domain="bomb_defusal").select_people([0]).select_rounds([0, 1, 2])
    found, plain = (
        infer(human, rounds, InferenceOptions("importance", 50, screening=screening), 0)
        for screening in (Screening(), None)
    )
    assert compile(human, rounds).log_joint(found.draws).isfinite().all()
    builder = ViewTableBuilder(human, Screening(margin=0, early=0))
    builder.add(rounds_of(rounds, 0))
    impossible = builder.score.isneginf().any(0).nonzero().flatten()
    assert len(impossible) and torch.isin(impossible, builder.alive).all()
    error = (found.evidence_error**2 + plain.evidence_error**2).sqrt()  # each has its own draws
    assert (found.log_evidence - plain.log_evidence).abs() < 5 * error


class Impossible(HumanModel):
    """A factor that no draw of the prior satisfies."""

    def prior(self):
        found = super().prior()
        pyro.factor("steady", torch.where(found["consistency"] > 1000, 0.0, -torch.inf))
        return found


def test_factors_without_probability_are_reported(self_model):
    rounds = load_recordings().select_people([1]).select_rounds([0])
    with pytest.raises(HumanModelError, match=r"^person-02: factors or observed sites .* prior"):
        infer(Impossible(self_model), rounds, InferenceOptions("importance", 20), 0)


class Hard(HumanModel):
    """Two numbers, of which the first must be the smaller one."""

    def prior(self):
        low, high = (pyro.sample(name, dist.Normal(0.0, 1.0)) for name in ("low", "high"))
        pyro.factor("ordered", torch.where(low < high, 0.0, -torch.inf))
        return super().prior() | {"low": low, "high": high}


def test_a_guide_that_leaves_the_prior_s_support_is_refused(self_model):
    rounds = load_recordings().select_people([0]).select_rounds([0])
    options = InferenceOptions("svi", 20, SVIOptions(steps=60))
    with pytest.raises(HumanModelError, match="the negative ELBO is inf at step"):
        infer(Hard(self_model), rounds, options, 0)


class Moody(HumanModel):
    """Lapses more with one switch set, which may be changed between fits."""

    reads = False

    def act(self, implants, belief, values):
        found = super().act(implants, belief, values)
        if self.reads:
            flat = torch.full_like(found, -torch.log(torch.tensor(float(found.shape[-1]))).item())
            found = torch.where((implants["sight_front_own"] > 3)[..., None], found, flat)
        return found


def test_a_model_that_was_changed_is_looked_at_again(self_model):
    human = Moody(self_model)
    check_contract(human)
    before = dependencies(human)
    human.reads = True
    check_contract(human)
    assert dependencies(human) != before
    with pytest.raises(HumanModelError, match="reads a site that perceive"):
        infer(human, load_recordings().select_rounds([0]), InferenceOptions("importance", 4), 0)


def test_what_is_deterministic_adds_nothing_to_the_evidence(self_model):
    class Noted(HumanModel):
        def prior(self):
            implants = super().prior()
            pyro.deterministic("doubled", 2 * implants["consistency"])
            return implants

    rounds = load_recordings().select_people([0]).select_rounds([0])
    evidence = [
        infer(kind(self_model), rounds, InferenceOptions("importance", 4), 0).log_evidence
        for kind in (HumanModel, Noted)
    ]
    assert torch.equal(*evidence) and evidence[0].isfinite().all()


def test_a_sequential_plate_and_other_knowledge_are_refused(self_model):
    class Sequential(HumanModel):
        def prior(self):
            implants = super().prior()
            for number in pyro.plate("items", 2):
                pyro.sample(f"item_{number}", dist.Normal(0.0, 1.0))
            return implants

    class Tuple(HumanModel):
        def perceive(self, implants, knowledge, observation, told, step):
            view, _ = super().perceive(
                implants, self.domain.nothing_known(2), observation, told, step
            )
            return view, (1,)

    for kind, message in ((Sequential, 'sequential plate "items"'), (Tuple, "returned tuple as")):
        with pytest.raises(HumanModelError, match=message):
            check_contract(kind(self_model))
