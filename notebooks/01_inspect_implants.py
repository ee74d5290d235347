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
# # What can this person see, and how do they decide?
#
# This tutorial is for researchers who recorded people in a task. You have their actions and what
# could be observed at each step, but not what they *saw*. The notebook infers that for each
# person, together with how they decide, and checks the model against the data.
#
# The example has ten simulated people who drive on a road with two lanes in fog, so the truth is
# known and shown beside the estimates. With your own recordings
# ([format](../docs/demonstrations.md)) only the first cell below changes.
#
# A person is modelled as the robot's own networks with **implants**, sample sites in which this
# person may differ:
#
# | Implant | Meaning |
# |---|---|
# | `sight_front_own`, `sight_front_other` | cells that they see ahead, by lane |
# | `sight_back_own`, `sight_back_other` | cells that they see behind |
# | `assumes_clear` | whether a car that they never saw is absent to them (1) or may be there (0) |
# | `assumes_closing` | whether a car that they saw once comes closer (1) or may go either way (0) |
# | `consistency` | how strictly they choose the better action |
# | `lapse` | probability of an action independent of their belief |
# | `residual_...` | weights of a small network for all other differences in their choices |

# %%
import os
import warnings

import pandas as pd
import torch

# Whether Jupyter's widgets are installed does not matter here.
warnings.filterwarnings("ignore", message="IProgress not found")

import mirror_ppl

# The networks are small: one thread is as fast as several.
torch.set_num_threads(1)
# The project's tests run this notebook with few people, rounds and steps.
quick = os.environ.get("MIRROR_PPL_QUICK") == "1"

# %% [markdown]
# ## Recordings
#
# Ten people with 40 rounds of 15 steps each; how far they see differs. Rounds 1 to 20 are for
# training, 31 to 36 are held out. Your own file: `load_recordings("recordings.nc")`.

# %%
recordings = mirror_ppl.load_recordings(setting="fog", population="diverse")
if quick:
    recordings = recordings.select_people(["person-08", "person-09"])
recordings

# %% [markdown]
# ## Fit
#
# `infer` conditions the human model, a Pyro program, on the recordings. It takes less than a
# minute here. The command is `python -m mirror_ppl.fit --setting fog --population diverse`. For
# another human model see notebook 04.

# %%
settings = {"draws": 20, "train_rounds": 4, "explore": 1} if quick else {}
fit = mirror_ppl.infer(recordings, **settings)
fit

# %% [markdown]
# `fit.data` is an ArviZ `InferenceData` with prior and posterior draws, predictions and
# recordings. `fit.save(folder)` writes it as netCDF, with a summary and pictures. ArviZ opens the
# file without this package.

# %%
data = fit.data
for group in data.groups():
    names = [str(name) for name in data[group].data_vars if not str(name).startswith("truth_")]
    print(f"{group}: {', '.join(names)}")

# %% [markdown]
# ## What each person sees
#
# The road from above. Brightness is the posterior probability that the person sees a car in a
# cell: bright for seen, dark for not seen, grey where the data do not identify it. The orange line
# surrounds what the person truly sees.

# %%
fit.plot.sight()

# %% [markdown]
# Short sight ahead in the own lane is identified best: the step at which a driver leaves the lane
# shows when they saw the car. Beyond three or four cells seeing and not seeing lead to the same
# actions. Cars in the other lane matter only to drivers who consider a change of lanes, so their
# sight there is identified less well.
#
# ## One person
#
# Prior (grey) and posterior (blue) of each implant. Where they coincide, the data were not
# informative.

# %%
person = "person-09"
fit.plot.implants(person)

# %%
fit.person(person).implants.round(2)

# %% [markdown]
# `az.summary` gives mean, standard deviation and 90% highest-density interval. `kind="stats"`
# leaves out effective sample size and r-hat, which describe Markov chains; these draws are
# independent.

# %%
import arviz as az

from mirror_ppl.plots.implants import scalar_implants

numbers = az.summary(
    data.posterior.sel(person=person),
    var_names=scalar_implants(data),
    kind="stats",
    hdi_prob=0.9,
)
numbers["truth"] = fit.person(person).implants["truth"]
numbers.round(2)

# %% [markdown]
# ## Actions and predictions
#
# The round in which this person changed lanes most often. Each panel is a lane over time; distance
# from the person points upwards, and brightness is the probability of sight as above. The lowest
# panel shows the predicted probability of a change at each step and what the person did. The round
# is selected for its many changes, so some are surprising.

# %%
from mirror_ppl.domains.driving.rounds import lane_changes

changes = lane_changes(data, "observed_data")
fit.plot.round(person, int(changes.sel(person=person).values.argmax()))

# %% [markdown]
# A held-out round:

# %%
fit.plot.round(person, 2, held_out=True)

# %% [markdown]
# ## Does the model describe these people?
#
# **Predictive checks.** Left: changes of lanes per person, observed and predicted; the prior is
# wide, the posterior concentrates near the observations. Right: calibration of predictions. Of all
# steps for which the model predicts "switch" with probability 0.3, 30% should be switches (dotted
# line). Bars are 90% intervals.

# %%
fit.plot.predictive_check()

# %% [markdown]
# **Model check of each person.** Posterior predictive p-values compare the recorded actions with
# 2,000 replicates: how often the person switches, whether actions fit the prediction of one step
# earlier, reward, surprise, and whether missing (`missed`) or forgetting something (`forgot`)
# explains them better. Dark cells are statistics of which a person has more (blue) or less
# (red) than predicted; a frame marks a *suspect* person. Right: held-out NLL beside the base rate
# of each action and the robot without implants.

# %%
fit.plot.check()

# %%
fit.check.drop(columns="reasons").round(3)

# %% [markdown]
# *No person is suspect. [Trust in a posterior](../docs/trust.md#model-check) shows people who are,
# and what the check misses.*
#
# ArviZ's own plots take the same groups. Each line is one draw from the prior (left) or the
# posterior (right) predictive: the share of people with at most so many lane changes per round.
# The black line is the data. Actions are predicted given the recorded history, so averages over
# rounds are comparable with the data; the spread between rounds is not.

# %%
import matplotlib.pyplot as plt

groups = ("observed_data", "prior_predictive", "posterior_predictive")
averages = {
    group: lane_changes(data, group).mean("round").to_dataset(name="lane changes a round")
    for group in groups
}
checks = az.InferenceData(**averages)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), sharex=True, layout="constrained")
shared = {"kind": "cumulative", "num_pp_samples": 20 if quick else 100, "textsize": 11}
az.plot_ppc(checks, group="prior", observed=True, ax=left, random_seed=0, **shared)
az.plot_ppc(checks, group="posterior", ax=right, random_seed=0, **shared)
plt.show()

# %% [markdown]
# A Bayesian p-value of the average over all people: the share of posterior predictive draws below
# the observed average (dot). Values near 0 or 1 would indicate misfit.

# %%
figure, ax = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
az.plot_bpv(checks, kind="t_stat", t_stat="mean", ax=ax, textsize=11)
plt.show()

# %% [markdown]
# ## Held-out prediction
#
# `held-out` is the negative log-likelihood (NLL) of held-out actions in nats an action; a uniform
# guess has 0.69. `floor` is the entropy of the simulated person's choices, which no prediction can
# beat in expectation. `leave-one-out` is ArviZ's PSIS-LOO over training rounds, and `its floor`
# the entropy in these rounds. `doubtful` counts the rounds whose Pareto *k* makes it unreliable;
# held-out rounds have no such limit.

# %%
rows = []
learned = data.observed_data["action"] >= 0
for name in recordings.people:
    one = az.InferenceData(
        posterior=data.posterior.sel(person=name),
        log_likelihood=data.log_likelihood.sel(person=name),
    )
    with warnings.catch_warnings():
        # It warns of doubtful rounds, which are counted here.
        warnings.simplefilter("ignore", UserWarning)
        loo = az.loo(one, pointwise=True)
    test = fit.person(name).summary["test"]
    rows.append(
        {
            "person": name,
            "accuracy": test["accuracy"],
            "held-out": test["nll"],
            "floor": test["floor"],
            "leave-one-out": -loo.elpd_loo / int(learned.sel(person=name).sum()),
            "its floor": float(data.constant_data["action_entropy"].sel(person=name).mean()),
            "doubtful": f"{int((loo.pareto_k > loo.good_k).sum())} of {loo.n_data_points}",
        }
    )
scores = pd.DataFrame(rows).set_index("person")
scores.round(3)

# %%
average = scores.mean(numeric_only=True)
print(f"held-out {average['held-out']:.3f}, floor {average['floor']:.3f} nats an action")

# %% [markdown]
# ## What to keep in mind
#
# - Report intervals, not the edge of a grey area.
# - A person who ignores cars acts like one who does not see them. The prior keeps the policy
#   residual small, so that it does not replace sight; a wrong `assumes_clear` biases sight.
# - These people are simulated. They see perfectly up to their reach, forget nothing and react at
#   once.
#
# Next: a robot that plans messages to such a person (notebook 02), calibration and model
# comparison (03), your own human model (04).
