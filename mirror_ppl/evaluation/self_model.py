"""Quality of a self-model: its returns, and its agreement with exact planners in any view.

In full view the reference is the exact planner that knows everything. In partial view it is the
exact planner of the world as believed by an observer with that view who remembers everything and
makes every assumption (see `mirror_ppl.training.views`). Where assumptions do not settle the world,
only the return of an observer who assumes nothing is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import Domain, map_state, roll_out, total_reward
from mirror_ppl.domains.world import offers
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.training.experience import Course, drive, experience, follow, supposed
from mirror_ppl.training.views import ViewPlan

CLEAR_DECISION = 0.2
"""Difference of action values, in units of reward, above which a decision counts as clear."""
TIE = 1e-4
"""Difference of action values up to which they count as equal."""


def fixed_views(
    domain: Domain,
    batch: int,
    generator: torch.Generator,
    reach: tuple[float, ...] | None = None,
    speech: bool = False,
) -> ViewPlan:
    """Make one view for B rounds: up to ``reach`` in each direction (everything unless given).

    The observer remembers: what follows from earlier observations counts as visible.

    Args:
        domain: the world.
        batch: number of rounds B.
        generator: source of the numbers that a plan needs; they have no effect here.
        reach: distance for each direction; if given, the observer makes every assumption where
            assumptions settle the world, and none elsewhere.
        speech: True if everything is also communicated.
    """
    farthest = (domain.reach_bins[-1],) * len(domain.directions)
    some = torch.ones(batch, device=generator.device)
    limited = torch.full_like(some, reach is not None, dtype=torch.bool)
    rates = {m.name: some * (m.name == "visual" or speech) for m in domain.modalities}
    return ViewPlan(
        reach=torch.tensor(reach or farthest, device=generator.device).expand(batch, -1),
        keep=rates,
        told={name: torch.zeros_like(some) for name in rates},
        remembers=torch.ones_like(limited),
        assumes=dict.fromkeys(domain.assumptions, limited & domain.settled),
        noise={
            m.name: torch.rand(
                batch,
                domain.horizon + 1,
                len(m.items),
                2,
                generator=generator,
                device=generator.device,
            )
            for m in domain.modalities
        },
    )


def returns(domain: Domain, start: Any, actions: Tensor) -> Tensor:
    """Undiscounted returns ``[B]`` of rounds from ``start`` under ``actions`` ``[B, T]``."""
    states = roll_out(domain, start, actions)
    before = map_state(lambda part: part[:, :-1], states)
    after = map_state(lambda part: part[:, 1:], states)
    return total_reward(domain.rewards(before, actions, after)).sum(1)


def planner_actions(domain: Domain, start: Any, steps: int, discount: float) -> Tensor:
    """Actions ``[B, T]`` of the exact planner that knows everything."""
    state, actions = start, []
    for _ in range(steps):
        actions.append(domain.reference_values(state, discount).argmax(-1))
        state = domain.transition(state, actions[-1])
    return torch.stack(actions, 1)


@torch.no_grad()
def self_model_quality(
    self_model: SelfModel,
    rounds: int | None = None,
    seed: int = 1,
    discount: float = 0.9,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, float]:
    """Returns and agreements of a self-model, all on the same rounds.

    Args:
        self_model: the model.
        rounds: number of rounds B; the world's own unless given, see `Record.measured`.
        seed: seed of the rounds.
        discount: the discount that the self-model was trained with.
        progress: called with the number of views that are done, and of all views.

    Returns:
        Numbers by name; those that need an exact planner only where there is one.
        ``return_*``: mean returns of the exact planner, of random actions, and of the self-model
        in ``full`` view (everything shown and communicated), in ``clear`` view (nothing
        communicated) if it is a setting, in partial views if assumptions do not settle the world.
        ``return_as_it_is`` and ``return_exact_as_it_is``, where the robot believes in a wrong
        world: returns of the self-model in ``full`` view and of the planner in the true world.
        ``share_*``: these returns as a share of the way from random to exact.
        ``agreement_*``: share of decisions that agree with the exact planner of a view;
        ``clear_agreement_*``: of those in which more than ``CLEAR_DECISION`` is at stake. Decisions
        are compared along rounds with one random action in five.
    """
    domain = self_model.domain.as_believed
    rounds = domain.record.measured if rounds is None else rounds
    device = next(self_model.parameters()).device
    generator = torch.Generator(device).manual_seed(seed)
    start = domain.initial(rounds, generator)
    steps = domain.horizon
    anything = torch.randint(
        len(domain.actions), (rounds, steps), generator=generator, device=device
    )
    worst = float(returns(domain, start, anything).mean())
    report, best = {"return_random": worst}, None
    if offers(domain, "reference_values"):
        best = float(returns(domain, start, planner_actions(domain, start, steps, 1.0)).mean())
        report = {"return_exact": best} | report
    views = views_of(domain, rounds, generator)
    for done, (name, plan) in enumerate(views.items()):
        progress(done, len(views))
        whole = name in ("full", "clear")
        if whole or not domain.settled:
            own = drive(self_model, start, plan, steps, generator)
            reached = float(returns(domain, start, own).mean())
            report[f"return_{name}"] = reached
            if best is not None and best != worst:  # in some worlds actions do not matter
                report[f"share_{name}"] = (reached - worst) / (best - worst)
            if name == "full" and domain is not self_model.domain:
                real = self_model.domain
                report["return_as_it_is"] = float(returns(real, start, own).mean())
                planned = planner_actions(real, start, steps, 1.0)
                report["return_exact_as_it_is"] = float(returns(real, start, planned).mean())
        if best is not None and (whole or domain.settled):
            actions = drive(self_model, start, plan, steps, generator, epsilon=0.2)
            exact = exact_values(domain, start, actions, plan, discount)
            agree, clear = _agreement(self_model, exact, start, actions, plan)
            report |= {f"agreement_{name}": agree, f"clear_agreement_{name}": clear}
    progress(len(views), len(views))
    return report


def views_of(domain: Domain, rounds: int, generator: torch.Generator) -> dict[str, ViewPlan]:
    """Full view, clear view where there is one, and the domain's partial views."""
    views = {"full": fixed_views(domain, rounds, generator, speech=True)}
    if "clear" in domain.settings:
        views["clear"] = fixed_views(domain, rounds, generator)
    for name, reach in domain.partial_views.items():
        views[name] = fixed_views(domain, rounds, generator, reach)
    return views


def _agreement(
    self_model: SelfModel, exact: Tensor, start: Any, actions: Tensor, plan: ViewPlan
) -> tuple[float, float]:
    """Share of decisions that are best by exact values ``[B, T, A]``: of all, and of clear ones.

    After the end of a round all actions are equally good, so nothing is decided.
    """
    states = roll_out(self_model.domain, start, actions)
    decides = ~self_model.domain.over(map_state(lambda part: part[:, :-1], states))
    best = robot_values(self_model, start, actions, plan).argmax(-1, keepdim=True)
    agree = exact.gather(-1, best).squeeze(-1) >= exact.amax(-1) - TIE
    stake = exact.amax(-1) - exact.amin(-1)
    clear = decides & (stake > CLEAR_DECISION)
    return float(agree[decides].float().mean()), float(agree[clear].float().mean())


def robot_values(self_model: SelfModel, start: Any, actions: Tensor, plan: ViewPlan) -> Tensor:
    """The robot's action values ``[B, T, A]`` of the world as an observer perceives it."""
    domain = self_model.domain.as_believed
    lived = experience(domain, Course.of(domain, start, actions), plan).rounds
    belief = self_model.believe(
        self_model.evidence(lived.observation, lived.visible, lived.actions)
    )
    return self_model.action_values(belief[:, :-1])


def exact_values(
    domain: Domain, start: Any, actions: Tensor, plan: ViewPlan, discount: float
) -> Tensor:
    """Exact action values ``[B, T, A]`` of the world as the observer believes it to be."""
    states = roll_out(domain, start, actions)
    _, knowledge = follow(domain, plan, domain.observe(states))
    believed = supposed(domain, plan, states, knowledge)
    return domain.reference_values(map_state(lambda part: part[:, :-1], believed), discount)
