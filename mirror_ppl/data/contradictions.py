"""Checks that recordings are possible in their domain's world.

Rounds are at most as long as the world's, each observation has to be possible, and the action
recorded at step t has to lead from the observation at time t to the one at time t + 1. In worlds in
which recorded rewards enter inference, each reward has to be possible, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.data.schema import dimension_labels
from mirror_ppl.domains import Observation, get_domain
from mirror_ppl.domains.controls import grid
from mirror_ppl.errors import DemonstrationsError

TOLERANCE = 1e-3
"""Differences up to this, in the domain's units, are rounding."""
ENOUGH_STEPS = 5
"""Contradicting steps from which on a message mentions shifted actions."""


@dataclass(frozen=True)
class Contradictions:
    """Counts of a recording's steps that contradict the next observation.

    Attributes:
        steps: number of all steps, by person.
        contradicting: number of those whose action does not lead to the next observation.
    """

    steps: Mapping[str, int]
    contradicting: Mapping[str, int]

    @property
    def share(self) -> float:
        """Contradicting steps of all people, as a share of all steps."""
        return sum(self.contradicting.values()) / max(1, sum(self.steps.values()))

    def as_data(self) -> dict[str, object]:
        """Plain values for a summary."""
        return {
            "steps": sum(self.steps.values()),
            "contradicting": sum(self.contradicting.values()),
            "by_person": dict(self.contradicting),
        }


def check_world(demonstrations: Demonstrations, allowed: float = 0.0) -> Contradictions:
    """Check that recordings are possible in the domain's world.

    Args:
        demonstrations: rounds of P people.
        allowed: share of steps, from 0 to 1, that may contradict each other.

    Returns:
        The number of steps that do.

    Raises:
        DemonstrationsError: a round is too long or goes on when the task is done, an observation or
            a reward is impossible, or too many steps contradict each other; the message says where
            the first is, what was expected and what was found.
    """
    wrong, unearned = [], []
    for person in range(demonstrations.num_people):  # one by one, to bound memory
        observation = _observation(demonstrations, person)
        _check_observations(demonstrations, person, observation)
        wrong.append(_wrong(demonstrations, person, observation))
        unearned.append(_unearned(demonstrations, person, observation))
    found = Contradictions(
        dict(zip(demonstrations.people, demonstrations.mask.sum((1, 2)).tolist(), strict=True)),
        dict(zip(demonstrations.people, [int(steps.sum()) for steps in wrong], strict=True)),
    )
    if found.share > allowed:
        number, steps = sum(found.contradicting.values()), sum(found.steps.values())
        message = f"{_first(demonstrations, wrong)}; {number} of {steps} steps "
        message += f"({found.share:.1%}) contradict the next observation, {100 * allowed:.3g}% may"
        raise DemonstrationsError(message + _shifted(demonstrations, wrong, _wrong, "action"))
    # After the dynamics: shifted actions have wrong rewards, too, and are what to report.
    if any(bool(steps.any()) for steps in unearned):
        message = _first_reward(demonstrations, unearned)
        raise DemonstrationsError(message + _shifted(demonstrations, unearned, _unearned, "reward"))
    return found


def _observation(demonstrations: Demonstrations, person: int) -> Observation:
    """Observations in one person's rounds, ``[B, T+1, ...]``; their first one in padding.

    Without rounds all are 0. Worlds may refuse observations that cannot be.
    """
    values = {"ego": demonstrations.ego[person]}
    values |= {name: value[person] for name, value in demonstrations.observations.items()}
    return {
        name: torch.where(value.isnan(), value[:1, :1], value).nan_to_num(0.0)
        for name, value in values.items()
    }


def check_observations(demonstrations: Demonstrations) -> None:
    """Check that each observation is possible in the domain's world, and no round too long.

    Raises:
        DemonstrationsError: one is not, or actions follow when the task is done; the message names
            it and the rule that it breaks.
    """
    for person in range(demonstrations.num_people):
        _check_observations(demonstrations, person, _observation(demonstrations, person))


def _check_observations(
    demonstrations: Demonstrations, person: int, observation: Observation
) -> None:
    lengths = demonstrations.lengths[person][:, None]
    domain = get_domain(demonstrations.domain)
    number, most = int(lengths.argmax()), int(lengths.max())
    if most > domain.horizon:
        raise DemonstrationsError(
            f"person {demonstrations.people[person]!r}, round {number}: {most} steps, expected at "
            f"most {domain.horizon}, as long as rounds of {domain.name} are"
        )
    times = torch.arange(demonstrations.ego.shape[2], device=lengths.device)
    real = (times <= lengths) & (lengths > 0)
    for rule, broken in domain.faults(observation).items():
        where = (broken & real).nonzero()
        if len(where):
            number, time = where[0].tolist()
            raise DemonstrationsError(
                f"person {demonstrations.people[person]!r}, round {number}, time {time}: {rule}"
            )
    late = (domain.ended(observation) & (times < lengths)).nonzero()
    if len(late):
        number, time = late[0].tolist()
        raise DemonstrationsError(
            f"person {demonstrations.people[person]!r}, round {number}: the task is done at time "
            f"{time}, but {int(lengths[number]) - time} more actions follow; length has to be the "
            "number of actions until then"
        )


def _wrong(
    demonstrations: Demonstrations, person: int, observation: Observation, shift: int = 0
) -> Tensor:
    """Steps ``[B, T]`` of a person whose action does not lead to the next observation.

    With a shift, the action that many steps before is tested instead, where there is one.
    """
    domain, mask = get_domain(demonstrations.domain), demonstrations.mask[person]
    actions = _executed(demonstrations, person)
    if shift:
        actions, mask = torch.roll(actions, shift, 1), mask & _has_neighbour(mask, shift)
    now = {name: value[:, :-1] for name, value in observation.items()}
    expected = domain.next_observation(now, actions)
    differs = [
        _differs(expected[name], value[:, 1:]).flatten(2).any(-1)
        for name, value in observation.items()
    ]
    return torch.stack(differs).any(0) & mask


def _unearned(
    demonstrations: Demonstrations, person: int, observation: Observation, shift: int = 0
) -> Tensor:
    """Steps ``[B, T]`` of a person with a recorded reward that the world cannot give.

    With a shift, the reward that many steps before is tested instead, where there is one.
    """
    mask = demonstrations.mask[person]
    possible = _possible_rewards(demonstrations, person, observation)
    if possible is None or demonstrations.rewards is None:
        return torch.zeros_like(mask)
    rewards = demonstrations.rewards[person]
    if shift:
        rewards, mask = torch.roll(rewards, shift, 1), mask & _has_neighbour(mask, shift)
    return _differs(possible, rewards[..., None]).all(-1) & mask


def _possible_rewards(
    demonstrations: Demonstrations, person: int, observation: Observation
) -> Tensor | None:
    """Rewards ``[B, T, R]`` that a person's steps may have, or None if any may occur."""
    now = {name: value[:, :-1] for name, value in observation.items()}
    actions = _executed(demonstrations, person)
    return get_domain(demonstrations.domain).possible_rewards(now, actions)


def _executed(demonstrations: Demonstrations, person: int) -> Tensor:
    """Executed controls ``[B, T, C]``, if recorded, or actions ``[B, T]``; padding is action 0."""
    actions = demonstrations.actions[person].clamp(min=0)
    if demonstrations.controls is None:
        return actions
    controls, domain = demonstrations.controls[person], get_domain(demonstrations.domain)
    return torch.where(controls.isnan(), grid(domain.controls).to(controls)[actions], controls)


def _has_neighbour(mask: Tensor, shift: int) -> Tensor:
    """Steps ``[B, T]`` that have a step of the same round ``shift`` steps before."""
    shifted = torch.roll(mask, shift, -1)
    shifted[:, 0 if shift > 0 else -1] = False
    return shifted


def _differs(expected: Tensor, found: Tensor) -> Tensor:
    return (expected - found).abs() > TOLERANCE  # False where no certain value is expected


def _first(demonstrations: Demonstrations, wrong: Sequence[Tensor]) -> str:
    """Describe the first contradiction."""
    domain = get_domain(demonstrations.domain)
    person = next(place for place, steps in enumerate(wrong) if steps.any())
    number, step = wrong[person].nonzero()[0].tolist()
    observation = _observation(demonstrations, person)
    action = demonstrations.actions[person, number, step]
    now = {name: value[number, step] for name, value in observation.items()}
    labels = dimension_labels(domain)
    executed = _executed(demonstrations, person)[number, step]
    for name, expected in domain.next_observation(now, executed).items():
        found = observation[name][number, step + 1]
        places = _differs(expected, found).nonzero()
        if len(places):
            place = tuple(places[0].tolist())
            axes = ("ego_feature",) if name == "ego" else (f"{name}_item", f"{name}_feature")
            what = [labels[axis][index] for axis, index in zip(axes, place, strict=True)]
            return (
                f"person {demonstrations.people[person]!r}, round {number}, step {step}: after "
                f"action {int(action)} ({domain.actions[int(action)]}) the {name} "
                f"{', '.join(what)} is expected to be {expected[place].item():g} at time "
                f"{step + 1}, found {found[place].item():g}"
            )
    raise AssertionError("nothing contradicts at this step")


def _first_reward(demonstrations: Demonstrations, unearned: Sequence[Tensor]) -> str:
    """Describe the first reward that the world cannot give."""
    person = next(place for place, steps in enumerate(unearned) if steps.any())
    number, step = unearned[person].nonzero()[0].tolist()
    possible = _possible_rewards(demonstrations, person, _observation(demonstrations, person))
    assert possible is not None and demonstrations.rewards is not None
    expected = " or ".join(f"{each:g}" for each in possible[number, step].unique().tolist())
    action = int(demonstrations.actions[person, number, step])
    total, steps = sum(int(each.sum()) for each in unearned), int(demonstrations.mask.sum())
    return (
        f"person {demonstrations.people[person]!r}, round {number}, step {step}: the reward of "
        f"action {action} ({get_domain(demonstrations.domain).actions[action]}) is expected to be "
        f"{expected}, found {demonstrations.rewards[person, number, step].item():g}; {total} of "
        f"{steps} steps have impossible rewards"
    )


def _shifted(
    demonstrations: Demonstrations,
    wrong: Sequence[Tensor],
    test: Callable[[Demonstrations, int, Observation, int], Tensor],
    what: str,
) -> str:
    """Describe a shift if most wrong steps would fit with what is one step before or after.

    Args:
        demonstrations: rounds of P people.
        wrong: by person, the steps ``[B, T]`` that fail the test.
        test: `_wrong` or `_unearned`.
        what: the name of what is tested.
    """
    number = sum(int(steps.sum()) for steps in wrong)
    if number < ENOUGH_STEPS:
        return ""
    for shift, word in ((1, "before"), (-1, "after")):
        left = fitting = 0
        for person, steps in enumerate(wrong):
            still = test(demonstrations, person, _observation(demonstrations, person), shift)
            own = steps & _has_neighbour(demonstrations.mask[person], shift)
            left += int(still.sum())
            fitting += int((own & ~still).sum())
        if fitting > number / 2 and left < number / 2:
            return (
                f"; {fitting} of them fit with the {what} of the step {word}: the {what}s look "
                "shifted by one step"
            )
    return ""
