"""Summaries of pairings of communicators with people: means, differences, intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mirror_ppl.evaluation.played import Played

RESAMPLES = 2000
LEVELS = (0.05, 0.95)


def summarize_assistance(
    played: Mapping[str, Sequence[Played]], seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Summarize each communicator's rounds.

    Args:
        played: for each communicator the R rounds of each of P people, the same for all.
        seed: of the bootstrap.

    Returns:
        By name: means per round of ``task``, ``cost``, ``net`` and ``mishaps``; ``net_se``, the
        standard error of ``net`` given these people (rounds are the sample); by modality ``items``
        a step; ``relevant``, the share of relevant items by notion, over all items and by modality
        (``None`` where none were communicated); ``milliseconds`` a decision; ``over_none`` and
        ``way_to_oracle``, each a mean with a 90% interval of the paired bootstrap over the rounds
        of each person (``low`` and ``high`` are ``None`` if there is one round of each), where
        those communicators are among them.
    """
    net = {name: np.stack([one.net for one in people]) for name, people in played.items()}
    people, rounds = next(iter(net.values())).shape
    generator = np.random.default_rng(seed)
    drawn = generator.integers(rounds, size=(RESAMPLES, people, rounds))
    means = {
        name: np.take_along_axis(value[None], drawn, 2).mean((1, 2)) for name, value in net.items()
    }
    summary: dict[str, dict[str, Any]] = {}
    for name, parts in played.items():
        entry: dict[str, Any] = {
            "task": _mean(parts, "task"),
            "cost": _mean(parts, "cost"),
            "net": float(net[name].mean()),
            "net_se": float(np.sqrt((net[name].var(1, ddof=1) / rounds).sum()) / people)
            if rounds > 1
            else None,
            "net_by_person": net[name].mean(1).tolist(),
            "mishaps": _mean(parts, "mishaps"),
            "items": {
                modality: sum(sum(part.items[modality]) for part in parts)
                / sum(part.steps for part in parts)
                for modality in parts[0].items
            },
            "relevant": _relevance(parts),
            "milliseconds": float(np.mean([part.milliseconds for part in parts])),
        }
        if "none" in net:
            entry["over_none"] = _interval(
                float((net[name] - net["none"]).mean()), means[name] - means["none"], rounds
            )
        if "none" in net and "oracle" in net:
            way = net["oracle"].mean() - net["none"].mean()
            ways = means["oracle"] - means["none"]
            if way > 0 and (ways > 0).all():
                entry["way_to_oracle"] = _interval(
                    float((net[name].mean() - net["none"].mean()) / way),
                    (means[name] - means["none"]) / ways,
                    rounds,
                )
        summary[name] = entry
    return summary


def compare(
    played: Mapping[str, Sequence[Played]], one: str, other: str, seed: int = 0
) -> dict[str, float | None]:
    """Mean difference of two communicators' net returns, with its interval."""
    difference = np.stack([a.net - b.net for a, b in zip(played[one], played[other], strict=True)])
    people, rounds = difference.shape
    drawn = np.random.default_rng(seed).integers(rounds, size=(RESAMPLES, people, rounds))
    means = np.take_along_axis(difference[None], drawn, 2).mean((1, 2))
    return _interval(float(difference.mean()), means, rounds)


def _mean(parts: Sequence[Played], name: str) -> float:
    return float(np.mean([getattr(part, name) for part in parts]))


def _interval(mean: float, resampled: np.ndarray, rounds: int) -> dict[str, float | None]:
    if rounds == 1:  # the bootstrap of a single round has no spread
        return {"mean": mean, "low": None, "high": None}
    low, high = np.quantile(resampled, LEVELS)
    return {"mean": mean, "low": float(low), "high": float(high)}


def _relevance(parts: Sequence[Played]) -> dict[str, dict[str, float | None]]:
    told = {name: int(np.sum([part.items[name] for part in parts])) for name in parts[0].items}
    result = {}
    for notion in parts[0].relevant:
        right = {
            name: int(np.sum([part.relevant[notion][name] for part in parts])) for name in told
        }
        total, good = sum(told.values()), sum(right.values())
        result[notion] = {"all": good / total if total else None} | {
            name: right[name] / told[name] if told[name] else None for name in told
        }
    return result
