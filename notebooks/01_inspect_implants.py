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
# A robot knows how to drive on a road with two lanes. It has watched ten people drive there in
# fog: what there was to see, and what they did. Nobody recorded what they *saw*. This notebook
# infers it for each person, together with how they decide, and asks whether to believe the
# answer.
#
# The people are simulated, so the truth is known and stands beside what was inferred. With your
# own recordings everything works the same, without the truth; `docs/demonstrations.md` shows how
# to write them.
#
# The model in one sentence: a person is the robot's own model of the world, with **implants**
# that limit what they see and change how they choose.
#
# | Implant | Question |
# |---|---|
# | `sight_front_own`, `sight_front_other` | How many cells ahead do they see, by lane? |
# | `sight_back_own`, `sight_back_other` | How many cells behind? |
# | `assumes_clear` | Is a car that they never saw absent to them (1), or may it be there (0)? |
# | `assumes_closing` | Does a car that they saw once come closer (1), or maybe not (0)? |
# | `consistency` | How strictly do they choose the better action? |
# | `lapse` | How often do they act without regard to what they believe? |
# | `residual_...` | What else sets their choices apart? (Weights of a small network.) |

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
# Ten simulated people who differ in how far they see. (In the population `paper` all of them see
# two cells ahead and nothing behind.) Each drove 40 rounds of 15 steps. Rounds 1 to 20 are learned
# from, rounds 31 to 36 are held out. For your own file: `load_recordings("recordings.nc")`.

# %%
recordings = mirror_ppl.load_recordings(setting="fog", population="diverse")
if quick:
    recordings = recordings.select_people(["person-08", "person-09"])
recordings

# %% [markdown]
# ## Fit
#
# `infer` conditions the human model, a Pyro program, on the recordings. To study another kind of
# person, derive a class from `mirror_ppl.HumanModel`, override `prior`, `perceive`, `believe` or
# `act`, and give it as `human=`. Fitting takes less than a minute. On the command line:
# `python -m mirror_ppl.fit --setting fog --population diverse`.

# %%
settings = {"draws": 20, "train_rounds": 4, "explore": 1} if quick else {}
fit = mirror_ppl.infer(recordings, **settings)
fit

# %% [markdown]
# `fit.data` is an ArviZ `InferenceData`: draws from the prior and the posterior, what either
# predicts, and what was recorded. `fit.save(folder)` writes it as netCDF, with a summary and
# pictures. The file opens in any ArviZ tool without this package.

# %%
data = fit.data
for group in data.groups():
    names = [str(name) for name in data[group].data_vars if not str(name).startswith("truth_")]
    print(f"{group}: {', '.join(names)}")

# %% [markdown]
# ## The road as each person sees it
#
# The road from above. A cell is light where the model is sure that the person sees a car, dark
# where it is sure that they do not, and in between where the recordings do not tell. The orange
# line surrounds what the person really sees.

# %%
fit.plot.sight()

# %% [markdown]
# Sight ahead in the own lane is known best, above all where it is short: when a person drives up
# to a car, the moment at which they leave the lane gives away when they saw it. Beyond three or
# four cells the shades turn grey, since there is no hurry yet: who sees a car that far off, and
# who does not, act alike. Cars in the other lane matter only to those who think about changing
# lanes, so there, too, less is known.
#
# ## One person
#
# Each implant before (grey) and after (blue) seeing this person act. Where blue looks like grey,
# nothing was learned.

# %%
person = "person-09"
fit.plot.implants(person)

# %%
fit.person(person).implants.round(2)

# %% [markdown]
# ArviZ gives the mean, the standard deviation and the 90% highest-density interval. `kind="stats"`
# leaves out effective sample size and r-hat: they are about Markov chains, and these draws come
# from none.

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
# ## What they did, and what was predicted
#
# The round in which this person changed lanes most often. Each lane is drawn over time, with
# distance from the person upwards: a car that falls behind moves down. The shades are those of the
# road above, so a car that leaves the dark comes into sight. The lowest panel shows how probable a
# change of lanes was, by the posterior, at each step, and what the person did. Picked for its many
# changes, the round holds some that nobody could have foreseen.

# %%
from mirror_ppl.domains.driving.rounds import lane_changes

changes = lane_changes(data, "observed_data")
fit.plot.round(person, int(changes.sel(person=person).values.argmax()))

# %% [markdown]
# A round that was not learned from:

# %%
fit.plot.round(person, 2, held_out=True)

# %% [markdown]
# ## Does the model fit these people?
#
# **Before and after learning.** Left: how often each person changes lanes, and how often the
# model says that they do. The prior leaves much room, and the posterior narrows it down around
# what was observed. Right: a prediction is *calibrated* if, of all steps for which it says "they
# switch with probability 0.3", 30% are switches; then the dots lie on the dotted line. Bars are
# 90% intervals.

# %%
fit.plot.predictive_check()

# %% [markdown]
# **Person by person.** Every fit compares what each person did with 2,000 replicates from the
# posterior predictive: how often they switch, whether they act as the model said one step
# *before*, what their actions earn, how surprising they are. Dark cells would be people who do
# more (blue) or less (red) of something than the model says; frames mark p-values that make a
# person *suspect*. Right: held-out actions as the model predicts them, beside
# how often the person chose each action before, and beside the robot without implants.

# %%
fit.plot.check()

# %%
fit.check.drop(columns="reasons").round(3)

# %% [markdown]
# *All of these people drive as the model says. `docs/trust.md` shows some who do not, and what
# the check misses.*
#
# The same check with ArviZ's own tools. Each line is what ten people might have done, by one draw
# of the prior (left) or the posterior (right): the share of people with at most so many lane
# changes a round. The black line is what they did.
#
# Each action is predicted from what had happened until then, as recorded. Averages over rounds
# can therefore be compared with what people did. The spread between rounds cannot: who has
# changed lanes just now need not do it again, but a prediction does not know what the one before
# it was.

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
# the observed average (the dot). Values near 0 or 1 would be a warning.

# %%
figure, ax = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
az.plot_bpv(checks, kind="t_stat", t_stat="mean", ax=ax, textsize=11)
plt.show()

# %% [markdown]
# ## How well are held-out actions predicted?
#
# `held-out` is the negative log-likelihood of the actions in rounds that were not learned from,
# in nats an action: lower is better, and guessing costs 0.69. `floor` is the entropy of the
# simulated person's own choices: nobody can expect to predict better. (Over a few rounds one may,
# by chance.)
#
# `leave-one-out` estimates the same from the rounds that were learned from, by ArviZ's PSIS-LOO
# with a round as the unit; `its floor` is that of these rounds. It weights the draws as if one
# round had not been seen. Where a few draws get most of the weight, the estimate is not to be
# trusted: `doubtful` says for how many rounds. The held-out rounds need no such care.

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
# - What is not known looks grey. Do not read a reach off the picture where its edge is blurred;
#   read the interval.
# - Blindness and habit can look alike. Somebody who ignores cars that they see acts like somebody
#   who does not see them. The prior of the residual keeps such habits small, and `assumes_clear`
#   says what people make of what they do not see; a wrong assumption there makes the model sure
#   of a wrong reach.
# - These people are simulated, and simpler than real ones: they see perfectly up to their reach,
#   forget nothing, and react at once.
