"""The program run forward is the simulator: in the domain's own world, and step by step.

Thresholds are those of so many tests at once: none fails by chance but in one of a thousand runs.
"""

from functools import cache

import pytest
import torch
from pyro import poutine
from scipy.stats import chi2, norm

from benchmarks.forward_run import WORLDS as FORWARD_WORLDS
from benchmarks.forward_run import counts, run_forward
from mirror_ppl.models import simulation
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights

SIZES = {"driving": (2000, 15), "search_rescue": (1000, 10), "bomb_defusal": (1000, 10)}
"""People and steps; in driving with fewer of them, consistency off by half is not noticed."""
ERROR = 1e-3
WORLDS = [*FORWARD_WORLDS, ("bomb_defusal", "unlabelled", "mirror")]


@cache
def self_model(world):
    return load_self_model(shipped_weights(world))[0]


def people_of(human, seed):
    """Implants of all people, who are drawn from the prior."""
    return {
        name: value[0]
        for name, value in draw_prior(human, SIZES[human.domain.name][0], 1, seed).items()
    }


def played(human, setting, seed, monkeypatch):
    """A round of each, and what they attended to in it."""
    monkeypatch.setattr(type(human.domain), "horizon", SIZES[human.domain.name][1])
    latents = {}
    original = simulation._round_latents

    def kept(*arguments):
        latents.update(original(*arguments))
        return latents

    monkeypatch.setattr(simulation, "_round_latents", kept)
    generator = torch.Generator().manual_seed(seed)
    implants = people_of(human, seed)
    return play_rounds(human, implants, 1, setting, generator), {**implants, **latents}


@pytest.mark.parametrize(("world", "setting", "name"), WORLDS)
def test_simulated_actions_have_the_probabilities_of_the_program(world, setting, name, monkeypatch):
    """Given what was recorded before them, at every step."""
    human = load_human_model(name, self_model(world))
    rounds, sites = played(human, setting, 0, monkeypatch)
    with torch.no_grad():
        program = poutine.condition(human.model, data=sites)
        trace = poutine.trace(program).get_trace(rounds)
    limit = norm.isf(ERROR / 2 / (rounds.shape[2] * len(human.domain.actions)))
    surprise, variance = 0.0, 0.0
    for step in range(rounds.shape[2]):
        real = rounds.mask[:, 0, step]
        expected = trace.nodes[f"action_{step}"]["fn"].probs[:, 0][real].double()
        done = torch.nn.functional.one_hot(rounds.actions[:, 0, step][real], expected.shape[-1])
        error = (expected * (1 - expected)).sum(0).sqrt()
        # Normal as long as there are enough of each.
        enough = error > 3
        assert ((done - expected).sum(0).abs() < limit * error)[enough].all(), step
        log = expected.clamp(min=1e-30).log()
        mean = (expected * log).sum(-1)
        surprise += ((done * log).sum(-1) - mean).sum()
        variance += ((expected * log.square()).sum(-1) - mean.square()).sum()
    # And they are as probable as draws from these are, which tells how strictly people choose.
    assert abs(surprise) < limit * variance.sqrt()


@pytest.mark.parametrize(("world", "setting", "name"), FORWARD_WORLDS)
def test_run_forward_in_the_true_world_people_act_as_in_the_simulator(
    world, setting, name, monkeypatch
):
    """At every step; other people in other rounds."""
    ran, simulated = both(world, setting, name, "true world", monkeypatch)
    for one, other in zip(ran, simulated, strict=True):
        assert_same(one, other, len(ran))


def both(world, setting, name, kind, monkeypatch):
    """How often each action was done at each step: run forward, and simulated."""
    human = load_human_model(name, self_model(world))
    simulated, _ = played(human, setting, 0, monkeypatch)
    people = len(simulated.people)
    begins = [human.domain.initial(people, torch.Generator().manual_seed(one)) for one in (1, 0)]
    found, _ = run_forward(human, simulated, begins[0], kind)
    return (
        counts(human, begin, actions)
        for begin, actions in zip(begins, (found, simulated.actions[:, 0]), strict=True)
    )


def assert_same(one, other, tests):
    """Two samples of as many are of the same distribution, by one of so many chi-square tests."""
    both = one + other
    some = both > 10
    statistic = float(((one - other).square() / both)[some].sum())
    assert statistic < chi2.isf(ERROR / tests, int(some.sum()))


@pytest.mark.parametrize(("world", "setting", "name"), FORWARD_WORLDS)
def test_without_a_simulator_rounds_begin_as_in_it(world, setting, name, monkeypatch):
    """At the first step there is what was observed; later the self-model's errors count."""
    one, other = both(world, setting, name, "self-model", monkeypatch)
    assert_same(one[0], other[0], 1)
