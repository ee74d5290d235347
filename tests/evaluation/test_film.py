"""Filmstrips: rounds played back from logs, the choice of a round, of steps, and the picture."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mirror_ppl.domains import DOMAINS, get_domain
from mirror_ppl.domains.base import map_state, total_reward
from mirror_ppl.domains.driving import Driving
from mirror_ppl.domains.driving.people import TaskDrivers
from mirror_ppl.domains.highway.pictures import UNSEEN
from mirror_ppl.domains.registry import load_world
from mirror_ppl.errors import OptionError
from mirror_ppl.evaluation.assistance import Listener, PlannerOptions, listeners, play, speaker
from mirror_ppl.evaluation.film import compared, film, strip
from mirror_ppl.people import draw_starts, simulated_people
from mirror_ppl.plots.film import Film, Strip, plot_film

DOMAIN = Driving()
ROUND_TABLE = Path(__file__).parents[2] / "docs" / "examples" / "round_table.py"


@pytest.fixture(scope="module")
def listener():
    person = TaskDrivers(torch.tensor([[2.0, 2.0, 0.0, 0.0]]), torch.tensor([4.0]))
    return Listener(DOMAIN, "fog", person, draw_starts(1, 3, 0, "film"))


@pytest.fixture(scope="module")
def played(listener):
    options = PlannerOptions.of("driving")
    return {
        name: [play(listener, speaker(name, listener, options, 0, None), keep_log=True)]
        for name in ("none", "all")
    }


def pairing(listener):
    return SimpleNamespace(
        domain=listener.domain, people=["ann"], listeners=lambda *_, **__: [listener]
    )


def stacked(states, name):
    return torch.stack([getattr(state, name) for state in states])


def rewards_along(domain, one):
    """Rewards of a strip's actions in its states ``[T]``."""
    gained = []
    for state, action, after in zip(one.states, one.actions, one.states[1:], strict=False):
        index = torch.tensor(domain.actions.index(action))
        gained.append(float(total_reward(domain.rewards(state, index, after))))
    return gained


@pytest.mark.parametrize("name", ["none", "all"])
def test_a_round_played_back_has_the_rewards_that_it_had(listener, played, name):
    own = played[name][0]
    for number in range(3):
        one = strip(
            DOMAIN, listener.start.round(number).state, name, own, number, listener.driver.sees
        )
        assert len(one.states) == len(one.actions) + 1 == len(one.messages) + 1
        assert sum(rewards_along(DOMAIN, one)) == pytest.approx(own.task[number])
        assert len(one.mishaps) == own.mishaps[number]
        assert one.net == pytest.approx(own.task[number] - own.cost[number])
        assert any(one.messages) == (name == "all")


def test_the_film_is_of_the_round_with_the_largest_gain(listener, played):
    gains = played["all"][0].net - played["none"][0].net
    shown = film(pairing(listener), played)
    assert (shown.person, shown.round) == (0, gains.argmax())
    assert [one.communicator for one in shown.strips] == ["none", "all"]
    assert shown.strips[1].net - shown.strips[0].net == pytest.approx(gains.max())


def test_silence_comes_first_and_one_communicator_is_too_few():
    assert compared(("mirror", "none", "oracle")) == ("none", "mirror")
    assert compared(("mirror", "oracle")) == ("mirror", "oracle")
    first = ("oracle", "none", "mirror")  # in the order given
    assert compared(first) == ("none", "oracle")
    with pytest.raises(OptionError, match="--film compares two communicators, not mirror alone"):
        compared(("mirror",))


def texts(figure):
    return [text.get_text() for ax in figure.findobj() for text in getattr(ax, "texts", [])]


def titles(figure):
    return [ax.get_title() for part in figure.subfigs for ax in part.axes]


def test_steps_that_differ_are_drawn_first(listener, played):
    shown = film(pairing(listener), played)
    silent, spoken = shown.strips
    spoken = replace(
        silent, messages=[["said: rear-left"] if step in (7, 9) else [] for step in range(20)]
    )
    figure = plot_film(replace(shown, strips=(silent, spoken)), ["ann"], frames=4)
    assert titles(figure) == 2 * [
        "step 6",
        "step 7",
        "step 9",
        f"the end, step {len(silent.actions)}",
    ]
    assert "said: rear-left" in texts(figure)
    figure = plot_film(replace(shown, strips=(silent, spoken)), ["ann"], frames=2)
    assert titles(figure) == 2 * ["step 7", f"the end, step {len(silent.actions)}"]


def test_steps_of_the_largest_gains_are_drawn(listener, played):
    shown = film(pairing(listener), played)
    silent, spoken = shown.strips
    steps = len(silent.actions)
    spoken = replace(
        silent, messages=[["said: rear-left"]] * steps, gains=[float(step) for step in range(steps)]
    )
    for strips in ((silent, spoken), (spoken, silent)):
        figure = plot_film(replace(shown, strips=strips), ["ann"], frames=4)
        own = [f"step {number}" for number in (0, steps - 2, steps - 1)]
        assert titles(figure) == 2 * [*own, f"the end, step {steps}"]


def test_mishaps_are_drawn(listener, played):
    shown = film(pairing(listener), played)
    silent, spoken = (replace(one, mishaps=[]) for one in shown.strips)
    spoken = replace(spoken, messages=[["said: rear-left"]] * len(spoken.actions), mishaps=[11])
    figure = plot_film(replace(shown, strips=(silent, spoken)), ["ann"], frames=3)
    assert titles(figure)[:2] == ["step 0", "step 11"]


def test_a_film_of_the_highway_shows_what_the_driver_sees():
    people = simulated_people("highway", "fog", "paper", 1, 0)
    (driver,) = listeners(people, 1, "fog", 1, 0)
    world = driver.domain
    state = driver.start.round(0).state
    log = [{"round": 0, "message": {"visual": ["rear"]}, "action": world.actions[7], "gain": 0.5}]
    own = SimpleNamespace(log=log, net=[1.0])
    one = strip(world, state, "mirror", own, 0, driver.driver.sees)
    alone = people.sees(world.observe(state))["visual"][0, 0]
    rear = one.seen[0]["visual"] & ~alone
    assert rear[18] and not alone[18] and not rear[:10].any() and one.gains == [0.5]
    log[0] |= {"message": {"visual": [], "verbal": []}}
    assert strip(world, state, "mirror", own, 0, driver.driver.sees).gains == [0.0]
    silent = replace(one, seen=[people_sees(people, world, part) for part in one.states])
    figure = plot_film(Film(world, 0, 0, (silent, one)), ["ann"], frames=2)
    first, second = (part.axes[0].images[0].get_array() for part in figure.subfigs)
    grey = [(image[..., :3] == UNSEEN).all(-1).sum() for image in (first, second)]
    assert grey[0] > grey[1] > 0
    assert any("dark grey: not seen" in text.get_text() for text in figure.texts)


def test_a_film_of_search_and_rescue_darkens_what_is_not_seen():
    world = get_domain("search_rescue")
    state = map_state(lambda part: part[0], world.initial(1, torch.Generator(), torch.tensor([0])))
    seen = {"visual": torch.arange(9) == 7, "verbal": torch.zeros(5, dtype=torch.bool)}
    whole, part = world.render(state), world.render_seen(state, seen)
    bright = np.zeros((108, 108), dtype=bool)
    bright[72:108, 36:72] = True  # bottom-middle, where rounds begin
    assert np.array_equal(part[bright], whole[bright])
    dark = ~bright
    assert np.abs(part[dark] - 0.6 * whole[dark]).max() <= 1  # both are rounded
    assert np.array_equal(whole, world.render_seen(state, {"visual": torch.ones(9).bool()}))


def test_every_world_of_the_package_explains_its_pictures():
    assert all(world.picture_legend for world in DOMAINS.values())


def test_a_world_without_pictures_of_its_own_has_a_table_and_explains_it(listener, played):
    world = load_world(f"{ROUND_TABLE}:RoundTable")
    state = map_state(lambda part: part[0], world.initial(1, torch.Generator().manual_seed(0)))
    visual = next(one for one in world.modalities if one.name == "visual")
    mask = torch.arange(len(visual.items)) == 1
    whole, part = world.render(state), world.render_seen(state, {"visual": mask})
    size = len(whole) // len(visual.items)
    assert np.array_equal(part[size : 2 * size], whole[size : 2 * size])
    assert np.array_equal(part[:size], (0.6 * whole[:size]).astype(np.uint8))
    left, ahead, right = (
        world.render(replace(state, pot=torch.tensor(place))) for place in (-3, 0, 3)
    )
    assert left[12, 12].tolist() == [200, 90, 0] and right[12, 12].tolist() == [0, 90, 180]
    assert ahead[12, 12].tolist() == [255, 255, 255]

    class Pictured(type(world)):
        def render(self, state):
            return super().render(state)

    def below(domain):
        everything = {"visual": torch.ones(len(visual.items), dtype=torch.bool)}
        one = Strip("none", [state, state], [everything] * 2, [[]], ["wait"], [0.0], 0.0, [])
        figure = plot_film(Film(domain, 0, 0, (one, one)), ["ann"], frames=2)
        frame = figure.subfigs[0].axes[0]
        written.append([frame.get_title(), *(text.get_text() for text in frame.texts)])
        return [text.get_text().replace("\n", " ") for text in figure.texts]

    written = []

    (text,) = [text for text in below(world) if text.startswith("Rows from above: ")]
    assert all(item in text for item in (*visual.items, *visual.features))
    numbers = {f"{float(state.pot):g}", f"{float(state.puddle):g}"}
    assert {"step 0\nhas tea 0", *numbers} <= set(written[0])
    assert not [text for text in below(Pictured()) if "Rows from above" in text]
    assert written[1][0] == "step 0"


def people_sees(people, world, state):
    batch = map_state(lambda part: part[None, None], state)
    return {name: mask[0, 0] for name, mask in people.sees(world.observe(batch)).items()}


def test_a_round_that_ended_early_stands_still(listener, played):
    shown = film(pairing(listener), played)
    silent, spoken = shown.strips
    short = replace(
        silent,
        states=silent.states[:6],
        actions=silent.actions[:5],
        messages=silent.messages[:5],
    )
    figure = plot_film(replace(shown, strips=(short, silent)), ["ann"], frames=3)
    assert titles(figure) == [
        "the end, step 5",
        "over since step 5",
        "over since step 5",
        "step 5",
        "step 6",
        f"the end, step {len(silent.actions)}",
    ]


def test_equal_rounds_are_drawn_too(listener, played):
    shown = film(pairing(listener), {"none": played["none"], "nearest": played["none"]})
    figure = plot_film(shown, ["ann"], frames=3)
    assert titles(figure) == 2 * ["step 0", "step 8", "the end, step 15"]


def test_pictures_that_are_not_wide_stand_below_each_other():
    people = simulated_people("search_rescue", "smoke", "paper", 1, 0)
    (listener,) = listeners(people, 1, "smoke", 1, 0)
    options = PlannerOptions.of("search_rescue")
    own = [play(listener, speaker("none", listener, options, 0, None), keep_log=True)]
    figure = plot_film(film(pairing(listener), {"none": own, "all": own}), ["ann"], frames=2)
    upper, lower = figure.subfigs
    assert upper.bbox.y0 >= lower.bbox.y1 - 1
    assert len(figure.content("png")) > 10_000


def test_one_frame_is_refused(listener, played):
    with pytest.raises(ValueError, match="a film has at least 2 frames, not 1"):
        plot_film(film(pairing(listener), played), ["ann"], frames=1)
