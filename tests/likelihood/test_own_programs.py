"""Human models that override the program itself, and what runs as it stands or is compiled."""

import math
from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_person import self_model
from example_programs import PROGRAMS
from pyro.infer import SVI, Trace_ELBO
from pyro.infer.autoguide import AutoNormal
from test_one_program import recordings

import mirror_ppl
from benchmarks.one_program import exact_mean, own_program, toy
from mirror_ppl import face
from mirror_ppl.communication.person import Person
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.inference import batches, engines
from mirror_ppl.inference.engines import InferenceOptions, infer, run_identity
from mirror_ppl.inference.nuts import NUTSOptions
from mirror_ppl.inference.results import fitting
from mirror_ppl.inference.results.fitting import fit_people
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.likelihood.compiled import Sequential, ViewTables, compile
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.training.guide import GuideOptions, train_guide
from mirror_ppl.training.guide_file import network_for

__all__ = ["recordings"]


class Kept(ToyHuman):
    """Keeps the implants for what a program adds."""

    def prior(self):
        self.implants = super().prior()
        return self.implants


class Asked(Kept):
    """The factor of `benchmarks.one_program.toy`, added by the program and not by its prior."""

    def model(self, rounds, world=False):
        super().model(rounds, world)
        with pyro.plate("people", rounds.num_people, dim=-2):
            pyro.factor("more", 20 * torch.log(self.implants["in_sight"]))


@pytest.mark.parametrize("kind", PROGRAMS)
def test_tables_say_what_the_program_says(kind, recordings):
    """Density of draws of all sites, and predictions of every action."""
    human = kind(self_model())
    draws = draw_prior(human, 1, 4, 3)
    tables, program = compile(human, recordings), Sequential(human, recordings)
    assert isinstance(tables, ViewTables)
    # Values that stand for all there could be are all there are.
    torch.testing.assert_close(tables.log_joint(draws), program.log_joint(draws), rtol=0, atol=1e-4)
    found, expected = (compiled.predict(draws) for compiled in (tables, program))
    real = recordings.mask
    torch.testing.assert_close(found[:, real], expected[:, real], rtol=0, atol=1e-4)


def test_rounds_can_be_added(recordings):
    human = PROGRAMS[-1](self_model())
    draws = draw_prior(human, 1, 3, 0)
    first, second = (recordings.select_rounds([number]) for number in (0, 1))
    compiled = compile(human, first, growing=True)
    compiled.add(second)
    whole = compile(human, recordings.select_rounds([0, 1]))
    torch.testing.assert_close(compiled.log_joint(draws), whole.log_joint(draws))
    with pytest.raises(InputError, match="compiled with growing=True"):
        whole.add(second)


@pytest.mark.parametrize("engine", ["svi", "nuts"])
def test_the_program_of_a_user_is_run(engine, recordings):
    if engine == "svi":
        options = InferenceOptions(engine, 60, SVIOptions(steps=80))
    else:
        options = InferenceOptions(engine, 40, NUTSOptions(20, 4))
    found = infer(Asked(self_model()), recordings, options, 0).draws["in_sight"].flatten()
    # Draws of a chain depend on each other: as many as a third of them count. Without the factor
    # the mean is .37 instead of .86, and a standard deviation is .08.
    error = 0.03 if engine == "svi" else 4 * float(found.std()) / math.sqrt(40 / 3)
    assert abs(found.mean() - exact_mean("factor", recordings, self_model())) < error


def test_pyro_infers_it_too(recordings):
    """Pyro's own SVI infers a rate of a model without discrete sites."""

    class Sighted(ToyHuman):
        def prior(self):
            implants = {"reach": torch.zeros(1, 1, dtype=torch.long)}
            rate = dist.Beta(2.0, 2.0)
            return implants | {name: pyro.sample(name, rate) for name in ("in_sight", "otherwise")}

    human = Sighted(self_model())
    with pyro.get_param_store().scope():
        pyro.set_rng_seed(0)
        guide = AutoNormal(human.model)
        svi = SVI(
            human.model,
            guide,
            pyro.optim.Adam({"lr": 0.1}),
            Trace_ELBO(2, vectorize_particles=False),
        )
        for _ in range(80):
            svi.step(recordings)
        found = guide.median()["otherwise"].item()
    real = recordings.mask
    ones, steps = int((recordings.actions[real] == 1).sum()), int(real.sum())
    _, distance = human.domain.distance(
        {name: value[:, :, :-1] for name, value in recordings.observation().items()}
    )
    bins = torch.tensor(human.domain.reach_bins)
    far = (distance.amin(-1) > bins[0]) & real
    ones, steps = int((recordings.actions[far] == 1).sum()), int(far.sum())
    assert steps > 3
    assert found == pytest.approx((2 + ones) / (4 + steps), abs=0.06)


def test_it_is_fitted_and_predicted(recordings):
    rounds = recordings.select_rounds([0, 1])
    options = InferenceOptions("svi", 20, SVIOptions(steps=5))
    fit = fit_people(Asked(self_model()), rounds, options, seed=1, train_rounds=1)
    assert set(fit.data.posterior.data_vars) >= {"reach", "in_sight", "otherwise"}
    twin = toy("factor", self_model())
    expected = predict_rounds(twin, rounds, fit.posterior.draws)
    found = predict_rounds(Asked(self_model()), rounds, fit.posterior.draws)
    real = rounds.mask
    torch.testing.assert_close(found[:, real], expected[:, real], rtol=0, atol=1e-4)


@pytest.mark.parametrize("engine", ["importance", "amortized"])
def test_engines_that_compile_refuse_it(engine, recordings):
    with pytest.raises(HumanModelError, match=f"cannot be inferred by the engine {engine}; the"):
        infer(Asked(self_model()), recordings, InferenceOptions(engine, 10), 0)


def test_there_is_no_network_of_it():
    human = Asked(self_model())
    with pytest.raises(HumanModelError, match="overrides model.* and cannot be compiled"):
        network_for("amortized", None, human)
    with pytest.raises(HumanModelError, match="overrides model.* and cannot be compiled"):
        train_guide(human, GuideOptions(), 0)
    assert network_for("auto", None, human) is None


def test_scales_that_pyro_cannot_sum_out_are_refused(recordings):
    human = own_program("scale", self_model())
    with pytest.raises(HumanModelError, match="Own scales .* discrete sites.*use importance"):
        infer(human, recordings, InferenceOptions("svi", 5), 0)


def test_what_needs_the_methods_refuses_it(recordings):
    human = Asked(self_model())
    draws = draw_prior(human, 1, 2, 0)
    with pytest.raises(HumanModelError, match="overrides model.* and cannot be planned with"):
        Person(human, draws)
    with pytest.raises(HumanModelError, match="cannot be simulated in the true world"):
        one = {name: value[0] for name, value in draws.items()}
        play_rounds(human, one, 1, "fog", torch.Generator().manual_seed(0))


class NoActions(ToyHuman):
    def model(self, rounds, world=False):
        with pyro.plate("person", rounds.num_people, dim=-2):
            self.prior()


class More(Asked):
    def model(self, rounds, world=False):
        super().model(rounds, world)
        with pyro.plate("others", rounds.num_people, dim=-2):
            pyro.sample("mood", dist.Normal(0.0, 1.0))


class Tied(Kept):
    """People who are alike, whoever they are."""

    def model(self, rounds, world=False):
        super().model(rounds, world)
        rate = self.implants["in_sight"]
        pyro.factor("tied", -500.0 * (rate - rate.mean()).square().sum())


def two_people(recordings):
    """Twice the same rounds."""
    twice = {
        name: value.repeat(2, *(1,) * (value.dim() - 1))
        for name, value in recordings.variables().items()
    }
    return recordings._like(twice, ["a", "b"])


def test_what_ties_people_together_is_of_nobody_alone(recordings, monkeypatch):
    two = two_people(recordings.select_rounds([0]))
    found = infer(Tied(self_model()), two, InferenceOptions("nuts", 8, NUTSOptions(8, 4)), 0)
    first, second = found.draws["in_sight"].squeeze(-1).T
    # .19 without the factor, with which their difference has the standard deviation .045.
    assert (first - second).abs().mean() < 0.1
    compiled = compile(Tied(self_model()), two)
    assert compiled.joint == ["tied"]
    with pytest.raises(HumanModelError, match='Tied.model has "tied" outside of a plate of people'):
        compiled.log_joint(draw_prior(compiled.human, 2, 3, 0))
    monkeypatch.setattr(batches, "PEOPLE_AT_ONCE", 1)
    with pytest.raises(HumanModelError, match='ties people together by "tied": infer at most 1 pe'):
        infer(Tied(self_model()), two, InferenceOptions("svi", 4, SVIOptions(steps=1)), 0)


def test_measured_sites_are_observed_by_a_program_of_ones_own(recordings):
    measured = replace(recordings, measurements={"in_sight": torch.tensor([0.9])})
    found = infer(Asked(self_model()), measured, InferenceOptions("svi", 9, SVIOptions(steps=5)), 0)
    assert found.draws["in_sight"].flatten().tolist() == pytest.approx([0.9] * 9)
    assert len(found.draws["otherwise"].unique()) > 1


class Less(ToyHuman):
    def model(self, rounds, world=False):
        del rounds, world


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (NoActions, r'NoActions.model has no observed site "action_0"'),
        (More, r'More.model samples "mood" outside of prior\(\)'),
        (Less, r"Less.model does not sample reach, in_sight, otherwise of prior\(\)"),
    ],
)
@pytest.mark.parametrize("engine", ["svi", "nuts"])
def test_what_is_wrong_with_it_is_said(kind, message, engine, recordings):
    with pytest.raises(HumanModelError, match=message):
        infer(kind(self_model()), recordings, InferenceOptions(engine, 10), 0)


def test_the_former_name_of_importance(recordings):
    with pytest.warns(FutureWarning, match='"exact" is called "importance" now') as told:
        assert InferenceOptions("exact").engine == "importance"
        with pytest.raises(InputError, match="explore"):
            mirror_ppl.infer(recordings, engine="exact", explore=-1)
    assert [one.filename for one in told] == [__file__] * 2  # of whoever gave it


def test_runs_of_one_that_needs_more_than_made_up_rounds_are_distinguished():
    class Particular(ToyHuman):
        def model(self, rounds, world=False):
            raise RuntimeError("of nobody but the recorded")

    human = Particular(self_model())
    assert run_identity(human, None, ["x"]) != run_identity(human, None, ["y"])


def test_runs_are_distinguished_by_what_a_program_uses_elsewhere():
    weight = 1.0

    class Leaning(ToyHuman):
        def model(self, rounds, world=False):
            super().model(rounds, world)
            pyro.factor("elsewhere", torch.tensor(weight))

    human = Leaning(self_model())
    before = run_identity(human, None, [])
    weight = 2.0
    assert run_identity(human, None, []) != before


def test_a_model_is_tried_once_a_fit(recordings, monkeypatch):
    tried = []
    for module in (face, fitting, engines):
        monkeypatch.setattr(module, "check_contract", tried.append)
    human = ToyHuman(self_model())
    mirror_ppl.infer(recordings, human=human, draws=5, train_rounds=1, explore=0)
    assert tried == [human]


class Slips(ToyHuman):
    """Whether a person slips is drawn anew at each step."""

    def choose(self, implants, belief, values, action=None):
        slips = pyro.sample("slips", dist.Bernoulli(torch.tensor(0.3)))
        chosen = self.act(implants, belief, values)
        chosen = torch.where(slips[..., None] > 0, torch.full_like(chosen, -math.log(2)), chosen)
        return pyro.sample("action", dist.Categorical(logits=chosen), obs=action)


def test_latents_of_a_step_count_in_its_prediction(recordings):
    human = Slips(self_model())
    draws = draw_prior(human, 1, 3, 3)
    found = Sequential(human, recordings).predict(draws).exp()
    torch.testing.assert_close(found.sum(-1), torch.ones(found.shape[:-1]), rtol=0, atol=1e-5)
    plain = Sequential(ToyHuman(self_model()), recordings).predict(draws).exp()
    torch.testing.assert_close(found, 0.3 / 2 + 0.7 * plain, rtol=0, atol=1e-5)


class Named(ToyHuman):
    """A factor whose name says what it is about."""

    def prior(self):
        found = super().prior()
        pyro.factor("actions", -found["otherwise"])
        return found


@pytest.mark.parametrize("engine", ["importance", "svi"])
def test_names_of_factors_are_free(engine, recordings):
    settings = SVIOptions(steps=3) if engine == "svi" else None
    options = InferenceOptions(engine, 5, settings)
    assert infer(Named(self_model()), recordings, options, 0).draws["otherwise"].isfinite().all()
