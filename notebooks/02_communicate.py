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
# A person drives on a road with two lanes, in fog. They see two cells ahead and nothing behind.
# The robot sees the whole road. At each step it may show them cars, speak of cars, or be silent.
# To show *n* cars costs 0.01 n², to speak of *n* cars costs 0.03 n². Who is told nothing runs into
# cars; who is told everything pays for it.
#
# From twenty recorded rounds the robot has inferred what this person sees and how they decide
# (notebook 01 looks at that). Here it plans with it. For each message that it could send it asks:
# what would this person believe, what would they do, and how would that end?
#
# We send messages by hand, replay a round with and without them, look closely at one decision, and
# compare a few ways to speak.

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
# ## The person, as the robot knows them
#
# One of the ten people in the recordings that ship. The communicator plans with 64 draws from
# their posterior. So it has not one opinion of what they see, but 64, and messages have to be
# worth sending on average over these.

# %%
domain = get_domain("driving")
recordings = mirror_ppl.load_recordings(setting="fog").select_people(["person-01"])
settings = {"draws": 16, "train_rounds": 10} if quick else {"draws": 64}
fit = mirror_ppl.infer(recordings, explore=0, **settings)
fit.person().implants.round(2)

# %% [markdown]
# ## The communicator
#
# It plans messages for one person of a fit. The planner `mirror`, the default, looks for reward in
# the domain's own simulator. `planner="mirror-self-model"` looks for it in what the robot has
# learned of the world, and `planner="mirror-kl"` brings the person's belief close to the robot's.

# %%
communicator = mirror_ppl.Communicator(fit)
person = communicator.person

# %% [markdown]
# ## In your own simulator, or on your robot
#
# No loop owns the world. `plan` is a function of the round so far: what there was to observe, what
# the person was told, and what they did. You say what happened, it says what to tell them.
#
# Here is a road by hand. The person is in the left lane. A car 4 cells ahead of them slows down,
# one 5 cells behind comes closer, and two are in the other lane. `domain.observe` writes that down
# as tensors; on a robot, your perception does (`docs/driving.md` says what is in them).

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
# Now send `decision.message` (here there is nothing to send), and watch. Say the person stays in
# their lane. Tell the communicator so, with what there is to observe afterwards, and ask again.

# %%
stay = domain.actions.index("stay")
state = domain.transition(state, torch.tensor(stay))
so_far = so_far.then(decision.told, stay, domain.observe(state))
decision = communicator.plan(so_far)
print(decision.message)
print(decision.why())

# %% [markdown]
# Below, somebody acts: the simulated person of these recordings. We know what they really think,
# which is unknown for real people. `action_noise` holds the random numbers that choose actions.
# With the same start and the same noise, rounds differ only in what was said.

# %%
from mirror_ppl.domains.driving.participants import simulated_drivers
from mirror_ppl.domains.driving.people import Memory
from mirror_ppl.people import draw_starts

driver = simulated_drivers("fog", "paper", 10, 0).select([0])
starts = draw_starts(1, 8 if quick else 60, 0, "notebook")
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
        told = decision.told if decision else silence
        heard = {name: mask[None, None] for name, mask in told.items()}
        chances, memory = driver.step(memory, domain.observe(state), heard)
        action = (starts.action_noise[0, number, step] < chances[..., 1]).long()
        following = domain.transition(state, action)
        terms = domain.rewards(state, action, following)
        rewards.append({name: float(value) for name, value in terms.items()})
        rewards[-1]["messages"] = -decision.cost if decision else 0.0
        state = following
        moments.append(moments[-1].then(told, int(action), observe(state)))
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
# Which round shall we look at? We play some with nobody speaking, and those with a collision once
# more with the communicator.

# %%
alone = {number: drive(number) for number in range(starts.action_noise.shape[1])}
alone = {number: played for number, played in alone.items() if collides(played)}
aided = {number: drive(number, communicator) for number in alone}
prevented = [number for number in aided if not collides(aided[number])]
print(
    f"{len(alone)} of {starts.action_noise.shape[1]} rounds have a collision if nothing is said;",
    f"the communicator prevents it in {len(prevented)} of these {len(alone)}",
)

# %% [markdown]
# Not every collision can be prevented: where all ways are blocked, words do not help. And this is a
# selection. It says nothing about rounds that go well without help; the comparison at the end does.
#
# Of the rounds in which the collision is prevented we leave out those in which it comes within
# three steps, so that there is something to watch. Of the others we take the one with the message
# of which the communicator expected most.


# %%
def crash_step(played):
    """The step of the action that leads to the first collision."""
    return int((played.rewards["collision"] < 0).values.argmax())


def decisive_step(played):
    """The step with the message of which most was expected."""
    gains = [decision.gain.mean if decision.message else 0.0 for decision in played.decisions]
    return gains.index(max(gains))


number = max(
    (number for number in prevented if crash_step(alone[number]) >= 3),
    key=lambda number: aided[number].decisions[decisive_step(aided[number])].gain.mean,
)
told_nothing, told = alone[number], aided[number]
print(f"round {number}")
totals = {"told nothing": told_nothing.rewards.sum(), "communicator": told.rewards.sum()}
pd.DataFrame(totals).T.assign(net=lambda table: table.sum(axis=1)).round(2)

# %% [markdown]
# Everything that was said in it, and why:

# %%
for step, decision in enumerate(told.decisions):
    if decision.message:
        print(f"step {step}: {decision.message}\n    {decision.why()}\n    gain {decision.gain}")

# %% [markdown]
# ## Frame by frame
#
# Left, nobody speaks; right, the communicator does. Each frame shows the road as it is, and below
# it what the person knows, in the robot's view: a cell is light where they would see a car. The
# number on a car says how sure the robot is that they know of it, the share of the 64 draws in
# which they have seen it or been told of it. What the simulated person really thinks is outlined;
# the robot has not seen these outlines.
#
# The frames are the step of the decisive message, the last one before the collision, and the
# collision. (The README shows this picture; `.savefig("communicate.png")` makes a file of it.)

# %%
from mirror_ppl.domains.driving.replay import plot_frames

crash, step = crash_step(told_nothing), decisive_step(told)
rounds = {"told nothing": told_nothing, "with the communicator": told}
plot_frames(
    person,
    {title: played.moments[-1] for title, played in rounds.items()},
    sorted({step, crash, crash + 1}),
    {title: played.knowledge for title, played in rounds.items()},
    cells=9,
)

# %% [markdown]
# Every frame, from the first step to the one after the collision:

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
# A decision explains itself. `gain` is what the message is expected to be worth, compared with
# silence, its cost taken off; in brackets the 90% interval of the mean over the 64 draws.

# %%
decision = told.decisions[step]
print("message:", decision.message)
print("gain:   ", decision.gain)
print("why:    ", decision.why())

# %% [markdown]
# Every message was valued. The picture has the chosen one, the next best, everything at once, and
# each car by itself. Silence is a candidate, too, and wins ties. Where a name has "in 1 step", the
# candidate is a plan: this now, that later. Only what is for now is sent, and at the next step the
# communicator plans anew.

# %%
from mirror_ppl.plots.communication import plot_action, plot_utilities

plot_utilities(decision)

# %% [markdown]
# The same as a table of all candidates, the best first. `later` is what would follow in the steps
# after, `probability` the share of draws in which a candidate is better than silence, and
# `p(switch)` how probable a change of lanes is now.

# %%
decision.alternatives.head(6).round(3)

# %% [markdown]
# How the message works: what the person is expected to do at this step and at the steps after it,
# if they hear it, and if they do not.

# %%
plot_action(decision)

# %% [markdown]
# ## How sure, how patient
#
# Two settings change when it speaks.
#
# - **Patience.** `patience=3`, the default, compares each good message with the same message one or
#   two steps later. What can wait waits: it may turn out not to be needed. `patience=1` asks
#   only whether a message is better than silence for good.
# - **How sure.** With `min_standard_errors=2`, the default, a message has to gain more than two
#   standard errors of its gain, and so has each of its items, compared with leaving it out. With 0
#   it takes what is best on average, however uncertain that is. With 20 it drops messages that gain
#   little, and prefers a gain that is certain to one that is a bit larger.
#
# Here is what each would say in the round above, up to the step before the collision. All are given
# the same past, in which the shipped settings spoke.

# %%
others = {
    "as shipped": communicator,
    "no patience": mirror_ppl.Communicator(fit, patience=1),
    "0 s.e.": mirror_ppl.Communicator(fit, min_standard_errors=0.0),
    "20 s.e.": mirror_ppl.Communicator(fit, min_standard_errors=20.0),
}
pd.DataFrame(
    [
        {name: str(other.plan(past).message) for name, other in others.items()}
        for past in told.moments[: crash + 1]
    ]
).rename_axis("step")

# %% [markdown]
# ## Is it worth it?
#
# New rounds, which nobody selected, each with the same start and the same action noise for all. `none` is
# silence, `all` tells everything at every step, `mirror` is the communicator. `oracle` is the
# ceiling: it knows the person and the world exactly. `net` is the task's reward less the cost of
# messages, on average over rounds; `above none` is how much more that is than with silence, and
# `±` its standard error.

# %%
from mirror_ppl.evaluation.assistance import Listener, PlannerOptions, play, speaker

fresh = draw_starts(1, 2 if quick else 20, 0, "comparison")
listener = Listener(domain, "fog", driver, fresh, person)
rows, nothing = {}, None
for name in ("none", "mirror", "all", "oracle"):
    played = play(listener, speaker(name, listener, PlannerOptions(), seed=0))
    nothing = played if nothing is None else nothing
    above = pd.Series(played.net - nothing.net)
    rows[name] = {
        "collisions": sum(played.mishaps) / len(above),
        "items told": sum(map(sum, played.items.values())) / len(above),
        "cost": sum(played.cost) / len(above),
        "net": played.net.mean(),
        "above none": above.mean(),
        "±": above.sem(),
    }
pd.DataFrame(rows).T.round(2)

# %% [markdown]
# These are a few rounds of one person. `python -m mirror_ppl.assist` compares more ways to speak,
# on all people of a posterior, with intervals.
#
# ## What to keep in mind
#
# - The communicator is as good as the posterior. If the model is sure of something wrong about a
#   person, it will be sure of a wrong message. Look at the person first, as in notebook 01.
# - `gain` is what the model expects, not what happens. Its interval is that of a mean over
#   posterior draws: it shrinks with more draws, and does not say how below a round will be.
# - These people listen, understand and remember perfectly, and act on what they hear. Real people
#   do not always. To them messages cost attention; the costs here are those of the paper.
