"""The engine `svi`: ``pyro.infer.SVI`` with discrete sites summed out.

The ELBO enumerates every discrete site of the human program in parallel, so that a guide is needed
for the continuous sites only. Mean-field guides on relaxed sight thresholds get stuck on plateaus
of the likelihood; enumeration avoids that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pyro
import torch
from pyro import poutine
from pyro.infer import SVI, TraceEnum_ELBO, config_enumerate
from pyro.infer.autoguide import AutoGuide, AutoNormal, init_to_median
from pyro.infer.autoguide.utils import deep_setattr
from pyro.nn import PyroParam
from pyro.optim import PyroLRScheduler
from torch.distributions import biject_to

from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.checks import real_number, whole_number
from mirror_ppl.errors import HumanModelError, InputError
from mirror_ppl.inference.batches import in_batches
from mirror_ppl.inference.engine import Engine, Inferred, Job
from mirror_ppl.inference.marginal_elbo import elbo_of
from mirror_ppl.likelihood.combinations import log_priors
from mirror_ppl.likelihood.compiled import Compiled, ViewTables
from mirror_ppl.likelihood.densities import PLATES
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import combination_scores
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models.prior import Draws, sample_sites
from mirror_ppl.progress import Report, silent
from mirror_ppl.randomness import forked, seed_everything

PRUNING_DRAWS = 4
WIDTH_DRAWS = 100
TOGETHER = 25
"""Draws whose discrete sites are drawn at once."""


@dataclass(frozen=True)
class SVIOptions:
    """Settings of variational inference.

    Attributes:
        steps: gradient steps.
        learning_rate: initial rate of Adam, annealed to a twentieth on a cosine.
        checkpoint_every: steps between checkpoints.
        prune_every: steps after which combinations of discrete implants are dropped that are far
            behind the best under the guide.
        prune_margin: nats behind the best at which a combination is dropped.
    """

    steps: int = 300
    learning_rate: float = 0.1
    checkpoint_every: int = 25
    prune_every: int = 25
    prune_margin: float = 12.0

    def __post_init__(self) -> None:
        for name in ("steps", "checkpoint_every", "prune_every"):
            object.__setattr__(self, name, whole_number(getattr(self, name), name, 1))
        if not 0 < real_number(self.learning_rate, "learning_rate", 0) <= 1:
            raise InputError(
                f"learning_rate must be above 0 and at most 1, not {self.learning_rate}"
            )


@dataclass(frozen=True)
class ImplantPosterior:
    """Posterior of P people.

    Attributes:
        guide: guide over the continuous sites.
        draws: joint posterior draws of all sites, ``[S, P, 1, ...]``.
        losses: negative ELBO at each step, in nats.
    """

    guide: AutoGuide
    draws: Draws
    losses: tuple[float, ...]


class PriorScaledNormal(AutoNormal):
    """A mean-field guide whose vector sites start with the scale of their prior.

    Weights that the data do not identify are thus correct from the first step. Scalar sites start
    narrow: under a wide guide, a site with posterior scale 0.01 would have gradients thousands of
    times as large, which Adam remembers, so that its steps would be far too small.
    """

    def _setup_prototype(self, *args: Any, **kwargs: Any) -> None:
        super()._setup_prototype(*args, **kwargs)
        assert self.prototype_trace is not None
        for name, site in self.prototype_trace.iter_stochastic_nodes():
            prior = site["fn"]
            if not prior.event_dim:
                continue
            draws = torch.stack([prior.sample() for _ in range(WIDTH_DRAWS)])
            width = biject_to(prior.support).inv(draws).std(0)
            width = width.mean(tuple(range(width.dim() - prior.event_dim)))
            _, scale = self._get_loc_and_scale(name)
            parameter = PyroParam(
                width.expand(scale.shape).clone(), self.scale_constraint, prior.event_dim
            )
            deep_setattr(self.scales, name, parameter)


def continuous_guide(compiled: Compiled, without: Collection[str] = ()) -> PriorScaledNormal:
    """Make a mean-field guide over the continuous sites of a human program.

    Args:
        compiled: the program and the rounds.
        without: names of sites that another guide covers.
    """
    # Parameters are local to the guide until SVI registers them in Pyro's store.
    with pyro.settings.context(module_local_params=True):
        program = poutine.block(compiled.program, hide=[*compiled.discrete, *without])
        guide = PriorScaledNormal(program, init_loc_fn=init_to_median)
        guide()
    return guide


@contextmanager
def own_parameters(seed: int) -> Iterator[None]:
    """Context with its own random state and parameter store."""
    with forked(), pyro.get_param_store().scope():
        seed_everything(seed)
        yield


def fit_implants(
    compiled: Compiled,
    options: SVIOptions,
    draws: int,
    seed: int,
    report: Report = silent,
    checkpoint: tuple[Path, str] | None = None,
) -> ImplantPosterior:
    """Fit the posterior of the implants of P people.

    Args:
        compiled: the program and the rounds to learn from.
        options: settings.
        draws: number of posterior draws S.
        seed: seed of all random draws.
        report: called with progress: gradient steps, draws.
        checkpoint: a file that is written during the run and resumed from if it exists, and the
            identity of this run (a checkpoint of another run is refused).

    Raises:
        CheckpointError: the checkpoint is damaged or of another run.
    """
    with own_parameters(seed):
        guide = continuous_guide(compiled)
        losses = optimize(compiled, guide, options, report, checkpoint)
        drawn = draw_implants(compiled, guide, draws, report)
    return ImplantPosterior(guide, drawn, tuple(losses))


def optimize(
    compiled: Compiled,
    guide: Callable[[], Draws],
    options: SVIOptions,
    report: Report = silent,
    checkpoint: tuple[Path, str] | None = None,
) -> list[float]:
    """Fit a guide by ``pyro.infer.SVI``; combinations in tables are pruned during the fit.

    Args:
        compiled: the program and the rounds.
        guide: guide over the continuous sites; a module, if there is a checkpoint.
        options: settings.
        report: called with the number of gradient steps.
        checkpoint: see :func:`fit_implants`.

    Returns:
        The negative ELBO at each step in nats.
    """
    optimizer = PyroLRScheduler(
        torch.optim.lr_scheduler.CosineAnnealingLR,
        {
            "optimizer": torch.optim.Adam,
            "optim_args": {"lr": options.learning_rate},
            "T_max": options.steps,
            "eta_min": options.learning_rate / 20,
        },
    )
    program = config_enumerate(compiled.program, "parallel")
    elbo = elbo_of(compiled)
    if isinstance(elbo, TraceEnum_ELBO):
        compiled.refuse_scales("svi")
    svi = SVI(program, guide, optimizer, elbo)
    losses: list[float] = []
    if checkpoint is not None and checkpoint[0].exists():
        losses = _restore(*checkpoint, cast(AutoGuide, guide), optimizer, compiled)
    report("fit", len(losses), options.steps, "")
    while len(losses) < options.steps:
        # Validate at the first step only: validation takes a third of the time.
        with pyro.validation_enabled(not losses):
            losses.append(cast(float, svi.step()))
        if not math.isfinite(losses[-1]):
            raise HumanModelError(
                f"the negative ELBO is {losses[-1]} at step {len(losses)}: some implants that the "
                "guide draws have probability 0, as with a factor of -inf; use importance"
            )
        optimizer.step()
        report("fit", len(losses), options.steps, f"negative ELBO {losses[-1]:.1f}")
        if isinstance(compiled, ViewTables) and (
            len(losses) % options.prune_every == 0 or len(losses) == options.steps
        ):
            _prune(compiled, guide, options.prune_margin)
        if checkpoint is not None and len(losses) % options.checkpoint_every == 0:
            _save(*checkpoint, cast(AutoGuide, guide), optimizer, losses, compiled)
    return losses


@torch.no_grad()
def _prune(compiled: ViewTables, guide: Callable[[], Draws], margin: float) -> None:
    """Drop combinations that are behind the best one by more than the margin.

    Each is scored under its best draw of the guide.
    """
    human, table = compiled.human, compiled.table
    best, spared = torch.tensor(-torch.inf), torch.tensor(False)
    for _ in range(PRUNING_DRAWS):
        drawn = guide()
        one = {name: value[None] for name, value in drawn.items()}
        try:
            prior = log_priors(human, table.grid, one, table.people)
        except HumanModelError:
            return  # other sites depend on these, so no combination has a prior
        with (
            poutine.block(),
            poutine.condition(data=drawn),
            pyro.plate("person", table.people, dim=-PLATES),
        ):
            likelihoods = log_likelihoods(human, human.prior(), table)
        score = combination_scores(table, likelihoods)
        # Under other draws, what is impossible here may be the most probable.
        spared = score.isneginf() & prior[0].isfinite() | spared
        best = torch.maximum(best, score + prior[0])
    compiled.restrict((best >= best.amax(-1, keepdim=True) - margin) | spared)


def _save(
    path: Path,
    run: str,
    guide: AutoGuide,
    optimizer: PyroLRScheduler,
    losses: list[float],
    compiled: Compiled,
) -> None:
    content = {
        "guide": guide.state_dict(),
        "optimizer": optimizer.get_state(),
        "losses": losses,
        "torch": torch.random.get_rng_state(),
    }
    if isinstance(compiled, ViewTables):
        content["alive"] = (compiled.table.index != NO_VIEW).any(1)
    save_checkpoint(path, run, content)


def _restore(
    path: Path, run: str, guide: AutoGuide, optimizer: PyroLRScheduler, compiled: Compiled
) -> list[float]:
    content = read_checkpoint(path, run)
    guide.load_state_dict(content["guide"])
    optimizer.set_state(content["optimizer"])
    if isinstance(compiled, ViewTables):
        compiled.restrict(content["alive"])
    torch.random.set_rng_state(content["torch"])
    return content["losses"]


@torch.no_grad()
def draw_implants(
    compiled: Compiled, guide: AutoGuide, number: int, report: Report = silent
) -> Draws:
    """Joint draws ``[S, P, 1, ...]`` of all sites from the guide and the enumerated posterior.

    Draws are independent of each other.
    """
    drawn: list[Draws] = []
    for done in range(0, number, TOGETHER):
        report("draw", done, number, "")
        each = [guide() for _ in range(min(TOGETHER, number - done))]
        some = {name: torch.stack([one[name] for one in each]) for name in each[0]}
        drawn.append(compiled.sample_discrete(some, len(each)))
    report("draw", number, number, "")
    order = sample_sites(compiled.human, 1)
    return {name: torch.cat([one[name] for one in drawn]) for name in order}


def infer_by_svi(job: Job) -> Inferred:
    """Infer all people of a batch together."""

    def infer_batch(compiled: Compiled, part: Job) -> Inferred:
        found = fit_implants(
            compiled,
            part.settings,
            part.draws,
            part.seed,
            part.report,
            part.checkpoint,
        )
        return Inferred(found.draws, losses=found.losses)

    return in_batches(job, infer_batch)


ENGINE = Engine(
    "svi",
    infer_by_svi,
    SVIOptions,
    any_program=True,
)
