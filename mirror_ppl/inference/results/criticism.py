"""Criticism of the human model: a verdict on each person, with reasons.

Besides :mod:`mirror_ppl.inference.results.checks`, the model's predictions of each round's actions
from other rounds are compared with the person's action shares in these, independent of the state.
Predictions of held-out rounds are also compared with the robot itself, without implants.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.inference.pareto import pareto_smoothed
from mirror_ppl.inference.results.checks import (
    CHECKS,
    ONE_SIDED,
    REPLICATES,
    SHARE,
    p_values,
    steps_of,
    tail,
)
from mirror_ppl.inference.results.perception_checks import perception_p_values
from mirror_ppl.inference.results.posterior_predictive import chosen_log_probability, predict_rounds
from mirror_ppl.inference.results.summary import predictive
from mirror_ppl.likelihood.combinations import grid_of, perceived_sites
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.family import KIND, OneOfKinds
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.randomness import forked, seed_everything

OK, SUSPECT, UNEXPLAINED, UNCHECKED = "ok", "suspect", "unexplained", "unchecked"
"""The verdicts."""
FINE = OK, UNCHECKED
"""Verdicts that are no warning."""
LEVEL = 0.05
"""Largest probability that a person whom the model explains is suspect."""
STANDARD_ERRORS = 2.0
"""Standard errors by which predictions have to be worse to count without other reasons."""
LEAST_ROUNDS = 2
"""Least number of training rounds of which each is predicted from the others."""
DRAWS, QUICK = 100, ImportanceOptions(proposals=64, enough=50.0)
"""Draws and settings for inference in the baseline without implants."""


@dataclass(frozen=True)
class Verdict:
    """Verdict on whether the model explains a person.

    Attributes:
        word: ``ok``, ``suspect``, ``unexplained`` or ``unchecked``.
        reasons: reasons for it, the strongest first.
    """

    word: str
    reasons: tuple[str, ...] = ()


def verdict(found: Mapping[str, float], lead: Tensor | None, actions: int = 1) -> Verdict:
    """Compute the verdict on a person.

    ``suspect``: a p-value so near to 0 or 1 that at most a share :data:`LEVEL` of people whom the
    model explains have one (Bonferroni over checks). ``unexplained``: suspect, and the model
    predicts actions worse than the action shares of other rounds do; or this difference exceeds
    :data:`STANDARD_ERRORS` standard errors. ``unchecked``: there are no training rounds.

    Args:
        found: p-values, see :func:`p_values`.
        lead: log predictive density of each round given others minus that of those shares, nats,
            ``[B]``; ``None`` without such rounds.
        actions: number of actions in all of these rounds.
    """
    if not found:
        return Verdict(UNCHECKED)
    tails = {name: tail(name, value) for name, value in found.items()}
    limit, least = LEVEL / len(tails), 2 / REPLICATES
    reasons = []
    for name in sorted(tails, key=lambda one: tails[one]):  # stable: ties keep their order
        if tails[name] < limit:
            size = f"p < {least:.3f}" if tails[name] < least else f"p = {tails[name]:.3f}"
            reasons.append(f"{_says(name, found[name] < 1 / 2)} ({size})")
    word = SUSPECT if reasons else OK
    if lead is not None and len(lead) and lead.sum() < 0:
        total, number = float(lead.sum()), len(lead)
        # Rounds are the sample: actions within a round depend on each other.
        error = float(lead.std()) * number**0.5 if number > 1 else math.inf
        if reasons or not math.isfinite(total) or total < -STANDARD_ERRORS * error:
            word = UNEXPLAINED
            reasons.append(
                f"from other rounds, actions are predicted {-total / actions:.3f} nats worse than "
                "by how often each was chosen there"
            )
    return Verdict(word, tuple(reasons))


def warning_of(people: Sequence[str], anyway: str, planned: bool) -> str:
    """Return what to say to those who plan messages for people who are not explained.

    Args:
        people: their ids.
        anyway: setting by which messages are planned for them.
        planned: True if it is given.
    """
    what = (
        "messages that are planned with it may do harm; another one, such as all, may explain them"
        if planned
        else "no messages are planned for them; another one, such as all, may explain them, and "
        f"{anyway} plans with this one"
    )
    return (
        f"the actions of {', '.join(people)} are not explained by the human model (verdict "
        f"{UNEXPLAINED}): {what}"
    )


def _says(name: str, more: bool) -> str:
    if name in ONE_SIDED:
        return ONE_SIDED[name]
    if name in CHECKS:
        return CHECKS[name].more if more else CHECKS[name].less
    action = name.removeprefix(SHARE)
    return f'does "{action}" {"more" if more else "less"} often than the model says'


def action_shares(train: Demonstrations, actions: int) -> Tensor:
    """Share of each action of each person, independent of the state, ``[P, A]``.

    Half a count is added to each action (Jeffreys's prior), so that none has probability 0.
    """
    done = torch.nn.functional.one_hot(train.actions.clamp(min=0), actions)
    counts = (done * train.mask[..., None]).sum((1, 2)) + 1 / 2
    return counts / counts.sum(-1, True)


def base_rate(train: Demonstrations, test: Demonstrations, actions: int) -> Tensor:
    """Negative log-likelihood of held-out actions ``[N']`` of one person under earlier shares."""
    return -action_shares(train, actions)[0].log()[test.actions[test.mask]]


def left_out(log_likelihood: Tensor, power: float) -> Tensor:
    """Log predictive density ``[B]`` of each training round given the others (PSIS-LOO).

    Where its importance weights are unreliable, as the round surprises the model, it is too high.

    Args:
        log_likelihood: of the rounds under posterior draws, ``[S, B]``.
        power: :attr:`HumanModel.likelihood_power`.
    """
    found = []
    for own in log_likelihood.double().T:
        possible = own[own.isfinite()]
        if not len(possible):
            found.append(own.new_tensor(-math.inf))
            continue
        weights, _ = pareto_smoothed(-power * possible)
        found.append(torch.logsumexp(weights + possible, 0))
    return torch.stack(found)


def lead_of_training(
    train: Demonstrations, log_probabilities: Tensor, actions: int, power: float
) -> Tensor:
    """Log density ``[B]`` of each training round given the others minus that of action shares.

    Args:
        train: training rounds of one person.
        log_probabilities: of actions there, ``[S, 1, B, T, A]``.
        actions: number of actions A.
        power: :attr:`HumanModel.likelihood_power`.

    Returns:
        Nats of each round with a decision; empty if there is but one, which has no others.
    """
    real = train.mask[0].any(-1)
    if int(real.sum()) < LEAST_ROUNDS:
        return torch.zeros(0)
    density = chosen_log_probability(log_probabilities, train).sum(-1)[:, 0]  # [S, B]
    done = torch.nn.functional.one_hot(train.actions[0].clamp(min=0), actions)
    counts = (done * train.mask[0, ..., None]).sum(1)  # [B, A]
    others = counts.sum(0) - counts + 1 / 2
    shares = (others / others.sum(-1, True)).log()
    return (left_out(density[:, real], power) - (counts * shares).sum(-1)[real]).float()


def no_implants(
    self_model: SelfModel, train: Demonstrations, test: Demonstrations, seed: int
) -> Tensor:
    """Negative log-likelihood of held-out actions ``[N']`` of one person without implants.

    This baseline is the robot, which sees everything; its consistency and lapse are inferred.
    """
    human = load_human_model("no-implants", self_model)
    if bool(train.mask.any()):
        with forked():
            seed_everything(seed)
            views = ViewTableBuilder(human, None)
            views.add(rounds_of(train, 0))
            weighted = sample_importance(human, views.table(), QUICK)
            drawn = weighted.sample(DRAWS, grid_of(perceived_sites(human)))
    else:
        drawn = draw_prior(human, 1, DRAWS, seed % 2**32)
    found = predict_rounds(human, test, drawn).cpu()
    mixed = chosen_log_probability(predictive(found)[None], test.to("cpu"))
    return -mixed[0, test.mask.cpu()]


def criticize(
    human: HumanModel,
    rounds: tuple[Demonstrations, Demonstrations | None],
    log_probabilities: tuple[Tensor, Tensor | None],
    draws: Mapping[str, Tensor],
    seed: int,
) -> dict[str, Any]:
    """Check whether the model explains one person; the result is stored in ``summary.json``.

    Args:
        human: the model of people.
        rounds: training rounds of one person, and held-out rounds, if any.
        log_probabilities: log-probabilities of actions there, ``[S, 1, B, T, A]``.
        draws: posterior draws of the person's implants ``[S, 1, 1, ...]``.
        seed: seed of all random draws.

    Returns:
        ``verdict``, ``reasons``, ``p_values`` by name, ``nll_base_rate`` and ``nll_no_implants``
        (``None`` without held-out rounds).
    """
    domain, (train, test) = human.domain, rounds
    steps = steps_of(domain, train.to("cpu"), log_probabilities[0])
    generator = torch.Generator().manual_seed(seed)
    found = p_values(steps, domain.actions, generator)
    found |= perception_p_values(human, train, draws, generator)
    own, power = train.to("cpu"), human.likelihood_power
    leads = [lead_of_training(own, log_probabilities[0], len(domain.actions), power)]
    number = int(own.mask.sum()) if len(leads[0]) else 0
    often = robot = None
    if test is not None and log_probabilities[1] is not None and bool(test.mask.any()):
        own = test.to("cpu")
        often = base_rate(train.to("cpu"), own, len(domain.actions))
        mixed = predictive(log_probabilities[1])[None]
        lead = torch.zeros(own.mask.shape[1:]).to(often)
        lead[own.mask[0]] = often + chosen_log_probability(mixed, own)[0, own.mask]
        leads.append(lead.sum(-1)[own.mask[0].any(-1)])
        number += len(often)
        if isinstance(human.self_model, SelfModel):
            robot = no_implants(human.self_model, train, test, seed)
    judged = verdict(found, torch.cat(leads), number)
    return {
        "verdict": judged.word,
        "reasons": list(judged.reasons),
        "p_values": found,
        "nll_base_rate": None if often is None else float(often.mean()),
        "nll_no_implants": None if robot is None else float(robot.mean()),
    }


def models_of(human: OneOfKinds, kind: Tensor) -> dict[str, float]:
    """Posterior probability of each model of a family, from draws ``[S]`` of a person's kind.

    See :class:`mirror_ppl.models.family.OneOfKinds`.
    """
    names = human.value_names[KIND]
    often = torch.bincount(kind.long().flatten(), minlength=len(names)) / kind.numel()
    return dict(zip(names, often.tolist(), strict=True))
