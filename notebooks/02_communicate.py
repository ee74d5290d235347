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
# # Plan a robot's messages to one person
#
# This tutorial is for roboticists. Your robot observes more than the person whom it assists, and
# may communicate: here it may show cars or speak of them. It needs to know which message to send,
# and when to be silent.
#
# The example is a simulated person who drives in fog and sees two cells ahead and nothing behind.
# Showing *n* cars in a step costs 0.01 n², *n* utterances cost 0.03 n². From recorded rounds the
# robot has inferred what this person sees and how they decide (notebook 01). For each candidate
# message it predicts beliefs, actions and return.
#
# The notebook calls the communicator from a loop of your own, replays a round with and without
# messages, explains one decision, and compares communicators.

# %%
import os
import warnings
from types import SimpleNamespace

import pandas as pd
import torch

# Whether Jupyter's widgets are installed does not matter here.
warnings.filterwarnings("ignore", message="IProgress not found")

import mirror_ppl
from mirror_ppl.communication import RoundSoFar
from mirror_ppl.domains import get_domain

# The networks are small: one thread is as fast as several.
torch.set_num_threads(1)
# The project's tests run this notebook with few rounds, steps and draws.
quick = os.environ.get("MIRROR_PPL_QUICK") == "1"

# %% [markdown]
# ## The person
#
# One of the ten people who ship. The communicator plans with 64 posterior draws of this person; a
# message has to gain on average over these.

# %%
domain = get_domain("driving")
recordings = mirror_ppl.load_recordings(setting="fog").select_people(["person-01"])
settings = {"draws": 8, "train_rounds": 4} if quick else {"draws": 64}
if quick:
    recordings = recordings.select_rounds(slice(0, 6))
fit = mirror_ppl.infer(recordings, explore=0, **settings)
fit.person().implants.round(2)

# %% [markdown]
# ## The communicator
#
# The default planner, `mirror`, maximizes reward in the domain's own simulator.
# `planner="mirror-self-model"` uses the world that the robot learned; `planner="mirror-kl"` brings
# the person's belief close to the robot's. With a saved fit,
# `mirror_ppl.Communicator("runs/demo/posterior.nc", "person-01")` is enough.

# %%
communicator = mirror_ppl.Communicator(fit)
person = communicator.person

# %% [markdown]
# ## In your simulator or robot
#
# `plan` is a function of the round so far: observations, messages and actions. Your code reports
# what happened and gets the message for now.
#
# Here is a state by hand. The person is in the left lane. A car 4 cells ahead comes closer, one 5
# cells behind comes closer, and two are in the other lane. `domain.observe` turns the state into
# tensors; on a robot your perception does ([their content](../docs/driving.md)).
# [`Companion`](../docs/communicator.md#in-python) keeps the round for you.

# %%
from mirror_ppl.domains.driving import DrivingState

state = DrivingState(
    lane=torch.tensor(0),
    position=torch.tensor([4, 8, -5, -9]),  # front left and right, rear left and right
    speed=torch.tensor([-1, 1, 1, -1]),  # relative to the person
)
so_far = RoundSoFar.begin(domain, domain.observe(state))
decision = communicator.plan(so_far)
print(decision.message)
print(decision.why())

# %% [markdown]
# Send `decision.message` and observe. Suppose that the person stays in their lane. Report that with
# the next observation, and plan again.

# %%
stay = domain.actions.index("stay")
state = domain.transition(state, torch.tensor(stay))
so_far = so_far.then(decision.told, stay, domain.observe(state))
decision = communicator.plan(so_far)
print(decision.message)
print(decision.why())

# %% [markdown]
# ## A loop with a simulated person
#
# The simulated person of these recordings acts below. `action_noise` holds the random numbers that
# choose actions, so rounds with the same start and noise differ only by messages. What the person
# knows is available because they are simulated.

# %%
from mirror_ppl.domains.driving.participants import simulated_drivers
from mirror_ppl.domains.driving.people import Memory
from mirror_ppl.people import draw_starts

driver = simulated_drivers("fog", "paper", 10, 0).select([0])
starts = draw_starts(1, 8 if quick else 40, 0, "notebook")
silence = {m.name: torch.zeros(len(m.items), dtype=torch.bool) for m in domain.modalities}


def begin(number):
    """The state at the start of a round."""
    parts = {name: part[:, number : number + 1] for name, part in vars(starts.state).items()}
    return DrivingState(**parts)


def observe(state):
    """What there is to observe in one state."""
    return {name: value[0, 0] for name, value in domain.observe(state).items()}


def drive(number, communicator=None):
    """Play a round.

    Returns:
        moments: the round as it was before each action, and at its end.
        decisions: of the communicator.
        knowledge: what the person knew at each step.
        rewards: by step and term.
    """
    state, memory = begin(number), driver.start(1)
    moments = [RoundSoFar.begin(domain, observe(state))]
    decisions, memories, rewards = [], [], []
    for step in range(domain.horizon):
        decision = communicator.plan(moments[-1]) if communicator else None
        message = decision.told if decision else silence
        received = {name: mask[None, None] for name, mask in message.items()}
        probabilities, memory = driver.step(memory, domain.observe(state), received)
        action = (starts.action_noise[0, number, step] < probabilities[..., 1]).long()
        following = domain.transition(state, action)
        terms = domain.rewards(state, action, following)
        rewards.append({name: float(value) for name, value in terms.items()})
        rewards[-1]["messages"] = -decision.cost if decision else 0.0
        state = following
        moments.append(moments[-1].then(message, int(action), observe(state)))
        decisions.append(decision)
        memories.append(Memory(**{name: part[0, 0] for name, part in vars(memory).items()}))
    knowledge, rewards = Memory.stack(memories, 0), pd.DataFrame(rewards)
    return SimpleNamespace(
        moments=moments, decisions=decisions, knowledge=knowledge, rewards=rewards
    )


def collides(played):
    return bool((played.rewards["collision"] < 0).any())


# %% [markdown]
# ## A round that messages change
#
# Some rounds are played without messages, and those with a collision again with the communicator.

# %%
count = starts.action_noise.shape[1]
silent = {number: drive(number) for number in range(count)}
silent = {number: played for number, played in silent.items() if collides(played)}
assisted = {number: drive(number, communicator) for number in silent}
prevented = [number for number in assisted if not collides(assisted[number])]
print(
    f"{len(silent)} of {count} rounds without messages have a collision;",
    f"messages prevent it in {len(prevented)} of these",
)

# %% [markdown]
# Some collisions cannot be prevented, as where both lanes are blocked. This selection of rounds
# says nothing about rounds that go well without messages; the comparison at the end does.
#
# Among the rounds whose collision is prevented and comes at step 3 or later, the one with the
# largest expected gain of a message is shown. Its total rewards by term:


# %%
def crash_step(played):
    """The step of the action that leads to the first collision."""
    return int((played.rewards["collision"] < 0).values.argmax())


def decisive_step(played):
    """The step of the message with the largest expected gain."""
    gains = [decision.gain.mean if decision.message else 0.0 for decision in played.decisions]
    return gains.index(max(gains))


number = max(
    (number for number in prevented if crash_step(silent[number]) >= 3),
    key=lambda number: assisted[number].decisions[decisive_step(assisted[number])].gain.mean,
)
without, aided = silent[number], assisted[number]
print(f"round {number}")
totals = {"silence": without.rewards.sum(), "communicator": aided.rewards.sum()}
pd.DataFrame(totals).T.assign(net=lambda table: table.sum(axis=1)).round(2)

# %% [markdown]
# All messages of this round, and why:

# %%
for step, decision in enumerate(aided.decisions):
    if decision.message:
        print(f"step {step}: {decision.message}\n    {decision.why()}\n    gain {decision.gain}")

# %% [markdown]
# ## Frame by frame
#
# Left without messages, right with the communicator. Each frame shows the road, and below it what
# the person knows by the posterior: brightness is the share of the 64 draws in which a cell is
# seen, the number on a car the share (in %) in which the person knows of it. An orange outline
# marks where the simulated person thinks that a car is, which the robot does not observe.
#
# The frames are the step of the decisive message, the last step before the collision, and the
# collision.

# %%
from mirror_ppl.domains.driving.replay import plot_frames

crash, step = crash_step(without), decisive_step(aided)
rounds = {"silence": without, "communicator": aided}
plot_frames(
    person,
    {title: played.moments[-1] for title, played in rounds.items()},
    sorted({step, crash, crash + 1}),
    {title: played.knowledge for title, played in rounds.items()},
    cells=9,
)

# %% [markdown]
# All frames up to the step after the collision:

# %%
plot_frames(
    person,
    {title: played.moments[-1] for title, played in rounds.items()},
    range(crash + 3),
    {title: played.knowledge for title, played in rounds.items()},
)

# %% [markdown]
# ## One decision
#
# `gain` is the expected return over silence, costs deducted, with the 90% interval of its mean
# over draws.

# %%
decision = aided.decisions[step]
print("message:", decision.message)
print("gain:   ", decision.gain)
print("why:    ", decision.why())

# %% [markdown]
# The communicator valued every candidate. The picture has the chosen message, the next best,
# everything at once, and each item alone. "in 1 step" marks a plan that sends part of a message
# later; only its message for now is sent, and the next step is planned anew. Silence is a
# candidate and wins ties.

# %%
from mirror_ppl.plots.communication import plot_action, plot_utilities

plot_utilities(decision)

# %% [markdown]
# All candidates as a table, largest mean gain first; the chosen one has the largest gain minus its
# standard error. `later` is the plan's message for later steps, `probability` the share of draws
# in which the candidate beats silence, and `p(switch)` the probability of a change of lanes now.

# %%
decision.alternatives.head(6).round(3)

# %% [markdown]
# How the message works: predicted actions now and at the next steps, with and without the message.

# %%
plot_action(decision)

# %% [markdown]
# ## Two settings
#
# - `patience=3`, the default, compares a message with the same message one or two steps later, as
#   it may become needless. `patience=1` compares it with permanent silence.
# - `min_standard_errors=1`, the default in driving, requires that the gain of a message and of
#   each of its items exceeds its standard error. 0 chooses the largest mean gain; 20 drops small
#   gains.
#
# Messages of four communicators at four steps of the round above, from the step before the decisive
# message on. All get the same past, with the messages of the default.

# %%
others = {
    "default": communicator,
    "patience=1": mirror_ppl.Communicator(fit, patience=1),
    "min_standard_errors=0": mirror_ppl.Communicator(fit, min_standard_errors=0.0),
    "min_standard_errors=20": mirror_ppl.Communicator(fit, min_standard_errors=20.0),
}
steps = range(max(step - 1, 0), crash + 1)[: 1 if quick else 4]
pd.DataFrame(
    [
        {name: str(other.plan(aided.moments[each]).message) for name, other in others.items()}
        for each in steps
    ],
    index=pd.Index(steps, name="step"),
)

# %% [markdown]
# ## Do messages help?
#
# New rounds, not selected, with the same starts and noise for all. `none` is silence, `all` sends
# everything at every step, `oracle` knows person and world exactly. `net` is reward less the cost
# of messages, the mean over rounds; `above none` its difference to silence, and `±` the standard
# error of that.

# %%
from mirror_ppl.evaluation.assistance import Listener, PlannerOptions, play, speaker

fresh = draw_starts(1, 1 if quick else 20, 0, "comparison")
listener = Listener(domain, "fog", driver, fresh, person)
rows, nothing = {}, None
for name in ("none", "mirror", "all", "oracle"):
    played = play(listener, speaker(name, listener, PlannerOptions(), seed=0))
    nothing = played if nothing is None else nothing
    above = pd.Series(played.net - nothing.net)
    rows[name] = {
        "collisions": sum(played.mishaps) / len(above),
        "items sent": sum(map(sum, played.items.values())) / len(above),
        "cost": sum(played.cost) / len(above),
        "net": played.net.mean(),
        "above none": above.mean(),
        "±": above.sem(),
    }
pd.DataFrame(rows).T.round(2)

# %% [markdown]
# These are few rounds of one person. `python -m mirror_ppl.assist` compares more communicators on
# all people of a posterior, with intervals.
#
# ## What to keep in mind
#
# - Messages are as good as the posterior. Check the person first (notebook 01), and the posterior
#   (03).
# - `gain` is an expectation under the model. Its interval is of a mean over draws: it shrinks with
#   more draws and does not cover the outcome of one round.
# - These people receive, understand and remember every message. The communicator infers whether
#   messages reach a person, but assumes the rest. Costs are those of the paper.
