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
# # Your own human model in Pyro
#
# This tutorial is for Pyro users with a hypothesis about people. A human model is one Pyro program;
# you override a method, and inference, prediction, checks and planning follow from it.
#
# The hypothesis here: some drivers dislike changing lanes, whatever they believe. The new site is
# `reluctance`, in nats. The notebook writes the model, looks at the program, fits it with two
# engines, and compares it with the package's own model.
#
# [Your own human model](../docs/extending.md) has the contract of all methods and further examples.

# %%
import os
import warnings

# Whether Jupyter's widgets are installed does not matter here.
warnings.filterwarnings("ignore", message="IProgress not found")

import numpy as np
import pandas as pd
import pyro
import pyro.distributions as dist
import torch
from pyro import poutine
from pyro.infer import Predictive

import mirror_ppl
from mirror_ppl.models.simulation import simulate_from_prior
from mirror_ppl.models.weights import load_self_model, shipped_weights

# The networks are small: one thread is as fast as several.
torch.set_num_threads(1)
# The project's tests run this notebook with few people, rounds, steps and draws.
quick = os.environ.get("MIRROR_PPL_QUICK") == "1"

# %% [markdown]
# ## The model
#
# `prior` samples the sites of each person; it runs inside a plate of people, so every site has
# shape `[..., P, 1]`. `act` returns log-probabilities of actions `[..., P, B, A]` for people,
# rounds and actions. Perception, memory and beliefs stay those of the base class.


# %%
class Reluctant(mirror_ppl.HumanModel):
    """The package's human model, and a dislike of changing lanes.

    reluctance_p ~ Normal(0, 2), in nats; logits of "switch" are lower by it.
    """

    def prior(self):
        """Sample the package's implants, and one more."""
        implants = super().prior()
        one = implants["consistency"].new_ones(())  # on its device
        reluctance = pyro.sample("reluctance", dist.Normal(0 * one, 2 * one))
        return implants | {"reluctance": reluctance}

    def act(self, implants, belief, values):
        """Log-probabilities of actions, tilted against the second one."""
        log_p = super().act(implants, belief, values)
        switch = log_p.new_tensor([0.0, 1.0])  # of: stay, switch
        return torch.log_softmax(log_p - implants["reluctance"][..., None] * switch, -1)


self_model, _ = load_self_model(shipped_weights("driving"))
human = Reluctant(self_model)

# %% [markdown]
# ## Recordings
#
# Two people drawn from the prior of this model, with 16 rounds each in fog. The truth is stored,
# so the fit can be compared with it. Yours: `mirror_ppl.load_recordings("recordings.nc")`.

# %%
people, rounds = (1, 4) if quick else (2, 16)
recordings = simulate_from_prior(human, people, rounds, seed=2)
print(recordings)
pd.DataFrame(
    {name: recordings.truth[name] for name in ("reluctance", "consistency", "sight_front_own")},
    index=list(recordings.people),
).round(2)

# %% [markdown]
# ## The program
#
# `human.model(rounds)` is an ordinary Pyro program, so Pyro's handlers work on it. The trace of one
# round shows the sites, their batch and event shapes, and the observed actions.

# %%
one_round = recordings.select_rounds([0])
trace = poutine.trace(human.model).get_trace(one_round)
sites = ["sight_front_own", "consistency", "residual_out", "reluctance", "action_3"]
pd.DataFrame(
    {
        site: {
            "shape": tuple(trace.nodes[site]["value"].shape),
            "observed": trace.nodes[site]["is_observed"],
        }
        for site in sites
    }
).T

# %% [markdown]
# Prior predictive check: the rate of lane changes in this round if reluctance is -2, 0 or 2 nats.

# %%
rates = {}
for value in (-2.0, 0.0, 2.0):
    given = {"reluctance": torch.full((people, 1), value)}
    program = poutine.condition(poutine.uncondition(human.model), data=given)
    drawn = Predictive(program, num_samples=2 if quick else 30)(one_round)
    rates[value] = torch.stack([drawn[f"action_{t}"] for t in range(15)]).float().mean().item()
pd.Series(rates, name="lane changes per step").rename_axis("reluctance").round(2)

# %% [markdown]
# ## Two engines
#
# `importance` sums out sight and samples the other sites by adaptive importance sampling. `svi` is
# `pyro.infer.SVI` with a mean-field guide. Both know nothing about `reluctance` but the program.
# Before each fit the model is tried on made-up rounds; [common
# mistakes](../docs/extending.md#common-mistakes) end with one line that names the site.

# %%
shared = {"train_rounds": 3 if quick else 12, "draws": 40 if quick else 200, "explore": 0}
fits = {
    "importance": mirror_ppl.infer(recordings, human=human, engine="importance", **shared),
    "svi": mirror_ppl.infer(
        recordings, human=human, engine="svi", settings={"steps": 3 if quick else 120}, **shared
    ),
}

# %%
from mirror_ppl.plots.picture import Picture

figure = Picture(figsize=(8, 3), layout="constrained")
ax = figure.subplots()
place = np.arange(recordings.num_people)
for shift, (engine, fit) in zip((-0.1, 0.1), fits.items(), strict=True):
    draws = fit.posterior.draws["reluctance"][..., 0]
    low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95], axis=0)
    errors = [middle - low, high - middle]
    ax.errorbar(place + shift, middle, errors, fmt="o", capsize=3, label=engine)
truth = recordings.truth["reluctance"]
ax.scatter(place, truth, marker="x", color="black", label="truth", zorder=3)
ax.set_xticks(place, recordings.people)
ax.set_ylabel("reluctance (nats)")
ax.set_title("Median and 90% interval")
ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
figure

# %% [markdown]
# The mean-field guide makes intervals too narrow and may shift them, because it cannot express
# dependence between `reluctance` and other sites of the policy. Report `importance`, with its
# Pareto *k* (below 0.7 is reliable):

# %%
{
    person: round(float(k), 2)
    for person, k in zip(recordings.people, fits["importance"].posterior.pareto_k, strict=True)
}

# %% [markdown]
# ## Is the new site needed?
#
# Fit the package's own model to the same rounds, and compare for each person:
#
# - the log Bayes factor: the difference of log marginal likelihoods of the training rounds (nats);
# - held-out negative log-likelihood (NLL), in nats an action;
# - the verdict of the model check.

# %%
own = mirror_ppl.infer(recordings, human="mirror", engine="importance", **shared)


def of_people(fit, name):
    """An entry of each person's summary."""
    return [person[name] for person in fit.summary["people"]]


new = fits["importance"]
evidence = [np.array(of_people(fit, "log_evidence")) for fit in (new, own)]
pd.DataFrame(
    {
        "reluctance (truth)": truth,
        "log Bayes factor": evidence[0] - evidence[1],
        "NLL, Reluctant": new.check["nll"],
        "NLL, mirror": own.check["nll"],
        "verdict, Reluctant": new.check["verdict"],
        "verdict, mirror": own.check["verdict"],
    },
    index=list(recordings.people),
).round(2)

# %% [markdown]
# A positive log Bayes factor favours `Reluctant`. For the second person the evidence is strong, the
# held-out NLL is lower, and the model check finds a misfit of `mirror`. For the first person all
# three are about equal: other implants absorb most of a reluctance of 2 nats, and a verdict of
# `ok` is no proof. Four held-out rounds are few.
#
# ## From here
#
# - Put the class into a file, and the commands take it: `--human-model path/to/file.py:Reluctant`.
# - Plan messages with it: `mirror_ppl.Communicator(fit, "person-01")`.
# - Test calibration: `python -m mirror_ppl.calibrate --human-model path/to/file.py:Reluctant`.
# - Compare with baselines: [results](../docs/extending.md#compare-with-baselines).
