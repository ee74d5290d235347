"""Stochastic variational inference of implants, with the discrete ones marginalized exactly.

The evidence lower bound enumerates every discrete site of the human model in parallel, so a guide
is needed for the continuous sites alone. Mean-field guides on relaxed sight thresholds get stuck
between plateaus of the likelihood; enumeration has no such trap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyro
import torch
from pyro import poutine
from pyro.infer import TraceEnum_ELBO, config_enumerate, infer_discrete
from pyro.infer.autoguide import AutoGuide, AutoNormal, init_to_median
from pyro.infer.autoguide.utils import deep_setattr
from pyro.nn import PyroParam
from torch import Tensor
from torch.distributions import biject_to

from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.checks import real_number, whole_number
from mirror_ppl.errors import InputError
from mirror_ppl.inference.marginal_elbo import marginal_elbo
from mirror_ppl.likelihood.combinations import discrete_sites
from mirror_ppl.likelihood.densities import PLATES
from mirror_ppl.likelihood.enumeration import acts_on_beliefs, draw_combinations, log_joint
from mirror_ppl.likelihood.table_program import TableProgram, log_likelihoods
from mirror_ppl.likelihood.tables import combination_scores, restricted
from mirror_ppl.likelihood.view_table import NO_VIEW, ViewTable
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.prior import Draws, sample_sites, values_of
from mirror_ppl.models.sites import discrete_names, latent_sites
from mirror_ppl.progress import Report, silent

PRUNING_DRAWS = 4
WIDTH_DRAWS = 100
LEAST_WIDTH = 0.01
"""Of a site where draws say that nothing is open, on the unconstrained scale."""


@dataclass(frozen=True)
class FitOptions:
    """Settings of fitting implants.

    Attributes:
        steps: gradient steps of variational inference.
        learning_rate: of Adam at the start; it falls to a twentieth on a cosine.
        draws: posterior draws S.
        checkpoint_every: steps between checkpoints.
        prune_every: steps after which combinations of discrete implants are given up that have
            become hopeless under the guide.
        prune_margin: nats by which the log-likelihood of such a combination has fallen behind.
    """

    steps: int = 300
    learning_rate: float = 0.1
    draws: int = 200
    checkpoint_every: int = 25
    prune_every: int = 25
    prune_margin: float = 12.0

    def __post_init__(self) -> None:
        for name in ("steps", "draws", "checkpoint_every", "prune_every"):
            object.__setattr__(self, name, whole_number(getattr(self, name), name, 1))
        if not 0 < real_number(self.learning_rate, "learning_rate", 0) <= 1:
            raise InputError(
                f"learning_rate must be above 0 and at most 1, not {self.learning_rate}"
            )


@dataclass(frozen=True)
class ImplantPosterior:
    """What was inferred of P people.

    Attributes:
        guide: over the continuous sites.
        draws: joint posterior draws of all sites, ``[S, P, 1, ...]``.
        losses: negative ELBO at each step, in nats.
    """

    guide: AutoGuide
    draws: Draws
    losses: tuple[float, ...]


class PriorScaledNormal(AutoNormal):
    """A mean-field guide that starts as wide as the prior: weights of which the data say nothing
    are right from the first step, and the others have only to move.
    """

    def _setup_prototype(self, *args: Any, **kwargs: Any) -> None:
        super()._setup_prototype(*args, **kwargs)
        assert self.prototype_trace is not None
        for name, site in self.prototype_trace.iter_stochastic_nodes():
            prior = site["fn"]
            draws = torch.stack([prior.sample() for _ in range(WIDTH_DRAWS)])
            width = biject_to(prior.support).inv(draws).std(0)
            width = width.mean(tuple(range(width.dim() - prior.event_dim)))
            _, scale = self._get_loc_and_scale(name)
            parameter = PyroParam(
                width.expand(scale.shape).clone(), self.scale_constraint, prior.event_dim
            )
            deep_setattr(self.scales, name, parameter)

    def start_at(self, draws: Mapping[str, Tensor]) -> None:
        """Take location and width of each site of one number from draws ``[S, P, 1, ...]``.

        Of hundreds of weights, draws say less than the prior does.
        """
        assert self.prototype_trace is not None
        for name, site in self.prototype_trace.iter_stochastic_nodes():
            if site["fn"].event_dim:
                continue
            place = biject_to(site["fn"].support).inv(draws[name])
            loc, scale = self._get_loc_and_scale(name)
            with torch.no_grad():
                loc.copy_(place.mean(0))
            width = place.std(0).clamp(min=LEAST_WIDTH) if len(place) > 1 else scale.detach()
            parameter = PyroParam(width.clone(), self.scale_constraint, site["fn"].event_dim)
            deep_setattr(self.scales, name, parameter)


def continuous_guide(human: HumanModel, table: ViewTable) -> PriorScaledNormal:
    """A mean-field guide over the continuous sites of a human model, one factor a person."""
    model = poutine.block(TableProgram(human), hide=list(_enumerated(human, table)))
    guide = PriorScaledNormal(model, init_loc_fn=init_to_median)
    guide(table)
    return guide


def fit_implants(
    human: HumanModel,
    table: ViewTable,
    options: FitOptions,
    seed: int,
    report: Report = silent,
    checkpoint: tuple[Path, str] | None = None,
    start: Mapping[str, Tensor] | None = None,
) -> ImplantPosterior:
    """Posterior of the implants of P people.

    Args:
        human: the model of people.
        table: views of the rounds to learn from.
        options: settings.
        seed: seed of everything random here.
        report: told of gradient steps and of draws.
        checkpoint: a file that is written now and then and continued from if it exists, and what
            identifies this run (a checkpoint of another run is refused).
        start: draws ``[S, P, 1, ...]`` at which the guide starts; the prior unless given.

    Raises:
        CheckpointError: the checkpoint is damaged or of another run.
    """
    with torch.random.fork_rng(devices=[]), pyro.settings.context(module_local_params=True):
        torch.manual_seed(seed)
        guide = continuous_guide(human, table)
        if start is not None:
            guide.start_at(start)
        table, losses = _optimize(human, table, guide, options, report, checkpoint)
        draws = draw_implants(human, table, guide, options.draws, report)
        draws = {name: draws[name] for name in sample_sites(human, 1)}
    return ImplantPosterior(guide, draws, tuple(losses))


def _optimize(
    human: HumanModel,
    table: ViewTable,
    guide: AutoGuide,
    options: FitOptions,
    report: Report,
    checkpoint: tuple[Path, str] | None,
) -> tuple[ViewTable, list[float]]:
    """Optimize the guide; returns the table without what was given up, and the losses."""
    elbo = negative_elbo(human, table, guide)
    optimizer = torch.optim.Adam(guide.parameters(), options.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, options.steps, options.learning_rate / 20
    )
    losses: list[float] = []
    if checkpoint is not None and checkpoint[0].exists():
        losses, alive = _restore(*checkpoint, guide, optimizer, schedule)
        table = restricted(table, alive)
    while len(losses) < options.steps:
        optimizer.zero_grad()
        # What is wrong with a model shows at the first step; checking all of them costs a third.
        with pyro.validation_enabled(not losses):
            loss = elbo(table)
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
        report("fit", len(losses), options.steps, f"negative ELBO {losses[-1]:.1f}")
        if len(losses) % options.prune_every == 0 or len(losses) == options.steps:
            table = _prune(human, table, guide, options.prune_margin)
        if checkpoint is not None and len(losses) % options.checkpoint_every == 0:
            alive = (table.index != NO_VIEW).any(1)
            _save(*checkpoint, guide, optimizer, schedule, losses, alive)
    return table, losses


def negative_elbo(
    human: HumanModel, table: ViewTable, guide: AutoGuide
) -> Callable[[ViewTable], Tensor]:
    """The loss of fitting: discrete sites are summed out, whatever samples them."""
    if set(discrete_sites(human)) == set(table.sites) == _enumerated(human, table):
        return marginal_elbo(human, table, guide)
    return TraceEnum_ELBO(max_plate_nesting=PLATES, strict_enumeration_warning=False)(
        config_enumerate(TableProgram(human), "parallel"), guide
    )


@torch.no_grad()
def _prune(human: HumanModel, table: ViewTable, guide: AutoGuide, margin: float) -> ViewTable:
    """Give up combinations that are behind the best one by more than the margin.

    Each is scored under the guide's draw that suits it best.
    """
    best = None
    for _ in range(PRUNING_DRAWS):
        with (
            poutine.block(),
            poutine.condition(data=guide(table)),
            pyro.plate("person", table.people, dim=-PLATES),
        ):
            likelihoods = log_likelihoods(human, human.prior(), table)
        score = combination_scores(table, likelihoods)
        best = score if best is None else torch.maximum(best, score)
    assert best is not None
    return restricted(table, best >= best.amax(-1, keepdim=True) - margin)


def _save(
    path: Path, run: str, guide, optimizer, schedule, losses: list[float], alive: Tensor
) -> None:
    content = {
        "guide": guide.state_dict(),
        "optimizer": optimizer.state_dict(),
        "schedule": schedule.state_dict(),
        "losses": losses,
        "alive": alive,
        "torch": torch.random.get_rng_state(),
    }
    save_checkpoint(path, run, content)


def _restore(path: Path, run: str, guide, optimizer, schedule) -> tuple[list[float], Tensor]:
    content = read_checkpoint(path, run)
    guide.load_state_dict(content["guide"])
    optimizer.load_state_dict(content["optimizer"])
    schedule.load_state_dict(content["schedule"])
    torch.random.set_rng_state(content["torch"])
    return content["losses"], content["alive"]


@torch.no_grad()
def draw_implants(
    human: HumanModel,
    table: ViewTable,
    guide: AutoGuide,
    number: int,
    report: Report = silent,
) -> Draws:
    """Joint draws ``[S, P, 1, ...]`` of all sites from the guide and the enumerated posterior.

    Draws are independent of each other.
    """
    only_views = set(discrete_sites(human)) == set(table.sites) == _enumerated(human, table)
    by_table = only_views and acts_on_beliefs(human, table)
    draw = _draw_by_table if by_table else _draw_by_enumeration
    drawn: list[Draws] = []
    for done in range(number):
        report("draw", done, number, "")
        drawn.append(draw(human, table, guide))
    report("draw", number, number, "")
    return {name: torch.stack([one[name] for one in drawn]) for name in drawn[0]}


def _enumerated(human: HumanModel, table: ViewTable) -> set[str]:
    """Every discrete site of the whole program, those that ``act`` samples included."""
    return discrete_names(poutine.trace(TableProgram(human)).get_trace(table))


def _draw_by_table(human: HumanModel, table: ViewTable, guide: AutoGuide) -> Draws:
    continuous = guide(table)
    discrete = draw_combinations(human, table, log_joint(human, table, continuous), 1)
    return {**continuous, **{name: value[0] for name, value in discrete.items()}}


def _draw_by_enumeration(human: HumanModel, table: ViewTable, guide: AutoGuide) -> Draws:
    continuous = guide(table)
    sampled = infer_discrete(
        poutine.condition(config_enumerate(TableProgram(human), "parallel"), data=continuous),
        first_available_dim=-1 - PLATES,
    )
    trace = poutine.trace(sampled).get_trace(table)
    return {**continuous, **values_of(latent_sites(trace))}
