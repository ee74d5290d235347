"""Whether every engine gives the posterior of the program that stands there.

    python -m benchmarks.one_program --output docs/results/one_program.csv

Two cases in which an engine that puts the density together again from parts goes wrong. The first
is one toy person with three rounds, whose program is left as it is or gets a factor, an observed
site or a scale in ``prior``, or a factor in ``act``: the posterior mean of the rate ``in_sight`` by
each engine beside the exact one, with its Monte Carlo error. The second is a questionnaire: ten
foggy drivers whose ``consistency`` was measured as 1.00 with an error of 0.01, and the medians that
follow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from time import perf_counter

import pandas as pd
import pyro
import pyro.distributions as dist
import torch
import tyro
from pyro import poutine
from torch import Tensor

from mirror_ppl.data import Demonstrations
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.engines import InferenceOptions, infer
from mirror_ppl.inference.nuts import NUTSOptions
from mirror_ppl.inference.svi import SVIOptions
from mirror_ppl.models import HumanModel
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.toy import ToyHuman, toy_posterior
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import simulate

CHANGES = ("none", "factor", "observed", "scale", "act")
"""What is changed of a toy: nothing, a factor, an observed site or a scale in ``prior``, or a
factor in ``act``."""
STEPS = 6
"""Steps of the toy's rounds: without compilation, each takes time."""
MEASURED, ERROR = 1.0, 0.01
"""The answer to the questionnaire, and its standard deviation."""


@dataclass(frozen=True)
class Options:
    """What to measure."""

    changes: tuple[str, ...] = CHANGES
    """What is changed of the toy."""
    people: int = 10
    """Number of people who answer the questionnaire; 0 leaves it out."""
    rounds: int = 20
    """Rounds of each of them."""
    steps: int = 1000
    """Steps of svi for the questionnaire, beside those it takes unless told."""
    draws: int = 1000
    """Posterior draws."""
    seed: int = 0
    """Seed of the engines."""
    output: Path | None = None
    """File for the table, as CSV."""


def toy(change: str, self_model: SelfModel) -> ToyHuman:
    """A toy person whose density of the first rate is changed."""

    class Changed(ToyHuman):
        def prior(self) -> dict[str, Tensor]:
            if change == "scale":
                with poutine.scale(scale=4.0):
                    return super().prior()
            implants = super().prior()
            if change == "factor":
                pyro.factor("more", 20 * torch.log(implants["in_sight"]))
            if change == "observed":
                answer = dist.Normal(implants["in_sight"], 0.05)
                pyro.sample("answer", answer, obs=torch.tensor(0.7))
            return implants

        def act(self, implants, belief, values) -> Tensor:
            if change == "act":
                pyro.factor("each", torch.log(implants["in_sight"]))
            return super().act(implants, belief, values)

    return Changed(self_model)


def own_program(change: str, self_model: SelfModel) -> ToyHuman:
    """A toy whose class overrides the program itself, so that nothing is compiled."""
    kind = type(toy(change, self_model))

    class Own(kind):
        def model(self, rounds: Demonstrations, world: bool = False) -> None:
            super().model(rounds, world)

    return Own(self_model)


def log_change(change: str, rate: Tensor, steps: int) -> Tensor:
    """What the change adds to the log density, as a function of the rate."""
    return {
        "none": 0 * rate,
        "scale": 3 * dist.Beta(2.0, 2.0).log_prob(rate),
        "factor": 20 * rate.log(),
        "observed": dist.Normal(rate, 0.05).log_prob(torch.tensor(0.7)),
        "act": steps * rate.log(),
    }[change]


def exact_mean(change: str, recordings: Demonstrations, self_model: SelfModel) -> float:
    """Posterior mean of the first rate, on a fine grid."""
    human, steps = toy("none", self_model), int(recordings.mask.sum())
    posterior = toy_posterior(human, recordings)
    # Given the bin, rates are independent; only the first is changed, and scaling the second
    # changes the bins.
    grid = (torch.arange(4000) + 0.5).double() / 4000
    first, second = posterior.rates["in_sight"][0], posterior.rates["otherwise"][0]
    of_first = dist.Beta(first[:, :1], first[:, 1:]).log_prob(grid)
    of_first = of_first + log_change(change, grid, steps)
    total = of_first.logsumexp(-1) - math.log(len(grid))
    if change == "scale":
        of_second = dist.Beta(second[:, :1], second[:, 1:]).log_prob(grid)
        of_second = of_second + 3 * dist.Beta(1.0, 4.0).log_prob(grid)
        total = total + of_second.logsumexp(-1) - math.log(len(grid))
    bins = torch.softmax(posterior.reach[0].log() + total, -1)
    return float(bins @ (of_first.softmax(-1) @ grid))


class Questionnaire(HumanModel):
    """The package's human model, with an answer beside the actions."""

    def prior(self) -> dict[str, Tensor]:
        """Sample the implants, and observe the answer."""
        implants = super().prior()
        answer = dist.Normal(implants["consistency"], ERROR)
        pyro.sample("measured_consistency", answer, obs=torch.tensor(MEASURED))
        return implants


def begun(rounds: Demonstrations, steps: int) -> Demonstrations:
    """The first steps of rounds."""
    variables = rounds.variables()
    cut = {"ego": steps + 1, **dict.fromkeys(rounds.observations, steps + 1)}
    variables = {
        name: value[:, :, : cut.get(name, steps)] if value.dim() > 2 else value  # noqa: PLR2004
        for name, value in variables.items()
    }
    variables["length"] = variables["length"].clamp(max=steps)
    return Demonstrations.from_variables(rounds.domain, rounds.setting, rounds.people, variables)


def toys(options: Options, self_model: SelfModel) -> Iterator[dict]:
    """Rows of the first case."""
    rounds = begun(simulate("driving", "fog", "paper", 1, 3, 100), STEPS)
    engines = {
        "importance": (toy, InferenceOptions("importance", options.draws)),
        "svi": (toy, InferenceOptions("svi", options.draws)),
        "nuts": (toy, InferenceOptions("nuts", options.draws // 5, NUTSOptions(60))),
        "svi, own model()": (own_program, InferenceOptions("svi", options.draws)),
        "nuts, own model()": (
            own_program,
            InferenceOptions("nuts", options.draws // 5, NUTSOptions(60)),
        ),
    }
    for change in options.changes:
        exact = exact_mean(change, rounds, self_model)
        for name, (kind, engine) in engines.items():
            start = perf_counter()
            try:
                found = infer(kind(change, self_model), rounds, engine, options.seed)
            except HumanModelError as error:
                yield {"case": f"toy: {change}", "engine": name, "refused": str(error)}
                continue
            draws = found.draws["in_sight"].flatten().double()
            yield {
                "case": f"toy: {change}",
                "engine": name,
                "exact": exact,
                "mean": float(draws.mean()),
                "standard_error": _standard_error(draws),
                "seconds": perf_counter() - start,
            }


def _standard_error(draws: Tensor) -> float:
    """Standard error of the mean of draws ``[S]``, by 20 batch means: chains are correlated."""
    batches = draws[: len(draws) // 20 * 20].view(20, -1).mean(-1)
    return float(batches.std() / math.sqrt(20))


def questionnaires(options: Options, self_model: SelfModel) -> Iterator[dict]:
    """Rows of the second case: the smallest and the largest of the people's medians."""
    rounds = simulate("driving", "fog", "paper", options.people, options.rounds, 100)
    engines = {
        "importance": InferenceOptions("importance", options.draws),
        "svi": InferenceOptions("svi", options.draws),
        f"svi, {options.steps} steps": InferenceOptions(
            "svi", options.draws, replace(SVIOptions(), steps=options.steps)
        ),
    }
    for name, engine in engines.items():
        for kind in (HumanModel, Questionnaire):
            start = perf_counter()
            found = infer(kind(self_model), rounds, engine, options.seed)
            medians = found.draws["consistency"].flatten(1).median(0).values
            yield {
                "case": "ten drivers" + (": questionnaire" if kind is Questionnaire else ""),
                "engine": name,
                "least_median": float(medians.min()),
                "most_median": float(medians.max()),
                "seconds": perf_counter() - start,
            }


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options, description=__doc__)
    self_model = load_self_model(shipped_weights("driving"))[0]
    rows = []
    asked = questionnaires(options, self_model) if options.people else ()
    for row in chain(toys(options, self_model), asked):
        numbers = {n: f"{v:.3f}" for n, v in row.items() if isinstance(v, float)}
        print({**row, **numbers}, flush=True)
        rows.append(row)
        if options.output is not None:
            pd.DataFrame(rows).to_csv(options.output, index=False, float_format="%.4f")


if __name__ == "__main__":
    main()
