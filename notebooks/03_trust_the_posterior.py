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
# A robot with a posterior that is certain and wrong stays silent when it should speak. This
# tutorial tests posteriors before they are used or reported:
#
# 1. do engines agree,
# 2. how does the posterior change with each round,
# 3. is it calibrated,
# 4. what do the data not identify, and which rounds would help,
# 5. what does a population add,
# 6. does another human model predict better?
#
# [Trust in a posterior](../docs/trust.md) has the methods and results of larger studies.

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
if quick:
    recordings = recordings.select_rounds(slice(0, 6))

# %% [markdown]
# ## 1. Agreement of engines
#
# Every engine sums out the discrete sites of sight exactly. They differ in the sites of the
# policy:
#
# - `importance`: adaptive importance sampling;
# - `amortized`: a network trained on simulated people proposes, importance weights correct;
# - `svi`: a mean-field Gaussian.
#
# On the command line: `python -m mirror_ppl.fit --guide amortized`.

# %%
person = "person-04"
one = recordings.select_people([person])
few_steps, count = ({"svi": {"steps": 10}}, 40) if quick else ({}, 400)
fits, seconds = {}, {}
for engine in ("importance", "amortized", "svi"):
    began = perf_counter()
    fits[engine] = mirror_ppl.infer(
        one,
        engine=engine,
        settings=few_steps.get(engine),
        draws=count,
        train_rounds=rounds,
        explore=0,
    )
    seconds[engine] = perf_counter() - began
posteriors = {engine: fit.posterior for engine, fit in fits.items()}

human = fits["importance"].human
bins = human.domain.reach_bins
figure = Picture(figsize=(11, 3), layout="constrained")
axes = figure.subplots(1, 5, width_ratios=[1, 1, 1, 1, 1.4])
for ax, site in zip(axes, sight_sites(human.domain), strict=False):
    for shift, (name, found) in zip((-0.27, 0, 0.27), posteriors.items(), strict=True):
        share = torch.bincount(found.draws[site].flatten(), minlength=len(bins)) / count
        ax.bar(np.arange(len(bins)) + shift, share, 0.27, label=name)
    truth = one.truth[site][0]
    ax.set_title(f"{site.replace('_', ' ')} (truth {truth:g})", fontsize=10)
    ax.set_xticks(range(len(bins)), [f"{value:g}" for value in bins])
    ax.set_ylim(0, 1)
for name, found in posteriors.items():
    values = found.draws["consistency"].flatten().sort().values
    axes[-1].plot(values, torch.linspace(0, 1, len(values)), label=name)
axes[-1].set_title("consistency (cumulative)", fontsize=11)
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
# The engines agree about sight. The mean-field guide cannot express the dependence of
# `consistency` and `lapse`, so its `consistency` may be off. A Pareto *k* below 0.7 means that
# importance weights are reliable.
#
# ## 2. Round by round
#
# The likelihood is a product over rounds, so a new round adds one factor. With proposals of the
# network a robot can update after every round.

# %%
from mirror_ppl.inference.online import OnlinePosterior
from mirror_ppl.training.guide_file import load_guide, shipped_guide

network, _ = load_guide(shipped_guide("driving"), human)
figure = Picture(figsize=(9, 3.4), layout="constrained")
left, right = figure.subplots(1, 2)
milliseconds = []
for name in ["person-02", person]:
    online, correct = OnlinePosterior(human, network), []
    for number in range(rounds):
        online.add(recordings.select_people([name]).select_rounds([number]))
        reach = online.draws(200)["sight_front_own"].flatten()
        correct.append(float((reach == bins.index(2)).float().mean()))
        milliseconds.append(1000 * sum(online.seconds))
    left.plot(range(1, rounds + 1), correct, marker="o", ms=4, label=name)
    right.plot(range(1, rounds + 1), milliseconds[-rounds:], marker="o", ms=4, label=name)
left.set_title("Probability of the truth: two cells ahead", fontsize=11)
right.set_title("Milliseconds for one more round and 200 draws", fontsize=11)
left.set_ylim(0, 1.03)
right.set_ylim(0, None)
for ax in (left, right):
    ax.set_xlabel("rounds")
    ax.set_xticks(range(0, rounds + 1, 5))
    ax.legend(frameon=False)
figure

# %% [markdown]
# The first rounds take longest, because few combinations of implants have been ruled out.
#
# ## 3. Calibration
#
# **Simulation-based calibration** draws people from the prior, simulates and fits them. If
# inference is correct, the rank of the truth among posterior draws is uniform and a 90% interval
# covers the truth of 90% of the people. A few people serve as an example; `python -m
# mirror_ppl.calibrate --guide amortized` takes five hundred and returns exit status 1 if
# calibration is rejected.

# %%
from mirror_ppl.inference.calibration.study import CalibrationOptions, calibrate
from mirror_ppl.inference.engines import InferenceOptions, infer

settings = InferenceOptions("amortized", 50)


def by_network(recordings, seed):
    """Infer by the amortized engine."""
    return infer(human, recordings, settings, seed, network)


calibration = calibrate(
    human,
    by_network,
    CalibrationOptions(people=3 if quick else 30, rounds=(1, 2) if quick else (1, 5)),
    "fog",
    seed=0,
)
print("rejected:", calibration.rejected or "nothing")
columns = ["site", "rounds", "p_value", "coverage_50", "coverage_90", "contraction"]
calibration.table()[columns].round(2)

# %%
from mirror_ppl.plots.calibration import plot_ecdf

plot_ecdf(calibration)

# %% [markdown]
# Lines within the bands are compatible with calibration. `contraction` is one less the width of the
# 90% interval relative to the prior's: 0 for the prior, 1 for certainty.
#
# ## 4. Identifiability
#
# Actions may be odd because of sight or because of the policy. The mutual information of the two
# in the posterior measures how much of the entropy of sight they share. The model also simulates
# further rounds in each scenario and reports the expected information gain. `python -m
# mirror_ppl.fit` writes this picture as `identifiability.png`.

# %%
some = recordings.select_people(recordings.people[: 2 if quick else 5])
settings = {"draws": draws, "train_rounds": rounds}
fit = mirror_ppl.infer(some, explore=1 if quick else 8, **settings)
fit.plot.identifiability()

# %% [markdown]
# Little is hatched: the prior keeps the policy residual too small to imitate blindness. Entropy
# remains about sight on which no action depended. The right half names the most informative
# scenarios for further rounds, those in which several cars close in.
#
# ## 5. Partial pooling
#
# All these people drive in the same fog. With **partial pooling** their population is inferred
# with them: its hyperparameters are sample sites above the human model, and estimates shrink
# towards each other as far as people are alike (`python -m mirror_ppl.fit --pooling partial`).

# %%
together = mirror_ppl.infer(some, pooling="partial", explore=0, **settings)


def of_truth(draws, site, value):
    """Posterior probability of the true value, of each person."""
    return (draws[site][..., 0] == value).float().mean(0).numpy().round(2)


pd.DataFrame(
    {
        (site, how): of_truth(posterior.draws, site, value)
        for site, value in {"sight_front_other": 2, "sight_back_other": 0}.items()
        for how, posterior in {"alone": fit.posterior, "pooled": together.posterior}.items()
    },
    index=list(some.people),
).rename_axis("probability of the truth")

# %% [markdown]
# A population helps most where a person has few rounds. For people who were not used above,
# held-out NLL with no round and with one, under the prior and under the population as prior
# (`python -m mirror_ppl.fit --prior-from runs/pooled/posterior.nc`):

# %%
others = recordings.select_people(recordings.people[-1 if quick else -5 :])
folder = tempfile.TemporaryDirectory()
population = Path(folder.name, "population.nc")
together.data.to_netcdf(str(population))
rows = {}
for number in (0,) if quick else (0, 1):
    for how, prior in (("prior", None), ("population", population)):
        fitted = mirror_ppl.infer(
            others, prior_from=prior, draws=draws, train_rounds=number, explore=0
        )
        tests = [person["test"] for person in fitted.summary["people"]]
        above = np.mean([test["nll"] - test["floor"] for test in tests])
        rows.setdefault(f"{number} round{'s' * (number != 1)}", {})[how] = round(float(above), 3)
pd.DataFrame(rows).T.rename_axis("NLL above the floor, nats an action")

# %% [markdown]
# ## 6. Model comparison
#
# Ablations leave out sight, the policy residual, or both. `compare` ranks them by held-out NLL
# with paired standard errors (`python -m mirror_ppl.fit --human-model policy-only`, then `python
# -m mirror_ppl.compare`). Notebook 04 compares a model of your own.

# %%
from mirror_ppl.errors import UnreliableWeights
from mirror_ppl.evaluation.compared_files import read_fit
from mirror_ppl.evaluation.comparison import compare_fits
from mirror_ppl.plots.comparison import plot_comparison

names = ["mirror", "perceptual-only", "policy-only", "no-implants"][:: 3 if quick else 1]
files = []
for name in names:
    with warnings.catch_warnings():
        # Of people whom `policy-only` does not describe.
        warnings.simplefilter("ignore", UnreliableWeights)
        own = fit if name == "mirror" else mirror_ppl.infer(some, human=name, explore=0, **settings)
    file = Path(folder.name, f"{name}.nc")
    own.data.to_netcdf(str(file))
    files.append(read_fit(file, "heldout"))
folder.cleanup()
comparison = compare_fits(files, names, "heldout")
plot_comparison(comparison.table(), "heldout")

# %% [markdown]
# Sight distinguishes these people from the robot, and no policy implant replaces it; importance
# weights of `policy-only` are unreliable for some of them. Given sight, the residual is hardly
# needed, because simulated people share the robot's goal.
