"""People of whom little is unknown, rounds of several lengths, and their likelihoods by hand."""

from dataclasses import fields

import pyro
import pyro.distributions as dist
import torch
from example_course import gone_through

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models import HumanModel, View
from mirror_ppl.models.implants import assumption_sites, policy_implants, sight_sites

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon
SIGHTS, ASSUMED = sight_sites(DRIVING), assumption_sites(DRIVING)
LENGTHS = [[15, 4], [], [7, 1]]
"""Lengths of the rounds of three people."""


class Few(HumanModel):
    """A person with unknown sight ahead in their lane, and unknown assumptions.

    Of cars that they saw once, they assume that these come closer; of others it is open.
    """

    KNOWN = {
        "sight_front_other": 2,
        "sight_back_own": 0,
        "sight_back_other": 0,
        "assumes_closing": 1,
    }

    def prior(self):
        bins = torch.arange(1.0, len(self.domain.reach_bins) + 1)
        own = {
            "sight_front_own": pyro.sample("sight_front_own", dist.Categorical(bins / bins.sum())),
            "assumes_clear": pyro.sample(
                "assumes_clear", dist.Categorical(torch.tensor([0.3, 0.7]))
            ),
        }
        like = next(self.self_model.parameters())
        return own | policy_implants(self.domain, self.self_model.latent, like)

    def perceive(self, implants, knowledge, observation, told, step):
        known = {
            site: torch.full_like(implants["sight_front_own"], value)
            for site, value in self.KNOWN.items()
        }
        own = {site: implants[site] for site in ("sight_front_own", "assumes_clear")}
        return super().perceive(known | own, knowledge, observation, told, step)


class Sure(Few):
    """A person of whom only the policy is unknown."""

    def prior(self):
        like = next(self.self_model.parameters())
        return policy_implants(self.domain, self.self_model.latent, like)

    def perceive(self, implants, knowledge, observation, told, step):
        return View(self.domain.visibility("fog", observation)), knowledge


def ragged(recordings, lengths):
    """Rounds of these lengths, ``lengths[person][round]``, with some messages.

    What stands in the padding of the arrays is what was recorded there.
    """
    most = max(1, *map(len, lengths))
    some = recordings.select_people(range(len(lengths))).select_rounds(range(most))
    variables = some.variables()
    generator = torch.Generator().manual_seed(2)
    for name in ("told_visual", "told_verbal"):
        shape = variables[name].shape
        variables[name] = torch.rand(shape, generator=generator) < 0.1
    variables["round_count"] = torch.tensor([len(rounds) for rounds in lengths])
    padded = [[*rounds, *[0] * (most - len(rounds))] for rounds in lengths]
    variables["length"] = torch.tensor(padded)
    return Demonstrations.from_variables(some.domain, some.setting, some.people, variables)


def policies(human, number, people):
    """Draws ``[S, P, 1, ...]`` of the policy implants from the prior."""
    plates = pyro.plate("draw", number, dim=-3), pyro.plate("person", people, dim=-2)
    with plates[0], plates[1]:
        return policy_implants(DRIVING, human.self_model.latent, torch.zeros(()))


def log_likelihoods_by_hand(human, rounds, person, number, values, policy):
    """Log-likelihoods of one round ``[M]``, each combination by itself, step by step.

    Args:
        values: the discrete implants ``[M]`` by name.
        policy: the others, ``[1, 1, ...]``.
    """
    steps = int(rounds.lengths[person, number])
    observation = {
        name: value[person, number, :steps][None] for name, value in rounds.observation().items()
    }
    told = {name: value[person, number, :steps][None] for name, value in rounds.told.items()}
    actions = rounds.actions[person, number, :steps][None]
    result = []
    for one in range(len(next(iter(values.values())))):
        implants = {site: value[one : one + 1] for site, value in values.items()}
        belief = gone_through(human, implants, observation, told, actions)
        chosen = human.act(policy, belief, human.action_values(belief))
        result.append(chosen[0].gather(-1, actions[0, :, None]).sum())
    return torch.stack(result)


def assert_tables_equal(one, other, tolerance=0.0):
    for field in fields(one):
        left, right = getattr(one, field.name), getattr(other, field.name)
        if isinstance(left, torch.Tensor):
            torch.testing.assert_close(left, right, rtol=0.0, atol=tolerance)
        else:
            assert left == right, field.name


def assert_rounds_equal(one, other):
    """Each combination has the same rounds in both tables, however their views are numbered."""

    def rounds_of_combinations(table):
        people = torch.arange(len(table.index))[:, None, None]
        moments = table.moments[people, table.index.clamp(min=0)]  # [P, B, M, T]
        real = (moments != NO_VIEW) & (table.index != NO_VIEW)[..., None]
        place = people[..., None], moments.clamp(min=0)
        belief, values = (part[place] * real[..., None] for part in (table.belief, table.values))
        return real, belief, values, table.acted[place] * real, table.recorded, table.steps

    assert (one.sites, one.sizes) == (other.sites, other.sizes)
    assert torch.equal(one.index == NO_VIEW, other.index == NO_VIEW)
    assert torch.equal(one.view_counts, other.view_counts)
    assert one.belief.shape == other.belief.shape and one.moments.shape == other.moments.shape
    parts = zip(rounds_of_combinations(one), rounds_of_combinations(other), strict=True)
    for mine, theirs in parts:
        torch.testing.assert_close(mine, theirs, rtol=0.0, atol=1e-4)
