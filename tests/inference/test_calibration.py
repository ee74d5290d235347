"""Calibration of posteriors that are known exactly, or were made wrong on purpose."""

import re
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
import xarray as xr
from exact import log_joint
from scipy.stats import beta, chi2, chisquare
from torch import nn

from mirror_ppl.domains import get_domain
from mirror_ppl.errors import HumanModelError, UnknownNameError
from mirror_ppl.inference.calibration import study as calibration
from mirror_ppl.inference.calibration.study import (
    CalibrationOptions,
    Inferred,
    calibrate,
    prior_people,
)
from mirror_ppl.likelihood.enumeration import draw_combinations
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models import HumanModel, View
from mirror_ppl.models.implants import policy_implants
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.toy import ToyHuman
from mirror_ppl.models.variants import VARIANTS
from mirror_ppl.models.weights import load_self_model, shipped_weights

DRIVING = get_domain("driving")
RARELY = 1e-5
"""Failure rate of what a test may not get wrong, whatever the seed."""
STYLES = torch.tensor([0.2, 0.5, 0.8])
STYLE_PRIOR = torch.tensor([0.2, 0.3, 0.5])
HASTE = torch.tensor([0.1, 0.7])


class Blank(nn.Module):
    """A self-model that knows nothing."""

    domain, latent = DRIVING, 1

    def __init__(self):
        super().__init__()
        self.nothing = nn.Parameter(torch.zeros(1))

    def action_values(self, belief):
        return belief.new_zeros(*belief.shape[:-1], 2)


class Coins(HumanModel):
    """A person who drives by throwing three coins in turn, so that the posterior is known.

    One coin has any rate, one is of three kinds, and one of two. A belief is the number of steps.
    """

    def prior(self):
        return {
            "rate": pyro.sample("rate", dist.Beta(2.0, 2.0)),
            "style": pyro.sample("style", dist.Categorical(STYLE_PRIOR)),
            "hasty": pyro.sample("hasty", dist.Bernoulli(0.3)),
            "weights": pyro.sample("weights", dist.Normal(torch.zeros(3), 1.0).to_event(1)),
        }

    def perceive(self, implants, knowledge, observation, told, step):
        return View({}), knowledge

    def evidence(self, view, observation):
        return torch.zeros(*observation["ego"].shape[:-1], 0)

    def believe(self, belief, evidence, action, still=None):
        return belief + 1

    def act(self, implants, belief, values):
        rate, style, hasty = (implants[site] for site in ("rate", "style", "hasty"))
        coins = torch.stack(torch.broadcast_tensors(rate, STYLES[style], HASTE[hasty.long()]), -1)
        turn = (belief[..., 0].long() - 1) % 3  # [..., P, B]
        switch = coins.expand(*turn.shape, 3).gather(-1, turn[..., None]).squeeze(-1)
        return torch.stack([1 - switch, switch], -1).log()


SUMMARIES = {
    "first weight": lambda draws: draws["weights"][..., 0],
    "heavy": lambda draws: draws["weights"].sum(-1) > 0,
}


def coin_posterior(recordings, seed, power=1.0, draws=99):
    """Exact draws; of another ``power`` than 1, as if all had been seen that many times."""
    rng = np.random.default_rng(seed)
    did = recordings.actions.numpy()
    people = len(did)
    counts = np.stack(
        [[(did[..., turn::3] == action).sum((1, 2)) for action in (0, 1)] for turn in range(3)]
    )
    stay, switch = power * counts.transpose(1, 0, 2)

    def drawn(prior, switching, turn):
        log = np.log(prior)[:, None] + np.log(switching)[:, None] * switch[turn]
        log = log + np.log(1 - switching)[:, None] * stay[turn]
        share = np.exp(log - log.max(0))
        below = share.cumsum(0) / share.sum(0)
        return (rng.random((draws, 1, people)) > below).sum(1)

    values = {
        "rate": rng.beta(2 + switch[0], 2 + stay[0], (draws, people)),
        "style": drawn(STYLE_PRIOR.numpy(), STYLES.numpy(), 1),
        "hasty": drawn(np.array([0.7, 0.3]), HASTE.numpy(), 2),
        "weights": rng.normal(size=(draws, people, 3)),
    }
    return Inferred({name: torch.as_tensor(value)[:, :, None] for name, value in values.items()})


@pytest.fixture(scope="module")
def coins():
    return Coins(Blank())


def test_exact_posteriors_of_coins_are_right(coins, seed):
    options = CalibrationOptions(people=400, rounds=(1, 4), batch=150, summaries=SUMMARIES)
    result = calibrate(coins, coin_posterior, options, "fog", seed)
    assert replace(result, failure_rate=RARELY).rejected == []
    assert (result.people, result.draws) == (400, 99)
    assert result.data["site"].values.tolist() == ["rate", "style", "hasty", *SUMMARIES]
    assert dict(zip(result.data["site"].values, result.data["discrete"].values, strict=True)) == {
        "rate": 0, "style": 1, "hasty": 1, "first weight": 0, "heavy": 1,
    }  # fmt: skip
    table = result.table().set_index(["site", "rounds"])
    for site in ("rate", "style", "hasty"):
        assert table.loc[(site, 4), "contraction"] > table.loc[(site, 1), "contraction"] > 0
    assert table.loc[("first weight", 4), "contraction"] == pytest.approx(0, abs=0.1)
    assert table.loc[("hasty", 4), "prior_probability"] == pytest.approx(0.58, abs=0.03)
    assert np.isnan(table["high_pareto_k"]).all()
    assert result.data.attrs["human_model"] == "Coins"
    assert (result.data.attrs["setting"], result.data.attrs["seed"]) == ("fog", str(seed))


def test_overconfident_posteriors_of_coins_are_found(coins, seed):
    """As if everything had been seen ten times."""
    options = CalibrationOptions(people=400, rounds=(1,), batch=400)
    result = calibrate(
        coins, lambda rounds, own: coin_posterior(rounds, own, 10.0), options, "fog", seed
    )
    assert result.rejected == [("rate", 1), ("style", 1), ("hasty", 1)]
    assert (result.coverage.sel(level=0.5) < 0.5).all()


def test_the_prior_is_calibrated_and_not_sharp(coins, seed):
    options = CalibrationOptions(people=400, rounds=(1,), batch=400)
    result = calibrate(
        coins, lambda rounds, own: coin_posterior(rounds, own, 0.0), options, "fog", seed
    )
    assert replace(result, failure_rate=RARELY).rejected == []
    np.testing.assert_allclose(result.table()["contraction"], 0, atol=0.1)


def test_shorter_recordings_begin_the_longer_ones_of_the_same_people(coins, seed):
    options = CalibrationOptions(people=5, rounds=(1, 3), batch=3)
    seen = {}

    def infer(recordings, own):
        seen.setdefault(recordings.shape[1], []).append(recordings)
        seen.setdefault("seeds", []).append(own)
        return coin_posterior(recordings, own, power=float(power), draws=4)

    before = torch.get_rng_state()
    power = 1
    first = calibrate(coins, infer, options, "clear", seed)
    for short, long in zip(seen[1], seen[3], strict=True):
        assert short.equals(long.select_rounds([0]))
    assert [part.num_people for part in seen[3]] == [3, 2]
    assert len(set(seen["seeds"])) == 4
    xr.testing.assert_identical(first.data, calibrate(coins, infer, options, "clear", seed).data)
    power = 2
    other = calibrate(coins, infer, options, "clear", seed)
    np.testing.assert_array_equal(first.data["truth"], other.data["truth"])
    assert (first.data["rank"] != other.data["rank"]).any()
    assert seen[3][0].equals(seen[3][-2])
    anew = calibrate(coins, infer, options, "clear", seed + 1)
    assert (first.data["truth"] != anew.data["truth"]).any()
    assert torch.equal(before, torch.get_rng_state())


def test_people_follow_the_prior_however_many_at_once(coins, generator, monkeypatch):
    monkeypatch.setattr(calibration, "PEOPLE_AT_ONCE", 700)
    drawn = prior_people(coins, 2000, generator)
    assert {name: tuple(value.shape) for name, value in drawn.items()} == {
        "rate": (2000, 1), "style": (2000, 1), "weights": (2000, 1, 3), "hasty": (2000, 1),
    }  # fmt: skip
    assert len(drawn["rate"].unique()) > 1990  # nobody is drawn twice
    counts = torch.bincount(drawn["style"].flatten(), minlength=3).numpy()
    assert chisquare(counts, 2000 * STYLE_PRIOR.double().numpy() / 1.0).pvalue > RARELY
    cells = np.histogram(beta(2, 2).cdf(drawn["rate"].flatten().numpy()), 20, (0, 1))[0]
    assert chisquare(cells).pvalue > RARELY
    # All sites are given to play_rounds: their coins come up as they should.
    did = play_rounds(coins, drawn, 1, "fog", generator).actions[:, 0, 2::3].double().mean(-1)
    expected = HASTE[drawn["hasty"].long()].flatten().double()
    errors = (did - expected) / (expected * (1 - expected) / 5).sqrt()
    assert chi2.sf(float((errors**2).sum()), 2000) > RARELY / 100
    assert chi2.cdf(float((errors**2).sum()), 2000) > RARELY / 100


def changed(**parts):
    """An ``infer`` that returns something else in place of these draws; nothing for None."""

    def infer(recordings, own):
        draws = {**coin_posterior(recordings, own, draws=6).draws, **parts}
        return Inferred({name: value for name, value in draws.items() if value is not None})

    return infer


NAN = torch.full((6, 2, 1), 0.5, dtype=torch.double).index_fill(0, torch.tensor(3), torch.nan)
SHAPE = "has shape (6, 2), expected (6, 2, 1)"


@pytest.mark.parametrize(
    ("infer", "summaries", "message"),
    [
        (changed(style=None), {}, "infer() of 1 rounds: there are no draws of 'style'"),
        (changed(hasty=None), {}, "infer() of 1 rounds: there are no draws of 'hasty'"),
        (changed(weights=None), SUMMARIES, "infer() of 1 rounds: there are no draws of 'weights'"),
        (changed(rate=NAN), {}, "infer() of 1 rounds: rate has values that are not finite numbers"),
        (changed(style=torch.zeros(6, 2)), {}, f"infer() of 1 rounds: style {SHAPE}"),
        (changed(hasty=torch.zeros(5, 2, 1)), {}, "hasty has shape (5, 2, 1), expected (6, 2, 1)"),
        (lambda *_: Inferred({}), {}, "infer() of 1 rounds: there are no draws of 'rate'"),
        (
            lambda rounds, own: coin_posterior(rounds, own, draws=0),
            {},
            "expected as many draws of each site, and some, not [0]",
        ),
        (
            lambda rounds, own: coin_posterior(rounds, own, draws=int(rounds.round_counts[0])),
            {},
            "expected as many draws every time, not [1, 2]",
        ),
        (coin_posterior, {"rate": SUMMARIES["heavy"]}, 'the summary "rate" has the name of a site'),
        (
            coin_posterior,
            {"weight": lambda draws: draws["weights"]},
            "the prior: weight has shape (4000, 1, 3), expected (4000, 1)",
        ),
    ],
)
def test_what_infer_and_summaries_may_not_return(coins, infer, summaries, message):
    options = CalibrationOptions(people=2, rounds=(1, 2), summaries=summaries)
    with pytest.raises(ValueError, match=re.escape(message)):
        calibrate(coins, infer, options, "fog", 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"people": 0}, "people must be at least 1, not 0"),
        ({"batch": 0}, "batch must be at least 1, not 0"),
        ({"rounds": ()}, "rounds must be positive and increase, not ()"),
        ({"rounds": (0, 1)}, "rounds must be positive and increase, not (0, 1)"),
        ({"rounds": (5, 1)}, "rounds must be positive and increase, not (5, 1)"),
        ({"rounds": (5, 5)}, "rounds must be positive and increase, not (5, 5)"),
    ],
)
def test_impossible_options(options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        CalibrationOptions(**options)


def test_nobody_and_nowhere(coins, generator, monkeypatch):
    with pytest.raises(ValueError, match="people must be at least 1, not 0"):
        prior_people(coins, 0, generator)
    monkeypatch.setattr(calibration, "play_rounds", None)  # calling it would fail otherwise
    with pytest.raises(UnknownNameError, match='unknown setting "night"'):
        calibrate(coins, coin_posterior, CalibrationOptions(), "night", 0)


def test_pareto_k_is_counted_where_there_are_weights(coins):
    k = {1: torch.tensor([0.1, 0.71, torch.inf, torch.nan, 0.7]), 2: None}

    def infer(recordings, own):
        drawn = coin_posterior(recordings, own)
        return replace(drawn, pareto_k=k[recordings.shape[1]])

    options = CalibrationOptions(people=5, rounds=(1, 2))
    table = calibrate(coins, infer, options, "fog", 0).table().set_index(["site", "rounds"])
    assert (
        table.loc[("rate", 1), "high_pareto_k"] == table.loc[("style", 1), "high_pareto_k"] == 0.6
    )
    assert np.isnan(table.loc[("rate", 2), "high_pareto_k"])


def test_the_package_s_own_human_model_runs(seed):
    """Exact draws, but ways to decide are chosen by weight among 16 of the prior."""
    human = HumanModel(load_self_model(shipped_weights("driving"))[0])

    def infer(recordings, own):
        torch.manual_seed(own)
        person = torch.arange(recordings.num_people)
        table = build_view_table(human, recordings, screening=Screening())
        with pyro.plate("way", 16, dim=-3), pyro.plate("all", 1, dim=-2):
            ways = policy_implants(DRIVING, human.self_model.latent, torch.zeros(()))

        def way(number):
            return {name: value[number] for name, value in ways.items()}

        weights = torch.stack([log_joint(human, table, way(number)) for number in range(16)])
        chosen = dist.Categorical(logits=weights.logsumexp(-1).T).sample((8,))  # [S, P]
        draws = []
        for one in chosen:
            policy = {name: value[:, 0] for name, value in way(one).items()}
            sights = draw_combinations(human, table, weights[one, person], 1)
            draws.append(policy | {name: value[0] for name, value in sights.items()})
        return Inferred({name: torch.stack([one[name] for one in draws]) for name in draws[0]})

    options = CalibrationOptions(people=2, rounds=(1, 2))
    with torch.random.fork_rng():
        result = calibrate(human, infer, options, "fog", seed)
    assert result.data.sizes == {"site": 8, "rounds": 2, "person": 2}
    assert result.data["discrete"].values.tolist() == [1, 1, 1, 1, 1, 1, 0, 0]
    table = result.table()
    assert table["p_value"].between(0, 1).all()
    assert table["contraction"].between(-1, 1).all()


class Watched(ToyHuman):
    def act(self, implants, belief, values):
        pyro.sample("gaze", dist.Normal(implants["in_sight"], 0.5), obs=torch.tensor(1.0))
        return super().act(implants, belief, values)


class Moody(VARIANTS["per-item"]):
    spans = VARIANTS["per-item"].spans

    def round_latents(self, implants):
        pyro.factor("mood", implants["consistency"])
        return super().round_latents(implants)


@pytest.mark.parametrize(("kind", "method"), [(Watched, "act"), (Moody, "round_latents")])
def test_people_who_cannot_be_drawn_are_refused(kind, method):
    human = kind(load_self_model(shipped_weights("driving"))[0])
    options = CalibrationOptions(people=2, rounds=(1,), batch=2)
    with pytest.raises(HumanModelError, match=f"{kind.__name__}.{method} has a factor"):
        calibrate(human, lambda rounds, seed: None, options, "fog", 0)
    human.likelihood_power = 0.5
    with pytest.raises(HumanModelError, match="likelihood_power is 0.5.*set it to 1 to calibrate"):
        calibrate(human, lambda rounds, seed: None, options, "fog", 0)
