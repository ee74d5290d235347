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
from mirror_ppl.inference.results.checks import (
    CHECKS,
    ONE_SIDED,
    REPLICATES,
    SHARE,
    p_values,
    steps_of,
    tail,
)
from mirror_ppl.inference.results.left_out import LeftOut, left_out
from mirror_ppl.inference.results.perception_checks import perception_p_values
from mirror_ppl.inference.results.posterior_predictive import chosen_log_probability, predict_rounds
from mirror_ppl.inference.results.summary import predictive
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
NLLS = "nll_base_rate", "nll_no_implants", "nll_left_out", "nll_left_out_base_rate"
"""Stored negative log-likelihoods, in nats an action: of held-out rounds, and the last two of
training rounds, each predicted from the others."""
LEFT_OUT = (*NLLS[2:], "pareto_k_left_out")
"""What is stored of training rounds that are predicted from the others."""
LEVEL = 0.05
"""Largest probability that a person whom the model explains is suspect."""
SURELY_WORSE = 0.975
"""One-sided confidence at which predictions have to be worse to count without other reasons."""
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


@dataclass(frozen=True)
class Comparison:
    """Comparison of the model with action shares: which predicts rounds better from others.

    Attributes:
        difference: log density of each round by the model minus that by action shares, ``[B]``.
        actions: number of actions in all of these rounds.
    """

    difference: Tensor
    actions: int

    @property
    def total(self) -> float:
        """Nats by which the model is better."""
        return float(self.difference.sum())

    @property
    def sure(self) -> bool:
        """True if the model is worse with a confidence of :data:`SURELY_WORSE`."""
        from scipy.stats import t

        if not math.isfinite(self.total):
            return True
        # Rounds are the sample: actions within a round depend on each other.
        number = len(self.difference)
        if number < 2:  # noqa: PLR2004 - no spread
            return False
        error = float(self.difference.std()) * number**0.5
        return self.total < -float(t.ppf(SURELY_WORSE, number - 1)) * error


def verdict(found: Mapping[str, float], comparisons: Sequence[Comparison] = ()) -> Verdict:
    """Compute the verdict on a person.

    ``suspect``: a p-value so near to 0 or 1 that at most a share :data:`LEVEL` of people whom the
    model explains have one (Bonferroni over checks). ``unexplained``: by one of the comparisons,
    the model predicts actions worse than the action shares of other rounds do, and the person is
    suspect, or it does with a confidence of :data:`SURELY_WORSE` (Student's t over rounds).
    ``unchecked``: there are no training rounds.

    Args:
        found: p-values, see :func:`p_values`.
        comparisons: of the model with those shares.
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
    worse = [one for one in comparisons if one.total < 0 and (reasons or one.sure)]
    if worse:
        word = UNEXPLAINED
        nats = max(-one.total / one.actions for one in worse)
        reasons.append(
            f"from other rounds, actions are predicted {nats:.3f} nats worse than by how often "
            "each was chosen there"
        )
    return Verdict(word, tuple(reasons))


def warning_of(people: Sequence[str], anyway: str, planned: bool) -> str:
    """Return what to say to those who plan messages for people who are not explained.

    Args:
        people: their ids.
        anyway: setting by which messages are planned for them.
        planned: True if it is given.
    """
    what = "these may do harm" if planned else f"{anyway} plans some all the same"
    messages = "messages are planned for them" if planned else "no messages are planned for them"
    return (
        f"the human model does not explain the actions of {', '.join(people)} (verdict "
        f"{UNEXPLAINED}): {messages}, and {what}; another human model may explain their actions"
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
            drawn = weighted.sample(DRAWS, views.grid)
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
        (``None`` without held-out rounds), and :data:`LEFT_OUT` (``None`` where there are no such
        predictions, see :func:`left_out`; Pareto k also where all weights are equal).
    """
    domain, (train, test) = human.domain, rounds
    steps = steps_of(domain, train.to("cpu"), log_probabilities[0])
    generator = torch.Generator().manual_seed(seed)
    found = p_values(steps, domain.actions, generator)
    found |= perception_p_values(human, train, draws, generator)
    comparisons, often, robot = [], None, None
    if test is not None and log_probabilities[1] is not None and bool(test.mask.any()):
        own = test.to("cpu")
        often = base_rate(train.to("cpu"), own, len(domain.actions))
        mixed = predictive(log_probabilities[1])[None]
        lead = torch.zeros(own.mask.shape[1:]).to(often)
        lead[own.mask[0]] = often + chosen_log_probability(mixed, own)[0, own.mask]
        comparisons.append(Comparison(lead.sum(-1)[own.mask[0].any(-1)].double(), len(often)))
        if isinstance(human.self_model, SelfModel):
            robot = no_implants(human.self_model, train, test, seed)
    if (others := left_out(human, train.to("cpu"), log_probabilities[0])) is not None:
        every = [one.difference for one in comparisons] + [others.difference]
        actions = sum(one.actions for one in comparisons) + others.actions
        comparisons.append(Comparison(torch.cat(every), actions))
    judged = verdict(found, comparisons)
    return {
        "verdict": judged.word,
        "reasons": list(judged.reasons),
        "p_values": found,
        "nll_base_rate": None if often is None else float(often.mean()),
        "nll_no_implants": None if robot is None else float(robot.mean()),
    } | _of_left_out(others)


def _of_left_out(others: LeftOut | None) -> dict[str, float | None]:
    """Training rounds, each predicted from the others: nats an action, and Pareto k."""
    if others is None:
        return dict.fromkeys(LEFT_OUT)
    nats = [-float(one.sum()) / others.actions for one in (others.model, others.shares)]
    known = [value if math.isfinite(value) else None for value in (*nats, others.pareto_k)]
    return dict(zip(LEFT_OUT, known, strict=True))


def models_of(human: OneOfKinds, kind: Tensor) -> dict[str, float]:
    """Posterior probability of each model of a family, from draws ``[S]`` of a person's kind.

    See :class:`mirror_ppl.models.family.OneOfKinds`.
    """
    names = human.value_names[KIND]
    often = torch.bincount(kind.long().flatten(), minlength=len(names)) / kind.numel()
    return dict(zip(names, often.tolist(), strict=True))
