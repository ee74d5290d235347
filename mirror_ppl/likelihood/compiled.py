"""A human program with recorded rounds, ready for engines.

:func:`compile` builds tables of views, so that perception and beliefs are computed once. A human
model that overrides ``model`` or ``choose`` cannot be represented by tables. It is run as is, which
is slower and limited to engines that run any Pyro program.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, cast

import pyro
import torch
from pyro import poutine
from pyro.infer import config_enumerate, infer_discrete
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.likelihood.combinations import discrete_sites, needs_points, why_points
from mirror_ppl.likelihood.densities import PLATES, Given, log_prob, power_of
from mirror_ppl.likelihood.enumeration import acts_on_beliefs, draw_combinations, log_joints
from mirror_ppl.likelihood.predictive import predict_actions
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.table_program import TableProgram
from mirror_ppl.likelihood.tables import join_tables, person_builders, restricted, rounds_of
from mirror_ppl.likelihood.view_table import ViewTable
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.handlers import STEP
from mirror_ppl.models.human import ACTION, HumanModel, has_own_program
from mirror_ppl.models.measured import with_measurements
from mirror_ppl.models.prior import Draws, draw_prior, values_of
from mirror_ppl.models.sites import discrete_names, latent_sites, sample_nodes
from mirror_ppl.randomness import forked

AT_ONCE = 2**22
"""Log densities, of draws, people and combinations, that are kept at once."""


class Compiled(ABC):
    """Recorded rounds of P people under a human program.

    Attributes:
        human: the model of people.
    """

    def __init__(self, human: HumanModel) -> None:
        self.human = human

    @property
    @abstractmethod
    def people(self) -> int:
        """Number of people P."""

    @abstractmethod
    def program(self) -> None:
        """The Pyro program, conditioned on the rounds; people are at dimension -2."""

    @abstractmethod
    def log_joint(self, draws: Mapping[str, Tensor]) -> Tensor:
        """Log density ``[S, P]`` of draws ``[S, P, 1, ...]`` of all sites and of the rounds.

        Round latents are summed out.
        """

    @abstractmethod
    def predict(self, draws: Mapping[str, Tensor]) -> Tensor:
        """Log-probabilities ``[S, P, B, T, A]`` of actions, each given the earlier ones."""

    @cached_property
    def discrete(self) -> set[str]:
        """Names of the sites that are enumerated."""
        with forked(), poutine.block():
            return discrete_names(poutine.trace(self.program).get_trace())

    @torch.no_grad()
    def sample_discrete(self, continuous: Mapping[str, Tensor], number: int = 1) -> Draws:
        """Draws ``[S, P, 1, ...]`` of all sites, given those of the continuous ones.

        Discrete sites are drawn from their posterior, with the global random state.

        Args:
            continuous: draws ``[S, P, 1, ...]`` of the continuous sites.
            number: number of draws S, if there are no continuous sites.
        """
        number = len(next(iter(continuous.values()), range(number)))
        drawn = [
            self._with_discrete({name: value[draw] for name, value in continuous.items()})
            for draw in range(number)
        ]
        return {name: torch.stack([one[name] for one in drawn]) for name in drawn[0]}

    @torch.no_grad()
    def refuse_scales(self, engine: str) -> None:
        """Refuse scales of enumerated sites.

        Pyro's TraceEnum_ELBO moves them out of the sum, and its infer_discrete ignores them.

        Raises:
            HumanModelError: there are some; the message names the engine.
        """
        program = cast(Callable[[], None], config_enumerate(self.program, "parallel"))
        with (
            forked(),
            poutine.block(),
            poutine.enum(first_available_dim=-1 - PLATES),
            poutine.trace() as trace,
        ):
            program()
        for name, node in sample_nodes(trace.trace).items():
            plain = isinstance(node["scale"], (int, float)) and node["scale"] == 1
            if not plain and log_prob(node).dim() > PLATES:
                raise HumanModelError(
                    f'{type(self.human).__name__} scales "{name}", which is discrete or depends on '
                    f"discrete sites: Pyro does not scale them as {engine} needs it; use "
                    "importance, which needs the scale in prior() or act()"
                )

    def _with_discrete(self, continuous: Mapping[str, Tensor]) -> Draws:
        """One draw ``[P, 1, ...]``."""
        sampled = infer_discrete(
            poutine.condition(config_enumerate(self.program, "parallel"), data=dict(continuous)),
            first_available_dim=-1 - PLATES,
        )
        with poutine.block():
            sites = latent_sites(poutine.trace(sampled).get_trace())
        own = {name: node for name, node in sites.items() if name in discrete_sites(self.human)}
        return {**continuous, **values_of(own)}


class ViewTables(Compiled):
    """A program compiled to tables of views.

    Args:
        human: the model of people.
        table: views of the rounds of P people.
        builders: its builders, one for each person, if rounds are to be added.
    """

    def __init__(
        self, human: HumanModel, table: ViewTable, builders: Sequence[ViewTableBuilder] = ()
    ) -> None:
        super().__init__(human)
        self.table = table
        self._builders = builders

    @property
    def people(self) -> int:
        """Number of people P."""
        return self.table.people

    def program(self) -> None:
        """The program, with actions of all rounds as one site of each person."""
        TableProgram(self.human)(self.table)

    def restrict(self, alive: Tensor) -> None:
        """Drop the combinations ``[P, M]`` of discrete sites that are not alive."""
        self.table = restricted(self.table, alive)

    def add(self, rounds: Demonstrations) -> None:
        """Add rounds of the same people.

        Args:
            rounds: the same number of rounds for each person.

        Raises:
            InputError: they were not compiled with ``growing=True``.
        """
        if not self._builders:
            raise InputError("rounds are added to what was compiled with growing=True")
        for person, builder in enumerate(self._builders):
            builder.add(rounds_of(rounds, person))
        self.table = join_tables([builder.table() for builder in self._builders])

    @cached_property
    def sums_over_combinations(self) -> bool:
        """True if every discrete site is read by perception, and by nothing else."""
        sites = set(self.table.sites)
        return sites == set(discrete_sites(self.human)) == self.discrete

    @cached_property
    def acts_on_beliefs(self) -> bool:
        """True if percepts affect actions through beliefs alone."""
        return acts_on_beliefs(self.human, self.table.sites)

    @torch.no_grad()
    def log_joint(self, draws: Mapping[str, Tensor]) -> Tensor:
        """Log density ``[S, P]`` of draws ``[S, P, 1, ...]`` of all sites and of the rounds."""
        number = len(next(iter(draws.values())))
        with (
            poutine.block(),
            poutine.trace() as trace,
            Given(dict(draws)),
            pyro.plate("draw", number, dim=-1 - PLATES),
        ):
            self.program()
        return _added(sample_nodes(trace.trace).values(), number, self.people)

    def predict(self, draws: Mapping[str, Tensor]) -> Tensor:
        """Log-probabilities ``[S, P, B, T, A]`` of actions, each given the earlier ones."""
        return predict_actions(self.human, self.table, draws)

    @torch.no_grad()
    def sample_discrete(self, continuous: Mapping[str, Tensor], number: int = 1) -> Draws:
        """Draws ``[S, P, 1, ...]`` of all sites, see :meth:`Compiled.sample_discrete`."""
        if not (self.sums_over_combinations and self.acts_on_beliefs):
            return super().sample_discrete(continuous, number)
        if not continuous:
            joint = log_joints(self.human, self.table, {})[0]
            return draw_combinations(self.human, self.table, joint, number)
        number = len(next(iter(continuous.values())))
        size = max(1, AT_ONCE // (self.people * self.table.index.shape[-1]))
        drawn = []
        for begin in range(0, number, size):
            some = {name: value[begin : begin + size] for name, value in continuous.items()}
            drawn += [
                draw_combinations(self.human, self.table, joint, 1)
                for joint in log_joints(self.human, self.table, some)
            ]
        sights = {name: torch.cat([one[name] for one in drawn]) for name in drawn[0]}
        return {**continuous, **sights}


class Sequential(Compiled):
    """A program that is run as is, step by step, without compilation.

    Args:
        human: the model of people, whose ``model`` may be any Pyro program with the sites of
            ``prior``, an observed site ``action_<t>`` for each step, and other observed sites.
        rounds: rounds of P people.

    Raises:
        HumanModelError: it is not such a program.

    Attributes:
        joint: sites outside of a plate of people, whose density is not a sum over people.
    """

    def __init__(self, human: HumanModel, rounds: Demonstrations) -> None:
        super().__init__(human)
        self.rounds = rounds
        self.joint = self._check()

    @property
    def people(self) -> int:
        """Number of people P."""
        return self.rounds.num_people

    def program(self) -> None:
        """The human model's own program."""
        self.human.model(self.rounds)

    def log_joint(self, draws: Mapping[str, Tensor]) -> Tensor:
        """Log density ``[S, P]`` of draws ``[S, P, 1, ...]`` of all sites and of the rounds.

        Raises:
            HumanModelError: part of the density is not a sum over people.
        """
        if self.joint:
            raise HumanModelError(
                f"{type(self.human).__name__}.model has {_quoted(self.joint)} outside of a plate "
                'of people, so people have no densities of their own; put it into pyro.plate("'
                'person", P, dim=-2)'
            )
        nodes, number = self._run(draws), len(next(iter(draws.values())))
        of_people = [node for node in nodes.values() if not _of_rounds(node)]
        shape = (number, self.people, self.rounds.shape[1])
        total = torch.zeros(shape, device=self.rounds.actions.device)
        for node in nodes.values():
            if _of_rounds(node):
                total = total + log_prob(node)
        total = _over_latents(total, len(shape)).sum(-1)
        return total + _added(of_people, number, self.people)

    def predict(self, draws: Mapping[str, Tensor]) -> Tensor:
        """Log-probabilities ``[S, P, B, T, A]`` of actions, each given all of the steps before."""
        number = len(next(iter(draws.values())))
        shape = (number, *self.rounds.shape[:2])
        so_far, found = torch.zeros(shape, device=self.rounds.actions.device), []
        present, at = [], None  # what is observed at the present step
        for name, node in self._run(draws).items():
            if (step := node["infer"].get(STEP)) != at:
                so_far, present, at = sum(present, so_far), [], step
            if node["is_observed"] and name.startswith(f"{ACTION}_"):
                logits = node["fn"].logits
                share = so_far - _over_latents(so_far, len(shape))
                predicted = _over_latents(share[..., None] + logits, len(shape) + 1)
                found.append(predicted.expand(*shape, -1))
            if _of_rounds(node):
                said = log_prob(node) / power_of(node["fn"])
                if step is not None and node["is_observed"]:
                    present.append(said)
                else:
                    so_far = so_far + said
        return torch.stack(found, -2)

    @torch.no_grad()
    def _run(self, draws: Mapping[str, Tensor]) -> dict[str, dict]:
        """Trace nodes under draws ``[S, P, 1, ...]``, with round latents enumerated."""
        number = len(next(iter(draws.values())))
        with (
            poutine.block(),
            poutine.trace() as trace,
            poutine.enum(first_available_dim=-2 - PLATES),
            Given(dict(draws)),
            pyro.plate("draw", number, dim=-1 - PLATES),
        ):
            cast(Callable[[], None], config_enumerate(self.program, "parallel"))()
        return sample_nodes(trace.trace)

    def _check(self) -> list[str]:
        """Refuse programs that cannot be inferred; returns sites outside of the plate of people."""
        kind = type(self.human).__name__
        with forked(), poutine.block():
            nodes = sample_nodes(poutine.trace(self.program).get_trace())
        expected = draw_prior(self.human, 1, 1, 0)
        latent = {name: node for name, node in nodes.items() if not node["is_observed"]}
        if missing := [name for name in expected if name not in latent]:
            raise HumanModelError(
                f"{kind}.model does not sample {', '.join(missing)} of prior(); call self.prior()"
            )
        for name, node in latent.items():
            if name not in expected and not (_of_rounds(node) and node["fn"].has_enumerate_support):
                raise HumanModelError(
                    f'{kind}.model samples "{name}" outside of prior(); sample it there, or as a '
                    "discrete site of a round"
                )
        for step in range(self.rounds.shape[2]):
            if f"{ACTION}_{step}" not in nodes or not nodes[f"{ACTION}_{step}"]["is_observed"]:
                raise HumanModelError(
                    f'{kind}.model has no observed site "{ACTION}_{step}": the recorded action of '
                    "that step, from which people are inferred"
                )
        return [name for name, node in nodes.items() if -2 not in _plates(node)]


def _of_rounds(node: Mapping[str, Any]) -> bool:
    """True if a site is in the plate of rounds."""
    return -1 in _plates(node)


def _plates(node: Mapping[str, Any]) -> set[int | None]:
    """Dimensions of the plates that a site is in."""
    return {frame.dim for frame in node["cond_indep_stack"]}


def _quoted(names: Iterable[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)


def _over_latents(values: Tensor, dimensions: int) -> Tensor:
    """Log-sum-exp over the dimensions of round latents, which are leftmost."""
    while values.dim() > dimensions:
        values = values.logsumexp(0)
    return values


def _added(nodes: Iterable[Mapping[str, Any]], number: int, people: int) -> Tensor:
    """Sum of the nodes' log densities for each person, ``[S, P]``."""
    total: Tensor | int = 0
    for node in nodes:
        total = total + log_prob(node)
    return torch.as_tensor(total).expand(number, people, 1).squeeze(-1)


@torch.no_grad()
def compile(  # noqa: A001 - the word for it
    human: HumanModel,
    rounds: Demonstrations,
    *,
    screening: Screening | None = None,
    likely: Mapping[str, Tensor] | None = None,
    report: Callable[[int], None] = lambda people: None,
    growing: bool = False,
) -> ViewTables | Sequential:
    """Compile a human program and recorded rounds.

    Args:
        human: the model of people.
        rounds: rounds of P people; measured sites, if any, must be the same for all of them.
        screening: when to drop combinations of discrete sites during compilation; never by default.
        likely: approximate posterior draws ``[S, P, 1, ...]``, see :class:`ViewTableBuilder`.
        report: called with the number of people done.
        growing: True if rounds are to be added later, which takes more memory.

    Raises:
        HumanModelError: the model breaks its contract.
    """
    observed = with_measurements(human, rounds)
    if has_own_program(human):
        return Sequential(observed, rounds)
    if needs_points(human):
        raise HumanModelError(
            f"{why_points(human)}: what is seen has no gradient, which svi and nuts need; fit with "
            "importance"
        )
    builders, tables = [], []
    for builder in person_builders(human, rounds, screening, likely, report=report):
        tables.append(builder.table())
        if growing:
            builders.append(builder)
    return ViewTables(observed, join_tables(tables, rounds.shape), builders)
