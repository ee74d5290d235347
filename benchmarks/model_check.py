"""Whether a fit notices people whom its human model does not explain.

    python -m benchmarks.model_check --out docs/results/model_check.csv

People of several kinds, drawn from the prior of the human model but for what their kind says, drive
in fog, 20 rounds to learn from and 6 held out. This counts verdicts; the sight thresholds that 90%
intervals hold, of all people and of those who are ``ok``; people who are ``ok`` although a 99%
interval leaves a threshold out; and, with the human model ``all``, which of its models is the most
probable one. The tables of docs/trust.md are printed.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import torch
import tyro
import xarray as xr
from torch import Tensor

import mirror_ppl
from mirror_ppl.arviz import az
from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.models import HumanModel, Implants
from mirror_ppl.models.family import AnyKind, Forgetting, Late
from mirror_ppl.models.implants import reach, sight_sites
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.plots.model_check import plot_model_check

SHOWN = 3
"""People of each kind in the picture."""


class NoticesHalf(HumanModel):
    """Each thing in reach is noticed half of the time, by chance at every step; not the program of
    the family, but people as others would write them.
    """

    def sees(self, implants: Implants, observation: Observation, step: int) -> Visibility:
        """Half of what is in reach."""
        masks = super().sees(implants, observation, step)
        # Of this step alone: the global random state is the same at each.
        generator = torch.Generator().manual_seed(step)
        noticed = torch.rand(masks["visual"].shape, generator=generator) < 1 / 2
        return {name: mask & noticed for name, mask in masks.items()}


class Staying(HumanModel):
    """Dislikes to switch lanes: by 1.5 on logits."""

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """The first action is to stay."""
        logits = super().act(implants, belief, values)
        liked = torch.zeros(logits.shape[-1])
        liked[0] = 1.5
        return torch.log_softmax(logits + liked, -1)


class OtherGoal(HumanModel):
    """Does what the robot would avoid."""

    def act(self, implants: Implants, belief: Tensor, values: Tensor) -> Tensor:
        """Values with the other sign, half as strong."""
        return super().act(implants, belief, -values / 2)


def kinds(self_model: SelfModel) -> dict[str, tuple[HumanModel, dict[str, float]]]:
    """Kinds of people: their program, and values of sites that all of them have."""
    own = HumanModel(self_model)
    return {
        "as modelled": (own, {}),
        "a step late": (Late(self_model), {"late": 1.0}),
        "two steps late": (Late(self_model), {"late": 2.0}),
        "notices half": (NoticesHalf(self_model), {}),
        "mostly forgets": (Forgetting(self_model), {"forgets": 0.8}),
        "dislikes switching": (Staying(self_model), {}),
        "another goal": (OtherGoal(self_model), {}),
        "a fifth at random": (own, {"lapse": 0.2}),
    }


def drawn_implants(
    human: HumanModel, known: dict[str, float], people: int, seed: int
) -> dict[str, Tensor]:
    """Draw implants ``[P, 1, ...]`` from a program's prior, but for values that are known."""
    implants = {site: value[0] for site, value in draw_prior(human, people, 1, seed).items()}
    return implants | {site: torch.full_like(implants[site], known[site]) for site in known}


@dataclass(frozen=True)
class Options:
    """What is measured.

    Attributes:
        seeds: of people and rounds.
        people: of each kind and seed.
        kinds: of people, all unless given.
        human_models: that are fitted.
        out: file for the table; what is there is not done again. Printed alone unless given.
        picture: file for the checks of the first three of each kind.
    """

    seeds: tuple[int, ...] = (0, 1, 2, 3)
    people: int = 5
    kinds: tuple[str, ...] = ()
    human_models: tuple[str, ...] = ("mirror", "all")
    out: Path | None = None
    picture: Path | None = None


def found(fit: mirror_ppl.Fit, truth: Tensor) -> dict[str, float]:
    """Verdicts, thresholds held, and most probable models; truth is ``[P, D]``."""
    sites, check = sight_sites(fit.human.domain), fit.check
    ends = fit.data["posterior"][list(sites)].quantile((0.005, 0.995), ("chain", "draw"))
    low, high = ends.to_array().transpose("quantile", "person", "variable").values
    outside = ((truth.numpy() < low) | (truth.numpy() > high)).any(-1)
    held = [
        sum(
            own["implants"][site]["q05"] <= float(value) <= own["implants"][site]["q95"]
            for site, value in zip(sites, reached, strict=True)
        )
        / len(sites)
        for own, reached in zip(fit.summary["people"], truth, strict=True)
    ]
    verdicts, held = check["verdict"].value_counts(), pd.Series(held, check.index)
    counts = {name: int(verdicts.get(name, 0)) for name in ("ok", "suspect", "unexplained")}
    counts["ok_outside"] = int((outside & (check["verdict"] == "ok")).sum())
    rates = {"held": held.mean(), "held_of_ok": held[check["verdict"] == "ok"].mean()}
    models = [own["check"].get("models", {}) for own in fit.summary["people"]]
    best = pd.Series([max(one, key=one.__getitem__, default="") for one in models]).value_counts()
    return (
        {"people": len(held)}
        | counts
        | rates
        | {name: best.get(name, 0) for name in AnyKind.members}
    )


def together(rows: pd.DataFrame) -> pd.DataFrame:
    """Counts of all seeds, and rates over all of their people."""
    rows = rows.assign(
        held=rows["held"] * rows["people"], held_of_ok=rows["held_of_ok"].fillna(0) * rows["ok"]
    )
    sums = rows.drop(columns="seed").groupby(["kind", "human_model"], sort=False).sum()
    return sums.assign(
        held=sums["held"] / sums["people"], held_of_ok=sums["held_of_ok"] / sums["ok"]
    ).round(3)


def verdict_table(rows: pd.DataFrame) -> str:
    """Return the table of verdicts with `mirror`."""
    lines = [
        "| Kind | ok | suspect | unexplained | held | held, of those `ok` | `ok`, outside 99% |",
        "|---" * 7 + "|",
    ]
    for (kind, fitted), row in together(rows).iterrows():
        if fitted == "mirror":
            of_ok = f"{row['held_of_ok']:.0%}" if row["ok"] else "-"
            counts = " | ".join(f"{row[name]:.0f}" for name in ("ok", "suspect", "unexplained"))
            cells = f"{counts} | {row['held']:.0%} | {of_ok} | {row['ok_outside']:.0f}"
            lines.append(f"| {kind} | {cells} |")
    return "\n".join(lines)


def model_table(rows: pd.DataFrame) -> str:
    """Return the table of the most probable models."""
    names = list(AnyKind.members)
    lines = [
        f"| Kind | most probable: {' | '.join(f'`{name}`' for name in names)} "
        "| held by `all` (by `mirror`) |",
        "|---" * (len(names) + 2) + "|",
    ]
    every = together(rows)
    for kind in dict.fromkeys(kind for kind, _ in every.index):
        own, mirror = every.loc[kind, "all"], every.loc[kind, "mirror"]
        counts = " | ".join(f"{own[name]:.0f}" for name in names)
        lines.append(f"| {kind} | {counts} | {own['held']:.0%} ({mirror['held']:.0%}) |")
    return "\n".join(lines)


def main(options: Options) -> None:
    """Run the study."""
    torch.set_num_threads(1)
    self_model, _ = load_self_model(shipped_weights("driving"))
    kept = pd.read_csv(options.out) if options.out and options.out.exists() else pd.DataFrame()
    rows, shown = kept.to_dict("records"), []
    done = {(row["kind"], row["seed"], row["human_model"], row["people"]) for row in rows}
    every, asked = kinds(self_model), set()
    for kind, seed in itertools.product(options.kinds or every, options.seeds):
        human, known = every[kind]
        implants = drawn_implants(human, known, options.people, seed)
        generator = torch.Generator().manual_seed(seed)
        recordings = play_rounds(human, implants, 26, "fog", generator)
        truth = reach(human.domain, implants)[:, 0]
        for fitted in options.human_models:
            cell = kind, seed, fitted, options.people
            asked.add(cell)
            pictured = options.picture is not None and seed == options.seeds[0]
            pictured &= fitted == options.human_models[0]
            if cell in done and not pictured:
                continue
            fit = mirror_ppl.infer(recordings, human=fitted, seed=seed, train_rounds=20)
            if pictured:
                first = fit.data["model_check"].isel(person=slice(SHOWN))
                names = [f"{kind} {number + 1}" for number in range(len(first["person"]))]
                shown.append(first.assign_coords(person=names))
            if cell in done:
                continue
            rows.append({"kind": kind, "seed": seed, "human_model": fitted} | found(fit, truth))
            if options.out is not None:  # so that what is done is kept
                frame = pd.DataFrame(rows).astype({"ok_outside": "Int64"})
                frame.to_csv(options.out, index=False, float_format="%.3f")
            print(pd.DataFrame(rows[-1:]).to_string(index=False), flush=True)
    table = pd.DataFrame(rows)
    cells = zip(table["kind"], table["seed"], table["human_model"], table["people"], strict=True)
    table = table[[cell in asked for cell in cells]]
    if "mirror" in options.human_models:
        print(verdict_table(table))
    if {"mirror", "all"} <= set(options.human_models):
        print(model_table(table))
    if options.picture is not None:
        joined = az.InferenceData(model_check=xr.concat(shown, "person"))
        options.picture.write_bytes(plot_model_check(joined).content())


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
