"""People who notice things at some time in a round, and what they do, by hand."""

import pyro
import pyro.distributions as dist
import torch
from example_course import gone_through
from paths import EXAMPLES

from mirror_ppl.domains import get_domain
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.models.implants import first_success, noticed_sites, policy_implants
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.variants import PerItem

DRIVING = get_domain("driving")
STEPS = DRIVING.horizon
NOTICED = noticed_sites(DRIVING)
NOTICES = tuple(site.replace("noticed_", "notices_") for site in NOTICED)


class OneItem(PerItem):
    """Notices the first car at some time, and never the others: attention can be enumerated."""

    def prior(self):
        like = next(self.self_model.parameters())
        known = {NOTICES[0]: pyro.sample(NOTICES[0], dist.Beta(1.0, 1.0))}
        return known | policy_implants(self.domain, self.self_model.latent, like)

    def round_latents(self, implants):
        first = NOTICED[0]
        return {first: pyro.sample(first, first_success(implants[NOTICES[0]], STEPS))}

    def sees(self, implants, observation, step):
        never = dict.fromkeys(NOTICED, torch.tensor(STEPS))
        return super().sees({**never, NOTICED[0]: implants[NOTICED[0]]}, observation, step)


class Fixed(OneItem):
    """Notices the first car at some time, and chooses with a known consistency and lapse."""

    def prior(self):
        known = {"consistency": torch.tensor(4.0), "lapse": torch.tensor(0.02)}
        return known | {NOTICES[0]: pyro.sample(NOTICES[0], dist.Beta(1.0, 1.0))}


def drawn(human, number, people=1, seed=0):
    """Draws ``[S, P, 1, ...]`` of all sites."""
    return draw_prior(human, people, number, seed)


def geometric(probability):
    """Probabilities of each number of failures, by hand."""
    probabilities = [probability * (1 - probability) ** n for n in range(STEPS)]
    return torch.tensor([*probabilities, (1 - probability) ** STEPS])


def by_hand(human, implants, recordings, person, number):
    """Log-probabilities ``[16, T, A]`` of actions for each time at which the car is noticed."""
    observation, told, actions, _ = vars(
        rounds_of(recordings, person).at(number, number + 1)
    ).values()
    when = {NOTICED[0]: torch.arange(STEPS + 1)}
    belief = gone_through(human, when, observation, told, actions)
    values = human.self_model.action_values(belief)
    own = {name: value[person : person + 1] for name, value in implants.items()}
    each = human.act(own, belief.flatten(0, 1)[None], values.flatten(0, 1)[None])
    return each[0].unflatten(0, belief.shape[:2])


def example(self_model):
    path = EXAMPLES / "distracted.py"
    return load_human_model(f"{path}:DistractedPerson", self_model)
