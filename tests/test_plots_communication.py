"""Figures of decisions and of replayed rounds: what is drawn, and what is refused."""

import matplotlib.colors as colours
import pytest
import torch
from example_person import DOMAIN, begun, flags, observed, person, plan, scene
from matplotlib.patches import Rectangle

from mirror_ppl.communication import Channels, Message, RoundSoFar
from mirror_ppl.communication.communicator import Decision, gain_over_silence
from mirror_ppl.communication.objectives import Valued
from mirror_ppl.communication.search import Found
from mirror_ppl.domains.driving import CARS
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.people import Memory
from mirror_ppl.plots.communication import candidate_name, in_words, plot_action, plot_utilities
from mirror_ppl.plots.driving import DISTANCES
from mirror_ppl.plots.reading import BLUE
from mirror_ppl.plots.replay import plot_frames, share_known, share_seen

CHANNELS = Channels(DOMAIN)
# Silence, one car shown, two said, and one said a step later.
CANDIDATES = torch.stack(
    [
        plan(None, None),
        plan(flags(visual=("front-left",)), None),
        plan(flags(verbal=("front-left", "rear-left")), None),
        plan(None, flags(verbal=("rear-left",))),
    ]
)
UTILITY = torch.tensor([[0.0, 0.0], [1.0, 3.0], [-1.0, -2.0], [0.5, 0.5]])
ACTIONS = torch.tensor([[[0.9, 0.1], [0.8, 0.2]]]).repeat(4, 1, 1)
ACTIONS[1] = torch.tensor([[0.3, 0.7], [0.6, 0.4]])


def decision(chosen=1, actions=ACTIONS):
    found = Found(CANDIDATES, Valued(UTILITY, actions))
    return Decision(
        CHANNELS.message(CANDIDATES[chosen, 0]),
        CANDIDATES[chosen, 0],
        gain_over_silence(found.valued, chosen),
        DOMAIN,
        begun(0, [3, 9, -4, -9], [-1, 1, 1, -1]).now,
        found,
        chosen,
    )


def nothing_to_choose():
    one = decision()
    return Decision(Message({}), one.flags, one.gain, DOMAIN, one.observation, None, 0)


def labels(axis):
    return [text.get_text() for text in axis.get_ticklabels()]


# --- words ------------------------------------------------------------------------------------


def test_candidates_in_words():
    names = [candidate_name(CHANNELS, candidate) for candidate in CANDIDATES]
    assert names == [
        "silence",
        "shown front-left",
        "said front-left + rear-left",
        "in 1 step: said rear-left",
    ]
    both = plan(flags(("front-left",), ("rear-left",)), None, flags(("front-left",)))
    assert (
        candidate_name(CHANNELS, both)
        == "said rear-left, shown front-left; in 2 steps: shown front-left"
    )
    assert in_words(Message({"haptic": ("left",)})) == "haptic left"


# --- one decision -----------------------------------------------------------------------------


def test_utilities_are_drawn_with_costs_and_intervals():
    figure = plot_utilities(decision())
    (ax,) = figure.axes
    assert labels(ax.yaxis) == [
        "shown front-left",
        "in 1 step: said rear-left",
        "silence",
        "said front-left + rear-left",
    ]
    gains, costs, _ = ax.containers
    assert [bar.get_width() for bar in gains] == pytest.approx([2.0, 0.5, 0.0, -1.5])
    assert [bar.get_width() for bar in costs] == pytest.approx([0.01, 0.03, 0.0, 0.12])
    assert [bar.get_x() for bar in costs] == pytest.approx([2.0, 0.5, 0.0, -1.5])
    # Gains 1 and 3: standard deviation sqrt(2), standard error 1.
    (lines,) = [part for part in ax.collections if len(part.get_segments()) == 4]
    assert lines.get_segments()[0][:, 0].tolist() == pytest.approx([2 - 1.645, 2 + 1.645])
    chosen = [colours.to_hex(bar.get_facecolor()).upper() == BLUE for bar in gains]
    assert chosen == [True, False, False, False]
    assert "4 of 4 candidates" in figure.get_suptitle()
    assert "+2.00  cost 0.01" in [text.get_text() for text in ax.texts]


def test_silence_and_the_chosen_one_are_always_drawn():
    figure = plot_utilities(decision(chosen=2), most=2)
    assert labels(figure.axes[0].yaxis) == ["silence", "said front-left + rear-left"]
    assert "2 of 4 candidates" in figure.get_suptitle()


def test_predicted_actions_are_drawn_for_silence_and_the_message():
    (ax,) = plot_action(decision()).axes
    silent, told = ax.lines
    assert silent.get_ydata() == pytest.approx([0.1, 0.2])
    assert told.get_ydata() == pytest.approx([0.7, 0.4])
    assert told.get_label() == "shown front-left"
    assert labels(ax.xaxis) == ["now", "in 1"]
    (ax,) = plot_action(decision(), "stay").axes
    assert ax.lines[1].get_ydata() == pytest.approx([0.3, 0.6])
    (ax,) = plot_action(decision(chosen=0)).axes
    assert [line.get_label() for line in ax.lines] == ["silence"]


def test_decisions_without_candidates_are_refused():
    for draw in (plot_utilities, plot_action):
        with pytest.raises(ValueError, match="nothing to choose from"):
            draw(nothing_to_choose())
    with pytest.raises(ValueError, match="predicts no actions"):
        plot_action(decision(actions=None))
    with pytest.raises(UnknownNameError, match='unknown action "fly"'):
        plot_action(decision(), "fly")


# --- what a person knows ----------------------------------------------------------------------


def a_round(*messages):
    """A person who stays in lane 0 while cars pass, told these things."""
    state = scene([0], [[3, 9, -4, -9]], [[-1, 1, 1, -1]])
    past = RoundSoFar.begin(DOMAIN, observed(state))
    for message in messages:
        told = CHANNELS.split(flags() if message is None else message)
        state = DOMAIN.transition(state, torch.tensor([0]))
        past = past.then(told, 0, observed(state))
    return past


def test_share_known_is_of_what_was_seen_or_told_so_far():
    # One of four sees two cells ahead, the others nothing; front-left comes from 3 cells ahead.
    bin_of_two = list(DOMAIN.reach_bins).index(2.0)
    someone = person(4, front_own=[bin_of_two, 0, 0, 0])
    past = a_round(None, flags(verbal=("rear-left",)), None)
    known = share_known(someone, past)
    assert known.shape == (4, len(CARS))
    # Of cars ahead only those abreast are seen by everybody, from step 3 on.
    assert known[:, 0].tolist() == [0, 0.25, 0.25, 1]
    assert known[:, 1].tolist() == [0, 0, 0, 0]
    assert known[:, 2].tolist() == [0, 1, 1, 1]
    assert known[:, 3].tolist() == [0, 0, 0, 0]


def test_share_seen_is_by_lane_and_distance():
    bins = list(DOMAIN.reach_bins)
    someone = person(
        2, front_own=[bins.index(2.0), 0], back_other=[bins.index(1.0), bins.index(1.0)]
    )
    seen = share_seen(someone, lane=1)
    assert seen.shape == (2, len(DISTANCES))
    own = dict(zip(DISTANCES.tolist(), seen[1].tolist(), strict=True))
    other = dict(zip(DISTANCES.tolist(), seen[0].tolist(), strict=True))
    assert [own[x] for x in (-1, 0, 1, 2, 3)] == [0, 1, 0.5, 0.5, 0]
    assert [other[x] for x in (-2, -1, 0, 1)] == [0, 1, 1, 0]


# --- frames -----------------------------------------------------------------------------------


def knowledge(steps):
    """Somebody who thinks from the start that front-left is 5 cells ahead."""
    memory = Memory.empty((steps,))
    known, position = memory.known.clone(), memory.position.clone()
    known[:, 0], position[:, 0] = True, 5.0
    return Memory(known, position, memory.speed, memory.assumed, memory.age)


def test_frames_show_road_and_mind_of_each_round():
    someone, past = person(2), a_round(None, flags(verbal=("rear-left",)), None)
    figure = plot_frames(someone, {"one": past, "two": past}, [0, 1, 3], {"one": knowledge(3)})
    axes = [ax for ax in figure.axes if ax.get_ylabel() != "" or ax.get_title(loc="left") != ""]
    titles = [ax.get_title(loc="left") for ax in axes if ax.get_title(loc="left")]
    assert len(titles) == 6
    assert titles[:4] == [
        "step 0:  silence  $\\rightarrow$  stay",
        "step 0:  silence  $\\rightarrow$  stay",
        "step 1:  said rear-left  $\\rightarrow$  stay",
        "step 1:  said rear-left  $\\rightarrow$  stay",
    ]
    marked = [patch for ax in figure.axes for patch in ax.patches if patch.get_gid() == "told"]
    assert len(marked) == 2
    thoughts = [patch for ax in figure.axes for patch in ax.patches if patch.get_gid() in CARS]
    # Of one round only, and not at its end, of which nothing is known.
    assert len(thoughts) == 2
    assert all(isinstance(patch, Rectangle) for patch in thoughts)
    assert [patch.get_x() for patch in thoughts] == pytest.approx([4.53, 4.53])


def test_a_collision_is_told():
    state = scene([0], [[1, 9, -4, -9]], [[-1, 1, 1, -1]])
    past = RoundSoFar.begin(DOMAIN, observed(state))
    following = DOMAIN.transition(state, torch.tensor([0]))
    past = past.then(CHANNELS.split(flags()), 0, observed(following))
    figure = plot_frames(person(), {"one": past}, [0, 1])
    titles = [ax.get_title(loc="left") for ax in figure.axes if ax.get_title(loc="left")]
    assert titles[1].startswith("step 1:  collision") and "collision" not in titles[0]


def test_frames_that_are_not_there_are_refused():
    past = a_round(None)
    with pytest.raises(ValueError, match="there has to be a round, and a step, to draw"):
        plot_frames(person(), {}, [0])
    with pytest.raises(ValueError, match='there is no step 2 in "one", which has 1'):
        plot_frames(person(), {"one": past}, [0, 2])


def test_figures_can_be_saved(tmp_path):
    past = a_round(flags(visual=("front-left",), verbal=("front-left",)))
    for number, figure in enumerate(
        (
            plot_frames(person(), {"one": past}, [0, 1], {"one": knowledge(2)}, cells=8),
            plot_utilities(decision()),
            plot_action(decision()),
        )
    ):
        path = tmp_path / f"{number}.png"
        figure.savefig(path)
        assert path.stat().st_size > 5000
