"""Infers during assistance which channels reach a person, if recordings do not identify it.

Recordings without messages do not identify which channels reach a person, so the posterior equals
the prior. Each posterior draw therefore also gets, for each modality, whether messages reach the
person (:class:`mirror_ppl.models.family.HardOfHearing`), drawn from::

    p(hears | psi, rounds so far)  ~  p(hears) prod_t p(a_t | psi, hears, a_{1:t-1}, told_{1:t})

over the assisted rounds (:meth:`HearingPerson.after`) and the present round so far, with the
actions' probabilities to the model's ``likelihood_power``. The other implants are updated only by
the next fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from itertools import product
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.communication.person import Person
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.communication.tracking import RunningSum
from mirror_ppl.models.family.hearing import HEARS, HardOfHearing
from mirror_ppl.models.human import HumanModel


class HearingPerson(Person):
    """A person with an inferred subset of channels that reach them.

    Args:
        human: the model of people.
        draws: values ``[S, 1, 1, ...]`` of all its sites, tensors or convertible to tensors.
        hears: prior probability that messages of a modality reach them. In a model that infers it,
            the share of draws in which each subset of channels reaches them is used for all draws;
            the prior counts as one additional draw.

    Raises:
        HumanModelError, InputError: as for `Person`.
    """

    def __init__(self, human: HumanModel, draws: Mapping[str, Tensor], hears: float) -> None:
        own = Person(human, draws)
        names = [HEARS + modality.name for modality in human.domain.modalities]
        patterns = torch.tensor([*product((0, 1), repeat=len(names))], device=own.device)
        self.patterns = dict(zip(names, patterns.T, strict=True))
        probabilities = torch.where(patterns == 1, hears, 1 - hears).prod(-1)
        if all(name in own.draws for name in names):
            given = torch.stack([own.draws[name].flatten() for name in names], -1)  # [S, C]
            counts = (given[:, None] == patterns).all(-1).sum(0)
            probabilities = (counts + probabilities) / (own.number + 1)
        # [S, H], by draw and pattern; from the second round on they differ between draws.
        self.log_hears = probabilities.log().expand(own.number, -1)
        generator = torch.Generator().manual_seed(0)
        self.ladder = (torch.randperm(own.number, generator=generator) + 0.5) / own.number
        self.ladder = self.ladder.to(own.device)
        super().__init__(_open(human), own.draws | self._drawn(self.log_hears))
        self.cycle = own.cycle

    def in_round(self, past: RoundSoFar, seed: int = 0) -> Person:
        """Return the person in this round, with channels drawn given their actions so far."""
        found = copy(self)
        found._take(self._drawn(self._after(past)))
        return super(HearingPerson, found).in_round(past, seed)

    @torch.no_grad()
    def after(self, past: RoundSoFar) -> HearingPerson:
        """Return the person after an assisted round, with updated channel probabilities."""
        found = copy(self)
        found.log_hears = self._after(past)
        found._take(self._drawn(found.log_hears))
        return found

    @property
    def hears(self) -> dict[str, float]:
        """Probability that messages of each modality reach them, averaged over draws."""
        probabilities = self.log_hears.softmax(-1).mean(0)
        return {
            name.removeprefix(HEARS): float(probabilities @ pattern.to(probabilities))
            for name, pattern in self.patterns.items()
        }

    def _after(self, past: RoundSoFar) -> Tensor:
        """Return log-probabilities ``[S, H]`` of patterns, up to a constant, given a round."""
        said = any(bool(mask[: past.time].any()) for mask in past.told.values())
        if not said or not past.time:
            return self.log_hears
        return (self.log_hears + self._log_likelihoods(past)).log_softmax(-1)

    def _log_likelihoods(self, past: RoundSoFar) -> Tensor:
        """Return log-likelihoods of actions so far in a round under each pattern, ``[S, H]``."""
        if not self.human.has_round_latents:
            return self._log_probabilities(self.patterns, past)
        attention, log_probabilities = self._attending(past)
        number, patterns = len(next(iter(attention.values()))), len(self.log_hears[0])
        values = {name: value.repeat(patterns) for name, value in attention.items()}
        values |= {name: own.repeat_interleave(number) for name, own in self.patterns.items()}
        found = self._log_probabilities(values, past).unflatten(-1, (patterns, number))
        return (found + log_probabilities[:, None]).logsumexp(-1)

    def _drawn(self, log_probabilities: Tensor) -> dict[str, Tensor]:
        """Draw a pattern for each draw by stratified sampling, ``[S, 1, 1]`` by site."""
        steps = log_probabilities.softmax(-1).cumsum(-1)
        chosen = (self.ladder[:, None] > steps).sum(-1).clamp(max=steps.shape[-1] - 1)
        return {name: pattern[chosen][:, None, None] for name, pattern in self.patterns.items()}

    def _take(self, hears: Mapping[str, Tensor]) -> None:
        self.draws = {**self.draws, **hears}
        self._perceived = {
            **self._perceived,
            **{name: value.flatten() for name, value in hears.items()},
        }
        self.percepts, self.percept = self._distinct_percepts(self._perceived, self.number)
        self.percept_count = int(self.percept.max()) + 1
        self._log_likelihood = RunningSum()


def hearing(person: Person, hears: float) -> Person:
    """Return a :class:`HearingPerson`, or the person if no channel has to be inferred.

    Args:
        person: the person.
        hears: see :class:`HearingPerson`.
    """
    known = hears == 1.0 and not isinstance(person.human, HardOfHearing)
    if known or isinstance(person, HearingPerson):
        return person
    return HearingPerson(person.human, person.draws, hears)


def _open(human: HumanModel) -> HumanModel:
    """Return the model with the sites of :class:`HardOfHearing` added."""
    if isinstance(human, HardOfHearing):
        return human
    own, kind = copy(human), type(human)
    members = {"spans": kind.spans, "__reduce_ex__": _reduced}
    own.__class__ = type(kind.__name__, (HardOfHearing, kind), members)
    return own


def _reduced(human: HumanModel, protocol: int) -> tuple[Callable[..., HumanModel], tuple[Any]]:
    """Pickle a model of :func:`_open` as the one that it was made from."""
    del protocol
    _, kind = type(human).__bases__
    plain = object.__new__(kind)
    plain.__dict__.update(human.__dict__)
    return _open, (plain,)
