# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Can this posterior be trusted?
#
# A posterior that is sure of the wrong thing is worse than none: a robot that believes it will
# keep silent when it should speak. This notebook asks of posteriors
#
# 1. whether different ways to compute them agree,
# 2. how they grow round by round, while somebody drives,
# 3. whether they are calibrated,
# 4. what they leave open, and which rounds would tell,
# 5. what other people tell about a person before they have done anything,
# 6. and whether another model of people would do better.

# %%
import os
import tempfile
import warnings
from pathlib import Path
from time import perf_counter

import numpy as np
import pandas as pd
import torch

# Whether Jupyter's widgets are installed does not matter here.
warnings.filterwarnings("ignore", message="IProgress not found")

import mirror_ppl
from mirror_ppl.models.implants import sight_sites
from mirror_ppl.plots.picture import Picture

# The networks are small: one thread is as fast as several.
torch.set_num_threads(1)
# The project's tests run this notebook with few people, rounds and steps.
quick = os.environ.get("MIRROR_PPL_QUICK") == "1"

recordings = mirror_ppl.load_recordings(setting="fog", population="paper")
rounds, draws = (3, 30) if quick else (20, 200)

# %% [markdown]
# ## 1. Do they agree?
#
# Every engine sums what a person sees out exactly: all combinations of thresholds are tried. How
# they decide is
#
# - `importance`: drawn by adaptive importance sampling;
# - `amortized`: proposed by a network that learned from a thousand simulated people, and corrected
#   by importance weights;
# - `svi`: fitted by a mean-field Gaussian.
#
# On the command line: `python -m mirror_ppl.fit --guide amortized`, and so on.

# %%
person = "person-04"
one = recordings.select_people([person])
fits, seconds = {}, {}
for engine in ("importance", "amortized", "svi"):
    began = perf_counter()
    fits[engine] = mirror_ppl.infer(one, engine=engine, draws=400, train_rounds=rounds, explore=0)
    seconds[engine] = perf_counter() - began
posteriors = {engine: fit.posterior for engine, fit in fits.items()}

human = fits["importance"].human
bins = human.domain.reach_bins
figure = Picture(figsize=(11, 3), layout="constrained")
axes = figure.subplots(1, 5, width_ratios=[1, 1, 1, 1, 1.4])
for ax, site in zip(axes, sight_sites(human.domain), strict=False):
    for shift, (name, found) in zip((-0.27, 0, 0.27), posteriors.items(), strict=True):
        share = torch.bincount(found.draws[site].flatten(), minlength=len(bins)) / 400
        ax.bar(np.arange(len(bins)) + shift, share, 0.27, label=name)
    truth = one.truth[site][0]
    ax.set_title(f"{site.replace('_', ' ')} (truth {truth:g})", fontsize=10)
    ax.set_xticks(range(len(bins)), [f"{value:g}" for value in bins])
    ax.set_ylim(0, 1)
for name, found in posteriors.items():
    values = found.draws["consistency"].flatten().sort().values
    axes[-1].plot(values, torch.linspace(0, 1, len(values)), label=name)
axes[-1].set_title("consistency (cumulated)", fontsize=11)
axes[0].set_ylabel("probability")
figure.legend(*axes[-1].get_legend_handles_labels(), loc="outside lower center", ncols=3)
figure

# %%
pd.DataFrame(
    {
        "seconds": {name: round(value, 1) for name, value in seconds.items()},
        "Pareto k": {
            name: None if found.pareto_k is None else round(float(found.pareto_k[0]), 2)
            for name, found in posteriors.items()
        },
    }
)

# %% [markdown]
# About sight they agree. About `consistency` the mean-field guide may be off a little: it cannot
# express how consistency and lapses depend on one another. Pareto *k* below 0.7 says that the
# importance weights of the other two are to be relied on.
#
# ## 2. Round by round
#
# The likelihood is a product over rounds, so a round more is one more factor, and with the
# network's proposals the posterior is there again at once. A robot can ask after every round.

# %%
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.training.guide_file import load_guide, shipped_guide

network, _ = load_guide(shipped_guide("driving"), human)
figure = Picture(figsize=(9, 3.4), layout="constrained")
left, right = figure.subplots(1, 2)
milliseconds = []
for name in ["person-02", person]:
    online, known = OnlinePosterior(human, network), []
    for number in range(rounds):
        online.add(recordings.select_people([name]).select_rounds([number]))
        reach = online.draws(200)["sight_front_own"].flatten()
        known.append(float((reach == bins.index(2)).float().mean()))
        milliseconds.append(1000 * sum(online.seconds))
    left.plot(range(1, rounds + 1), known, marker="o", ms=4, label=name)
    right.plot(range(1, rounds + 1), milliseconds[-rounds:], marker="o", ms=4, label=name)
left.set_title("Probability that they see two cells ahead (they do)", fontsize=11)
right.set_title("Milliseconds for one more round and 200 draws", fontsize=11)
left.set_ylim(0, 1.03)
right.set_ylim(0, None)
for ax in (left, right):
    ax.set_xlabel("rounds")
    ax.set_xticks(range(0, rounds + 1, 5))
    ax.legend(frameon=False)
figure

# %% [markdown]
# The first rounds take longest: nearly everything is possible still, and has to be looked at.
#
# ## 3. Are they calibrated?
#
# **Simulation-based calibration.** Draw people from the prior, let them drive, infer them. If
# inference is right, the truth is as likely to be at any place among the posterior draws: its rank
# is uniform. An interval of 90% then holds the truth of 90% of them. Here are a few people only;
# `python -m mirror_ppl.calibrate --guide amortized` does five hundred, and returns exit status 1 if
# calibration is rejected.

# %%
from mirror_ppl.inference.calibration.study import CalibrationOptions, calibrate
from mirror_ppl.inference.engines import InferenceOptions, infer

settings = InferenceOptions("amortized", 50)


def by_network(recordings, seed):
    """The posterior that is to be tested."""
    return infer(human, recordings, settings, seed, network)


calibration = calibrate(
    human,
    by_network,
    CalibrationOptions(people=6 if quick else 40, rounds=(1, 2) if quick else (1, 5)),
    "fog",
    seed=0,
)
print("rejected:", calibration.rejected or "nothing")
columns = ["site", "rounds", "p_value", "coverage_50", "coverage_90", "sharpness"]
calibration.table()[columns].round(2)

# %%
from mirror_ppl.plots.calibration import plot_ecdf

plot_ecdf(calibration)

# %% [markdown]
# Lines inside the bands are what a right posterior looks like. *Sharpness* tells what it is worth:
# 1 says no more than the prior, 0 is sure.
#
# ## 4. What is open, and which rounds would tell
#
# Somebody who drives oddly may not see, or may decide oddly. How much of what is open about their
# sight hangs on how they decide is the mutual information of the two in the posterior. And the
# model itself can play rounds in each scenario and tell how much each would narrow down.
# `python -m mirror_ppl.fit` writes this picture as `open.png`.

# %%
some = recordings.select_people(recordings.people[: 2 if quick else 6])
settings = {"draws": draws, "train_rounds": rounds}
fit = mirror_ppl.infer(some, explore=1 if quick else 8, **settings)
fit.plot.identifiability()

# %% [markdown]
# Little is hatched: the prior keeps the policy implant so small that it can hardly imitate
# blindness. What is open is how far they see where nobody's driving depended on it, and the right
# half says which rounds to record next: those in which more than one car closes in.
#
# ## 5. What others tell about a person
#
# All these people drive in the same fog. With **partial pooling** the population that they are
# from is inferred with them: its hyper-parameters are sample sites of a Pyro program above the
# human model, and people lean on one another as much as they are alike.
# (`python -m mirror_ppl.fit --pooling partial`.)

# %%
together = mirror_ppl.infer(some, pooling="partial", explore=0, **settings)


def right(draws, site, value):
    """Probability of the true value, of each person."""
    return (draws[site][..., 0] == value).float().mean(0).numpy().round(2)


pd.DataFrame(
    {
        (site, how): right(posterior.draws, site, value)
        for site, value in {"sight_front_other": 2, "sight_back_other": 0}.items()
        for how, posterior in {"alone": fit.posterior, "pooled": together.posterior}.items()
    },
    index=list(some.people),
).rename_axis("probability of the truth")

# %% [markdown]
# A population is worth most where a person has done little. Somebody *else*, of whom there is no
# round at all ("round zero") or one: how well are their actions predicted, with the prior and with
# the population as a prior? (`python -m mirror_ppl.fit --prior-from runs/pooled/posterior.nc`.)

# %%
from mirror_ppl.people import simulate

others = simulate("driving", "fog", "paper", 2 if quick else 6, 40, 11)
folder = tempfile.TemporaryDirectory()
together.save(folder.name)
rows = {}
for number in (0, 1):
    for how, prior in (("prior", None), ("population", Path(folder.name, "posterior.nc"))):
        known = mirror_ppl.infer(
            others, prior_from=prior, draws=draws, train_rounds=number, explore=0
        )
        tests = [person["test"] for person in known.summary["people"]]
        above = np.mean([test["nll"] - test["floor"] for test in tests])
        rows.setdefault(f"{number} rounds", {})[how] = round(float(above), 3)
pd.DataFrame(rows).T.rename_axis("nats an action above their own entropy")

# %% [markdown]
# ## 6. Would another model do better?
#
# Leave out what they see, or what sets their policy apart, or both, and compare how well each
# predicts rounds that it did not learn from. (`python -m mirror_ppl.fit --human-model policy-only`,
# then `python -m mirror_ppl.compare`; your own models go the same way.)

# %%
from mirror_ppl.evaluation.comparison import compare_fits, read_fit
from mirror_ppl.plots.comparison import plot_comparison

names = ["mirror", "perceptual-only", "policy-only", "no-implants"]
files = []
for name in names:
    own = fit if name == "mirror" else mirror_ppl.infer(some, human=name, explore=0, **settings)
    own.save(Path(folder.name, name))
    files.append(read_fit(Path(folder.name, name, "posterior.nc"), "heldout"))
folder.cleanup()
comparison = compare_fits(files, names, "heldout")
plot_comparison(comparison.table())

# %% [markdown]
# What these people *see* is what sets them apart from the robot. Without it, no policy implant
# makes up for it; with it, the residual is hardly needed, because simulated people want what the
# robot wants.
