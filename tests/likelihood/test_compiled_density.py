"""The compiled density of recorded rounds is that of the readable program, enumerated by Pyro.

For every human model that ships, in every world, and for whatever Pyro counts in a method of one.
Rounds are short and the worlds' horizons with them, so that every sum is over all there is.
"""

from functools import cache

import pyro
import pyro.distributions as dist
import pytest
import torch
from example_models import SHIPPED
from example_programs import ENUMERATED, PROGRAMS
from few_reaches import robot_of_few_reaches
from pyro import poutine
from pyro.infer import TraceEnum_ELBO, config_enumerate

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.likelihood import combinations, compiled, densities
from mirror_ppl.likelihood.compiled import ViewTables
from mirror_ppl.likelihood.densities import log_correction
from mirror_ppl.likelihood.enumeration import log_joints
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.weights import load_self_model, shipped_weights

STEPS = {"driving": 3, "search_rescue": 3, "bomb_defusal": 4, "highway": 3}
"""Number of steps of the longest round, by world."""
HORIZONS = {("search_rescue", "per-item"): 1, ("bomb_defusal", "per-item"): 2}
"""Where that of the longest round would be too much to go through: nine and six items, each of
which is noticed at one of so many steps or never."""
DRAWS = 2


def near(human):
    """Tolerances; relative where a thousand weights of 32 bits add up to a thousand nats."""
    return {"rtol": 5e-7 if human.domain.name == "highway" else 0, "atol": 1e-4}


@cache
def self_model(world):
    return load_self_model(shipped_weights(world))[0]


few_reaches = cache(robot_of_few_reaches)
"""The robot of driving, with sums of a thirtieth of the parts."""


def short_rounds(world, steps):
    """One person's rounds of arbitrary actions and messages: one ends early, one is padding."""
    domain, generator = get_domain(world), torch.Generator().manual_seed(2)
    actions = torch.randint(len(domain.actions), (3, steps), generator=generator)
    state = domain.initial(3, generator)
    observed = [domain.observe(state)]
    for step in range(steps):
        state = domain.transition(state, actions[:, step])
        observed.append(domain.observe(state))
    seen = {name: torch.stack([one[name] for one in observed], 1) for name in observed[0]}
    told = {
        name: mask[None, :, :steps] & (torch.rand(mask[:, :steps].shape, generator=generator) < 0.2)
        for name, mask in domain.communicable(seen).items()
    }
    return Demonstrations(
        domain=world,
        setting=domain.settings[0],
        people=("somebody",),
        ego=seen.pop("ego")[None],
        observations={name: value[None] for name, value in seen.items()},
        actions=actions[None],
        told=told,
        round_counts=torch.tensor([2]),
        lengths=torch.tensor([[steps, steps - 1, 0]]),
    )


def shipped(world, name, monkeypatch):
    """A human model that ships, and short rounds of its world."""
    human = load_human_model(name, few_reaches() if world == "driving" else self_model(world))
    horizon = HORIZONS.get((world, name), STEPS[world])
    monkeypatch.setattr(type(human.domain), "horizon", horizon)
    return human, short_rounds(world, STEPS[world])


@torch.no_grad()
def assert_compiled(human, rounds, log_density):
    """Given draws of all sites, and of each combination of those that perception reads."""
    table = build_view_table(human, rounds, values=100_000)
    draws = draw_prior(human, 1, DRAWS, 0)
    policy = {name: value for name, value in draws.items() if name not in table.sites}
    grid = table.grid
    given = log_prior(human, policy) + log_correction(human, grid, policy, 1)[:, 0]
    joint = log_joints(human, table, policy)[:, 0] + given[:, None]  # [S, M]
    own = joint[torch.arange(DRAWS), table.combination(draws).flatten()]
    found = ViewTables(human, table).log_joint(draws)[:, 0]
    for draw in range(DRAWS):
        expected = log_density(human, rounds, {name: one[draw] for name, one in draws.items()})
        torch.testing.assert_close(own[draw], expected, **near(human))
        torch.testing.assert_close(found[draw], expected, **near(human))
    return joint[0].logsumexp(-1), {name: one[0] for name, one in policy.items()}


def enumerated(human, rounds, draws):
    """Log density of the program given values ``[1, 1, ...]``; Pyro sums out all other sites."""
    program = config_enumerate(poutine.condition(human.model, data=draws), "parallel")
    elbo = TraceEnum_ELBO(max_plate_nesting=2, strict_enumeration_warning=False)
    return torch.as_tensor(-elbo.loss(program, lambda rounds: None, rounds))


def gone_through(human, rounds, draws):
    """`enumerated`, but by summing over round latents here; TraceEnum has one scale for all."""
    program = config_enumerate(poutine.condition(human.model, data=draws), "parallel")
    with poutine.enum(first_available_dim=-3), poutine.trace() as trace:
        program(rounds)
    trace.trace.compute_log_prob()
    of_person, of_rounds = torch.zeros(1, 1), torch.zeros(1, 3)
    for node in trace.trace.nodes.values():
        plates = {plate.name for plate in node.get("cond_indep_stack", ())}
        if node["type"] == "sample" and "round" in plates:
            of_rounds = of_rounds + node["log_prob"]
        elif node["type"] == "sample" and "person" in plates:
            of_person = of_person + node["log_prob"]
    return of_person.sum() + of_rounds.flatten(0, -2).logsumexp(0).sum()


def log_prior(human, policy):
    """Log density ``[S]`` of values as they are drawn, without scales and masks."""
    total = torch.zeros(DRAWS)
    if not policy:
        return total
    given, draw = poutine.condition(data=policy), pyro.plate("draw", DRAWS, dim=-3)
    with given, draw, poutine.trace() as trace, pyro.plate("person", 1, dim=-2):
        human.prior()
    for name, value in policy.items():
        total = total + trace.trace.nodes[name]["fn"].log_prob(value).view(DRAWS)
    return total


@pytest.mark.parametrize(
    ("world", "name"),
    [one for one in SHIPPED if one[0] != "highway" or one[1] == "mirror"],
)  # of the highway one alone; what other models change is the same in all worlds
def test_the_compiled_density_is_that_of_the_program(world, name, monkeypatch):
    human, rounds = shipped(world, name, monkeypatch)
    total, policy = assert_compiled(human, rounds, enumerated)
    # With everything discrete summed out.
    torch.testing.assert_close(total, enumerated(human, rounds, policy), **near(human))


# --- what Pyro counts in a method --------------------------------------------------------------


def added(human: type[HumanModel], method: str, change: str) -> type[HumanModel]:
    """A human model with a site more in one of its methods, of one kind."""
    chained = "spans" in vars(human)

    def value(arguments, returned):
        if method == "act":
            return returned[..., 0] * arguments[0]["consistency"]
        implants = returned if method == "prior" else arguments[0]
        value = 0.1 + implants["consistency"]
        for site in ("assumes_clear", "reads_type") if method == "prior" else ():
            value = value + implants.get(site, 0.0)
        if method == "round_latents" and not chained:  # in chains it may not depend on these
            value = value + 0.3 * returned["noticed_front-left"]
        return value

    def changed(self, *arguments):
        with poutine.scale(scale=0.4 if change == "scale" else 1.0):
            returned = getattr(human, method)(self, *arguments)
            about = value(arguments, returned)
            if change in ("factor", "scale"):
                pyro.factor("added", -0.5 * about)
            if change == "observed":
                pyro.sample("added", dist.Normal(about, 4.0), obs=torch.tensor(0.4))
            if change == "mask":
                with poutine.mask(mask=about > MASKED[method]):
                    pyro.factor("added", -0.5 * about)
        return returned

    changes = {method: changed}
    if chained:  # what is read when stays as it is
        changes["spans"] = human.spans
    return type(f"{human.__name__}Changed", (human,), changes)


MASKED = {"prior": 3.8, "round_latents": 3.4, "act": -1.0}
"""Below these values what a mask is around does not count."""
CHANGED = pytest.mark.parametrize(
    ("world", "name", "method", "change"),
    [
        (world, name, method, change)
        for world, name in (("driving", "per-item"), ("bomb_defusal", "mirror"))
        for method in ("prior", "round_latents", "act")
        for change in ("factor", "observed", "scale", "mask")
    ],
)


@CHANGED
def test_what_pyro_counts_is_compiled(world, name, method, change, monkeypatch):
    human, rounds = shipped(world, name, monkeypatch)
    human = added(type(human), method, change)(human.self_model)
    assert human.chained == (world == "bomb_defusal")
    assert_compiled(human, rounds, gone_through)


@CHANGED
def test_a_compilation_that_forgets_it_is_noticed(world, name, method, change, monkeypatch):
    original = densities.log_prob

    def forgetful(node):
        if node["name"] != "added":
            return original(node)
        forgotten = {"scale": {"scale": 1.0}, "mask": {"mask": None}}.get(change)
        return 0 * original(node) if forgotten is None else original({**node, **forgotten})

    for module in (densities, combinations, compiled):
        monkeypatch.setattr(module, "log_prob", forgetful)
    with pytest.raises(AssertionError, match="not close"):
        test_what_pyro_counts_is_compiled(world, name, method, change, monkeypatch)


@pytest.mark.parametrize("kind", PROGRAMS)
def test_programs_of_users_are_compiled(kind):
    human, rounds = kind(few_reaches()), short_rounds("driving", 3)
    total, policy = assert_compiled(human, rounds, gone_through)
    if kind in ENUMERATED:
        torch.testing.assert_close(total, enumerated(human, rounds, policy), **near(human))
