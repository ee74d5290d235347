"""Building tables of views: which distinct ways there are to have seen the recorded rounds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise

import pyro
import torch
from pyro import poutine
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.models.human import HumanModel, View
from mirror_ppl.models.view_table import ViewTable

MAX_COMBINATIONS = 100_000
CHUNK = 20_000
"""Views whose beliefs are computed at once; bounds memory."""


def discrete_sites(human: HumanModel) -> dict[str, Tensor]:
    """Supports ``[n]`` of the discrete sites of a human model's prior, by name."""
    with pyro.plate("person", 1, dim=-2):
        trace = poutine.trace(human.prior).get_trace()
    return {
        name: site["fn"].enumerate_support(expand=False).flatten()
        for name, site in trace.nodes.items()
        if site["type"] == "sample"
        and not site["is_observed"]
        and site["fn"].has_enumerate_support
    }


class _Reading(Mapping[str, Tensor]):
    """Implants that note which of them are read, and refuse those that cannot be enumerated."""

    def __init__(self, values: Mapping[str, Tensor]) -> None:
        self.values_ = values
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Tensor:
        if name not in self.values_:
            raise HumanModelError(
                f'perceive() reads "{name}", which is not a discrete site of prior(); '
                f"it can read: {', '.join(self.values_) or 'none'}"
            )
        self.read.add(name)
        return self.values_[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_)

    def __len__(self) -> int:
        return len(self.values_)


@torch.no_grad()
def build_view_table(
    human: HumanModel,
    demonstrations: Demonstrations,
    report: Callable[[int], None] = lambda people: None,
) -> ViewTable:
    """Every distinct view of the recorded rounds, with the beliefs that they lead to.

    Args:
        human: whose ``perceive`` and ``believe`` are called.
        demonstrations: rounds of P people.
        report: called with the number of people done.

    Raises:
        HumanModelError: ``perceive`` reads a site that cannot be enumerated, or there are too many
            combinations of values.
    """
    supports = discrete_sites(human)
    used = _sites_read(human, demonstrations, supports)
    supports = {name: support for name, support in supports.items() if name in used}
    sizes = tuple(len(support) for support in supports.values())
    combinations = 1
    for size in sizes:
        combinations *= size
    if combinations > MAX_COMBINATIONS:
        raise HumanModelError(
            f"perceive() depends on {combinations} combinations of discrete values; "
            f"at most {MAX_COMBINATIONS} can be marginalized"
        )
    grid = dict(
        zip(
            supports,
            (axis.flatten() for axis in torch.meshgrid(*supports.values(), indexing="ij")),
            strict=True,
        )
    )
    people = [
        _person(human, demonstrations, person, grid, report)
        for person in range(demonstrations.num_people)
    ]
    most = max(len(part["actions"]) for part in people)

    def padded(name: str) -> Tensor:
        return torch.stack([_pad(part[name], most) for part in people])

    steps = demonstrations.mask
    return ViewTable(
        sites=tuple(supports),
        index=torch.stack([part["index"] for part in people]).unflatten(-1, sizes),
        belief=padded("belief"),
        values=padded("values"),
        view_actions=padded("actions"),
        view_steps=padded("steps"),
        recorded=demonstrations.actions.clamp(min=0),
        steps=steps,
        view_counts=torch.tensor([len(part["actions"]) for part in people]),
    )


def _sites_read(
    human: HumanModel, demonstrations: Demonstrations, supports: Mapping[str, Tensor]
) -> set[str]:
    observation, told, _ = _round(demonstrations, 0, 0)
    implants = _Reading({name: support[:1] for name, support in supports.items()})
    human.perceive(implants, observation, told)
    return implants.read


def _round(
    demonstrations: Demonstrations, person: int, number: int
) -> tuple[dict[str, Tensor], dict[str, Tensor], Tensor]:
    """Observation ``[1, T, ...]``, told ``[1, T, K]`` and actions ``[1, T]`` of one round."""
    steps = demonstrations.shape[2]
    observation = {
        name: value[person, number, :steps][None]
        for name, value in demonstrations.observation().items()
    }
    told = {name: value[person, number][None] for name, value in demonstrations.told.items()}
    return observation, told, demonstrations.actions[person, number].clamp(min=0)[None]


def _person(
    human: HumanModel,
    demonstrations: Demonstrations,
    person: int,
    grid: Mapping[str, Tensor],
    report: Callable[[int], None],
) -> dict[str, Tensor]:
    count = int(demonstrations.round_counts[person])
    combinations = max([len(values) for values in grid.values()], default=1)
    index = torch.zeros(demonstrations.shape[1], combinations, dtype=torch.long)
    parts: dict[str, list[Tensor]] = {"belief": [], "values": [], "actions": [], "steps": []}
    total = 0
    # Somebody without rounds still needs one view, of padding, to be looked up.
    for number in range(max(count, 1)):
        observation, told, actions = _round(demonstrations, person, number)
        real = demonstrations.mask[person, number]
        view = human.perceive(grid, observation, told)
        first, inverse = _distinct(view, real)
        index[number] = total + inverse
        total += len(first)
        for begin, end in pairwise([*range(0, len(first), CHUNK), len(first)]):
            chosen = first[begin:end]
            some = View(_take(view.visible, chosen), _take(view.absent, chosen))
            belief = human.believe(some, observation, actions)
            parts["belief"].append(belief)
            parts["values"].append(human.self_model.action_values(belief))
        parts["actions"].append(actions.expand(len(first), -1))
        parts["steps"].append(real.expand(len(first), -1))
    report(person + 1)
    return {"index": index} | {name: torch.cat(values) for name, values in parts.items()}


def _take(masks: Mapping[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    return {name: mask.expand(max(len(mask), int(rows.max()) + 1), *mask.shape[1:])[rows]
            for name, mask in masks.items()}


def _distinct(view: View, real: Tensor) -> tuple[Tensor, Tensor]:
    """Rows ``[U]`` of distinct views and the distinct view ``[M]`` of each combination."""
    masks = [*view.visible.values(), *view.absent.values()]
    rows = max(len(mask) for mask in masks)
    bits = torch.cat(
        [(mask & real[:, None]).expand(rows, -1, -1).flatten(1) for mask in masks], -1
    )
    # A random 63-bit key for each bit: sums of keys differ for different rows but for one chance
    # in 2**63, and sorting numbers is a hundred times quicker than sorting rows of bits.
    keys = torch.randint(
        2**62, (bits.shape[1],), generator=torch.Generator().manual_seed(0), dtype=torch.long
    )
    values, inverse = torch.unique((bits * keys).sum(-1), return_inverse=True)
    first = torch.full((len(values),), rows, dtype=torch.long)
    first.scatter_reduce_(0, inverse, torch.arange(rows), "amin")
    return first, inverse


def _pad(value: Tensor, length: int) -> Tensor:
    return torch.nn.functional.pad(value, [0, 0] * (value.dim() - 1) + [0, length - len(value)])
