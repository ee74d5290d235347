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
# # What should the robot tell this person, and when?
#
# A person drives in fog. They see two cells ahead and nothing behind; the robot sees the whole
# road. It may show cars (0.01 n² for n cars in one step) or speak of them (0.03 n²). Telling
# everything is expensive and tiring, telling nothing ends in collisions.
#
# From twenty recorded rounds the robot has inferred what this person sees and how they decide
# (notebook 01). Here it uses that to choose what to say. We replay one round with and without
# messages, look at one decision closely, and end with a comparison over some rounds.

# %%
import os
import warnings

import pandas as pd
import torch

# Whether Jupyter's widgets are installed does not matter here.
warnings.filterwarnings("ignore", message="IProgress not found")

from mirror_ppl.communication import (
    Communicator,
    ExpectedUtility,
    Patient,
    Person,
    RoundSoFar,
    SimulatorWorld,
)
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.inference.fitting import fit_people
from mirror_ppl.inference.svi import FitOptions
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.weights import load_self_model, shipped_weights

# The networks are small: one thread is as fast as several.
torch.set_num_threads(1)
# The project's tests run this notebook with few rounds and steps.
quick = os.environ.get("MIRROR_PPL_QUICK") == "1"

# %% [markdown]
# ## The person, as the robot knows them
#
# The first of the ten people in the recordings that ship. 64 draws from their posterior are what
# the communicator plans with: it does not know what they see, it has 64 opinions about it.

# %%
domain = get_domain("driving")
self_model, card = load_self_model(shipped_weights("driving"))
human = HumanModel(self_model)
recordings = load_demonstrations(asset_path("driving_fog_paper.nc")).select_people(["person-01"])
options = FitOptions(steps=60 if quick else 300, draws=64)
fit = fit_people(human, recordings, options, seed=0, train_rounds=20)
person = Person(human, fit.posterior.draws)

pd.DataFrame(fit.summary["people"][0]["implants"]).T

# %% [markdown]
# ## The communicator
#
# Three parts: the person, what messages are for, and how candidates are searched. The world that
# is rolled forward is the domain's own simulator; where there is none,
# `SelfModelWorld(self_model)` takes its place.

# %%
communicator = Communicator(person, ExpectedUtility(SimulatorWorld(domain)))

# %% [markdown]
# ## A round, driven by you
#
# No hidden loop owns the world: `plan` is a function of the round so far. The person here is
# simulated, so we can also look at what they really think. With a real person, `driver.step` is
# where they act, and `observe` is your robot's perception. `luck` are the random numbers by which
# the person chooses: the same with and without messages, so that what differs is what was said.

# %%
from mirror_ppl.people import Memory, draw_starts, simulated_drivers

driver = simulated_drivers("fog", "paper", 10, 0).select([0])
starts = draw_starts(1, 60, 0, "notebook")
silence = {m.name: torch.zeros(len(m.items), dtype=torch.bool) for m in domain.modalities}


def observe(state):
    return {name: value[0, 0] for name, value in domain.observe(state).items()}


def drive(number, communicator=None):
    """Play a round; returns the round, decisions, what the person knew, and rewards by step."""
    begin = {name: part[:, number : number + 1] for name, part in vars(starts.state).items()}
    state, memory = type(starts.state)(**begin), driver.start(1)
    so_far = RoundSoFar.begin(domain, observe(state))
    decisions, memories, rewards = [], [], []
    for step in range(domain.horizon):
        decision = communicator.plan(so_far) if communicator else None
        told = decision.told if decision else silence
        chances, memory = driver.step(
            memory, domain.observe(state), {name: mask[None, None] for name, mask in told.items()}
        )
        action = (starts.luck[0, number, step] < chances[..., 1]).long()
        following = domain.transition(state, action)
        terms = domain.rewards(state, action, following)
        rewards.append({name: float(value) for name, value in terms.items()})
        rewards[-1]["cost"] = -decision.cost if decision else 0.0
        state = following
        so_far = so_far.then(told, int(action), observe(state))
        decisions.append(decision)
        memories.append(Memory(**{name: part[0, 0] for name, part in vars(memory).items()}))
    return so_far, decisions, Memory.stack(memories, 0), pd.DataFrame(rewards)


# %% [markdown]
# Which round to look at? The first of these in which the person, told nothing, runs into a car,
# and told what the communicator would tell them, into none.

# %%
for number in range(60):
    alone = drive(number)
    if not (alone[3]["collision"] < 0).any():
        continue
    aided = drive(number, communicator)
    if not (aided[3]["collision"] < 0).any():
        break

totals = {"alone": alone[3].sum(), "with the communicator": aided[3].sum()}
print(f"round {number}")
pd.DataFrame(totals).T.assign(net=lambda table: table.sum(axis=1)).round(2)

# %% [markdown]
# What was said, and why:

# %%
for step, decision in enumerate(aided[1]):
    if decision.message:
        print(f"step {step}: {decision.message}\n    {decision.why()}\n    gain {decision.gain}")

# %% [markdown]
# ## Frame by frame
#
# Each frame shows the road as it is and, below it, what the person knows of it according to the
# model. A cell is light where they would see a car; the number on a car is the share of posterior
# draws, in percent, in which they have seen it or been told of it. The orange outline is what the
# simulated person really thinks; the model has never seen it. The frames are those around the
# first collision of the person who is told nothing.

# %%
from mirror_ppl.plots.replay import plot_frames

crash = int((alone[3]["collision"] < 0).values.argmax())
spoken = [step for step, decision in enumerate(aided[1][: crash + 1]) if decision.message]
frames = sorted({*spoken[-2:], crash, crash + 1})
rounds = {"told nothing": alone[0], "with the communicator": aided[0]}
knowledge = {"told nothing": alone[2], "with the communicator": aided[2]}
plot_frames(person, rounds, frames, knowledge)

# %% [markdown]
# ## One decision
#
# The message before the collision that gains most. Every candidate was valued: what it gains over
# silence, on average over the 64 draws, with its cost taken off. Silence is a candidate and wins
# ties. Candidates that begin with "in 1 step" are plans: say nothing now, and this later. If such
# a plan is best, the communicator waits.

# %%
from mirror_ppl.plots.communication import plot_action, plot_utilities

step = max(spoken, key=lambda step: aided[1][step].gain.mean)
decision = aided[1][step]
print(f"step {step}: {decision.why()}")
plot_utilities(decision)

# %% [markdown]
# The same as a table, with the predicted probability of each action right now:

# %%
decision.alternatives.head(8).round(3)

# %% [markdown]
# What each item of the message adds, and what the person is expected to do in the steps ahead:

# %%
print({" ".join(pair): round(gain, 3) for pair, gain in decision.matters.items()})
plot_action(decision)

# %% [markdown]
# ## How sure, how patient
#
# `sure` is how many standard errors of its gain a message has to gain; `Patient(steps)` compares a
# message with the same message up to `steps - 1` steps later. Without patience more is said, and
# earlier than needed.

# %%
moments = range(3 if quick else 20)
rows = []
for name, search, sure in (
    ("as shipped: 3 steps, sure 2", Patient(3), 2.0),
    ("no patience", Patient(1), 2.0),
    ("takes the best on average", Patient(3), 0.0),
):
    other = Communicator(person, ExpectedUtility(SimulatorWorld(domain)), search, sure)
    played = [drive(number, other) for number in moments]
    rows.append(
        {
            "communicator": name,
            "items a round": sum(sum(len(d.message) for d in one[1]) for one in played)
            / len(played),
            "cost": -sum(one[3]["cost"].sum() for one in played) / len(played),
            "net": sum(one[3].to_numpy().sum() for one in played) / len(played),
        }
    )
played = [drive(number) for number in moments]
net = sum(one[3].to_numpy().sum() for one in played) / len(played)
rows.append({"communicator": "silence", "items a round": 0.0, "cost": 0.0, "net": net})
pd.DataFrame(rows).set_index("communicator").round(2)

# %% [markdown]
# These are a few rounds of one person; `python -m mirror_ppl.assist` does it properly, with
# other communicators, an oracle as the ceiling, and paired intervals.
#
# ## What to keep in mind
#
# - The communicator is as good as the posterior. If the model is sure of something wrong about a
#   person, it will be sure of a wrong message. Look at notebook 01 first.
# - `gain` is what the model expects, not what happens. Its interval is over posterior draws: it
#   says how much we do not know about the person, not how often the world will be kind.
# - These people listen, understand and remember perfectly. Real ones do not; messages cost them
#   attention, and the costs here are those of the paper.
