"""Figures of decisions and of replayed rounds: what is drawn, and what is refused."""

from dataclasses import replace

import matplotlib.colors as colours
import pytest
import torch
from example_person import DOMAIN, begun, flags, observed, person, plan, scene
from matplotlib.container import BarContainer

from mirror_ppl.communication import Channels, Message, RoundSoFar, every_message
from mirror_ppl.communication.decision import Decision, gain_over_silence
from mirror_ppl.communication.objectives import Valued
from mirror_ppl.communication.search import Found
from mirror_ppl.domains.driving import CARS
from mirror_ppl.domains.driving.people import Memory
from mirror_ppl.domains.driving.replay import plot_frames, share_known, share_seen
from mirror_ppl.domains.driving.road import DISTANCES
from mirror_ppl.errors import UnknownNameError
from mirror_ppl.plots.communication import candidate_name, in_words, plot_action, plot_utilities
from mirror_ppl.plots.reading import BLUE, GREY

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
        DOMAIN,
    )


def nothing_to_choose():
    one = decision()
    return Decision(Message({}), one.flags, one.gain, DOMAIN, one.observation, None, 0, DOMAIN)


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


def numbers(ax):
    """The columns beside the bars, by row from above, heads first."""
    by_row = {}
    for text in ax.texts:
        by_row.setdefault(text.xy[1], []).append(text.get_text())
    return [by_row[row] for row in sorted(by_row)]


def squares(ax):
    return [line for line in ax.lines if line.get_marker() == "s"]


def colour(artist):
    return colours.to_hex(artist).upper()


def test_utilities_are_drawn_with_costs_and_intervals():
    figure = plot_utilities(decision())
    (ax,) = figure.axes
    assert labels(ax.yaxis) == [
        "shown front-left",
        "in 1 step: said rear-left",
        "silence",
        "said front-left + rear-left",
    ]
    assert ax.yaxis_inverted()  # the best is on top
    bars = next(part for part in ax.containers if isinstance(part, BarContainer))
    assert [bar.get_width() for bar in bars] == pytest.approx([2.0, 0.5, 0.0, -1.5])
    assert [bar.get_y() + bar.get_height() / 2 for bar in bars] == pytest.approx([0, 1, 2, 3])
    # The cost of a plan is that of all its messages.
    assert numbers(ax) == [
        ["gain", "cost"],
        ["+2.00", "0.01"],
        ["+0.50", "0.03"],
        ["+0.00", "0.00"],
        ["-1.50", "0.12"],
    ]
    assert [colour(bar.get_facecolor()) == BLUE for bar in bars] == [True, False, False, False]
    bold = [text.get_fontweight() == "bold" for text in ax.get_yticklabels()]
    assert bold == [True, False, False, False]
    assert "4 of 4 candidates" in figure.get_suptitle()


def test_intervals_are_of_the_mean_gain_and_silence_is_marked_in_their_place():
    (ax,) = plot_utilities(decision()).axes
    (lines,) = [part for part in ax.collections if len(part.get_segments()) == 3]
    drawn = {
        float(segment[0, 1]): segment[:, 0].tolist()
        for segment in lines.get_segments()  # by row
    }
    # Gains 1 and 3: standard deviation sqrt(2), standard error 1. Gains -1 and -2: half of that.
    # 6.314 is the .95 quantile of Student's t with one degree of freedom.
    assert drawn == {
        0: pytest.approx([2 - 6.314, 2 + 6.314], abs=1e-3),
        1: pytest.approx([0.5, 0.5]),
        3: pytest.approx([-1.5 - 6.314 / 2, -1.5 + 6.314 / 2], abs=1e-3),
    }
    (silence,) = squares(ax)
    assert (list(silence.get_xdata()), list(silence.get_ydata())) == ([0], [2])
    assert colour(silence.get_color()) == GREY.upper()


def test_silence_that_is_chosen_is_marked_as_chosen():
    figure = plot_utilities(decision(chosen=0))
    (silence,) = squares(figure.axes[0])
    assert colour(silence.get_color()) == BLUE
    bold = [t.get_text() for t in figure.axes[0].get_yticklabels() if t.get_weight() == "bold"]
    assert bold == ["silence"]


@pytest.mark.parametrize("most", [2, 3])
def test_silence_and_the_chosen_one_are_always_drawn(most):
    figure = plot_utilities(decision(chosen=2), most=most)
    best = ["shown front-left"] * (most - 2)
    assert labels(figure.axes[0].yaxis) == [*best, "silence", "said front-left + rear-left"]
    assert f"{most} of 4 candidates" in figure.get_suptitle()
    with pytest.raises(ValueError, match="at least 2 candidates have to be drawn, not 1"):
        plot_utilities(decision(), most=1)


def test_everything_and_each_item_come_before_more_of_the_best():
    # All messages of three cars that can be said; the more that is said, the better.
    allowed = flags(verbal=("front-left", "front-right", "rear-left"))
    messages = every_message(allowed)
    number = messages.sum(-1)
    utility = (number + 0.1 * (number == 2) * torch.arange(len(number)))[:, None].float()
    found = Found(messages[:, None], Valued(utility, None))
    best = int((number == 3).int().argmax())
    one = replace(decision(), found=found, chosen=best)
    drawn = labels(plot_utilities(one, most=7).axes[0].yaxis)
    assert drawn[0] == "said front-left + front-right + rear-left"
    assert drawn[-1] == "silence"
    # The two best of the others, and each item; not the worst of the pairs.
    assert sorted(drawn[3:6]) == ["said front-left", "said front-right", "said rear-left"]
    assert drawn[1:3] == ["said front-right + rear-left", "said front-left + rear-left"]
    # The two best come before the items.
    drawn = labels(plot_utilities(one, most=5).axes[0].yaxis)
    assert [name.count("+") for name in drawn] == [2, 1, 1, 0, 0]
    # Everything is drawn where it is far from the best, too.
    worst = Found(messages[:, None], Valued(-utility, None))
    drawn = labels(plot_utilities(replace(one, found=worst, chosen=0), most=4).axes[0].yaxis)
    assert drawn[0] == "silence" and drawn[-1] == "said front-left + front-right + rear-left"


def test_predicted_actions_are_drawn_for_silence_and_the_message():
    (ax,) = plot_action(decision()).axes
    silent, told = ax.lines
    assert silent.get_ydata() == pytest.approx([0.1, 0.2])
    assert told.get_ydata() == pytest.approx([0.7, 0.4])
    assert (silent.get_label(), told.get_label()) == ("silence", "shown front-left")
    assert labels(ax.xaxis) == ["now", "1"]
    assert ax.get_ylabel() == "predicted probability: switch"
    (ax,) = plot_action(decision(), "stay").axes
    assert ax.lines[1].get_ydata() == pytest.approx([0.3, 0.6])
    (ax,) = plot_action(decision(chosen=0)).axes
    assert [line.get_label() for line in ax.lines] == ["silence"]


def test_predicted_actions_are_probabilities_whatever_they_add_up_to():
    # Branches that are kept by chance do not add up to one.
    (ax,) = plot_action(decision(actions=1.25 * ACTIONS)).axes
    assert ax.lines[1].get_ydata() == pytest.approx([0.7, 0.4])


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


def test_share_known_counts_items_seen_or_communicated_so_far():
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
    # What was shown once is known of ever after, though not how it moves.
    known = share_known(someone, a_round(flags(visual=("front-right",)), None, None))
    assert known[:, 1].tolist() == [1, 1, 1, 1]
    assert known[:, 2].tolist() == [0, 0, 0, 0]


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
    """A person who thinks from the start that front-left is 5 cells ahead."""
    memory = Memory.empty((steps,))
    known, position = memory.known.clone(), memory.position.clone()
    known[:, 0], position[:, 0] = True, 5.0
    return Memory(known, position, memory.speed, memory.assumed, memory.age)


def headlines(figure):
    return [ax.get_title(loc="left") for ax in figure.axes if ax.get_title(loc="left")]


def marked(ax, gids):
    return [patch for patch in ax.patches if patch.get_gid() in gids]


def texts(ax):
    return [text.get_text() for text in ax.texts]


def test_frames_show_road_and_mind_of_each_round():
    someone, past = person(2), a_round(None, flags(verbal=("rear-left",)), None)
    figure = plot_frames(someone, {"one": past, "two": past}, [0, 1, 3], {"one": knowledge(3)})
    assert headlines(figure)[::2] == headlines(figure)[1::2]
    assert headlines(figure)[::2] == [
        "step 0:  silence, then they stay",
        "step 1:  said rear-left, then they stay",
        "step 3 (collision):  now",
    ]
    assert [title in texts(figure.axes[column]) for column, title in enumerate(("one", "two"))]
    # Axes go row by row: roads of both rounds, minds of both, and so on.
    assert [figure.axes[row].get_ylabel() for row in (0, 2)] == ["the road", "what they\nknow"]
    assert [len(marked(ax, ["told"])) for ax in figure.axes[:12]] == [0] * 4 + [1, 1] + [0] * 6
    assert "said" in texts(figure.axes[4]) and "said" not in texts(figure.axes[0])
    # Thoughts are of one round only, and not at its end, of which nothing is known.
    thoughts = [marked(ax, CARS) for ax in figure.axes[:12]]
    assert [len(part) for part in thoughts] == [0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0]
    assert [part[0].get_x() + 0.47 for part in thoughts if part] == pytest.approx([5, 5])
    assert [part[0].get_y() + 0.4 for part in thoughts if part] == pytest.approx([1.5, 1.5])


def test_frames_show_shares_of_draws_on_cells_and_cars():
    bin_of_two = list(DOMAIN.reach_bins).index(2.0)
    someone = person(4, front_own=[bin_of_two, 0, 0, 0])
    past = a_round(None, None)
    figure = plot_frames(someone, {"one": past}, [0, 1])
    mind = figure.axes[3]
    shown = mind.images[0].get_array()
    assert torch.equal(torch.as_tensor(shown), share_seen(someone, lane=0))
    # The left lane is above, and cells lie where the axis says.
    assert mind.images[0].origin == "upper"
    assert mind.images[0].get_extent() == [-12.5, 12.5, 0, 2]
    numbers = {text.get_position(): text.get_text() for text in mind.texts}
    # Each on its car: front-left, front-right (10 cells ahead), rear-left, rear-right.
    assert {text.get_text() for text in figure.axes[1].texts} == {"0"}  # a step earlier
    assert numbers == {(2, 1.5): "25", (10, 0.5): "0", (-3, 1.5): "0", (-10, 0.5): "0"}


def test_cars_off_the_picture_are_not_drawn():
    past = a_round(None)
    figure = plot_frames(person(), {"one": past}, [0], {"one": knowledge(1)}, cells=4)
    assert {text.get_position()[0] for text in figure.axes[1].texts} == {3, -4}
    assert not marked(figure.axes[1], CARS)  # thought to be at 5
    assert figure.axes[1].get_xlim() == (-4.5, 4.5)


def test_two_cars_in_a_cell_are_drawn_above_each_other():
    state = scene([1], [[-2, 9, -2, -9]], [[-1, 1, 1, -1]])
    past = RoundSoFar.begin(DOMAIN, observed(state))
    memory = knowledge(1)
    memory = replace(memory, position=torch.full_like(memory.position, -2))
    figure = plot_frames(person(), {"one": past}, [0], {"one": memory})
    heights = [y for x, y in (text.get_position() for text in figure.axes[1].texts) if x == -2]
    assert len(heights) == 2
    assert heights[0] - heights[1] > 0.4 and sum(heights) == pytest.approx(3)
    (thought,) = marked(figure.axes[1], CARS)  # of the upper one, and no wider than that
    assert thought.get_y() + thought.get_height() / 2 == pytest.approx(heights[0])
    assert thought.get_height() < 0.5


@pytest.mark.parametrize(("steps", "last"), [(14, "now"), (15, "the end")])
def test_only_the_end_of_a_round_is_called_so(steps, last):
    """A round of driving has 15 steps."""
    past = a_round(*[None] * steps)
    assert headlines(plot_frames(person(), {"one": past}, [steps])) == [f"step {steps}:  {last}"]


def stars(ax):
    return sum(line.get_marker() == (9, 1, 0) for line in ax.lines)


def test_a_collision_is_marked():
    state = scene([0], [[1, 9, -4, -9]], [[-1, 1, 1, -1]])
    past = RoundSoFar.begin(DOMAIN, observed(state))
    following = DOMAIN.transition(state, torch.tensor([0]))
    past = past.then(CHANNELS.split(flags()), 0, observed(following))
    figure = plot_frames(person(), {"one": past}, [0, 1])
    assert headlines(figure) == [
        "step 0:  silence, then they stay",
        "step 1 (collision):  now",
    ]
    assert [stars(ax) for ax in figure.axes[:4]] == [0, 0, 1, 0]


def test_a_car_abreast_is_no_collision():
    past = RoundSoFar.begin(DOMAIN, observed(scene([0], [[5, 0, -4, -9]], [[-1, 1, 1, -1]])))
    figure = plot_frames(person(), {"one": past}, [0])
    assert [stars(ax) for ax in figure.axes[:2]] == [0, 0]


def test_the_truth_is_explained_only_where_it_is_known():
    past = a_round(None)
    for known in (None, {"one": knowledge(1)}):
        (legend,) = plot_frames(person(), {"one": past}, [0], known).legends
        said = any("simulated person thinks" in text.get_text() for text in legend.get_texts())
        assert said == (known is not None)


def test_frames_that_are_not_there_are_refused():
    past = a_round(None)
    with pytest.raises(ValueError, match="there has to be a round, and a step, to draw"):
        plot_frames(person(), {}, [0])
    with pytest.raises(ValueError, match="there has to be a round, and a step, to draw"):
        plot_frames(person(), {"one": past}, [])
    with pytest.raises(ValueError, match='there is no step 2 in "one", which has 1'):
        plot_frames(person(), {"one": past}, [0, 2])


def test_figures_can_be_saved(tmp_path):
    past = a_round(flags(visual=("front-left",), verbal=("front-left",)))
    title = "$1_^ a round"  # text, not a formula
    for number, figure in enumerate(
        (
            plot_frames(person(), {title: past}, [0, 1], {title: knowledge(2)}, cells=8),
            plot_utilities(decision()),
            plot_action(decision()),
        )
    ):
        path = tmp_path / f"{number}.png"
        figure.savefig(path)
        assert path.stat().st_size > 5000
