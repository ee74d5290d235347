"""The human model: what people perceive, believe and do, gradients, and models of users."""

import math
import textwrap
from dataclasses import replace

import pyro
import pytest
import torch
from exact import log_joint
from example_course import beliefs_of, perceived
from pyro.infer import TraceEnum_ELBO, config_enumerate

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.domains.driving import ROAD_END, DrivingState
from mirror_ppl.errors import HumanModelError
from mirror_ppl.inference.svi import SVIOptions, continuous_guide, fit_implants
from mirror_ppl.likelihood.compiled import ViewTables
from mirror_ppl.likelihood.contract import check_contract
from mirror_ppl.likelihood.predictive import predict_actions
from mirror_ppl.likelihood.table_program import log_likelihoods
from mirror_ppl.likelihood.tables import build_view_table
from mirror_ppl.likelihood.view_table import NO_VIEW
from mirror_ppl.models import HumanModel, View
from mirror_ppl.models.implants import (
    RESIDUAL_HIDDEN,
    assumption_sites,
    residual,
    sight_sites,
)
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.weights import load_self_model, shipped_weights

DRIVING = get_domain("driving")
SIGHTS, ASSUMED = sight_sites(DRIVING), assumption_sites(DRIVING)
BINS = DRIVING.reach_bins
STEPS, LATENT, ACTIONS = 15, 48, 2


@pytest.fixture(scope="module")
def human():
    return HumanModel(load_self_model(shipped_weights("driving"))[0])


@pytest.fixture(scope="module")
def recordings():
    """Two people in fog, two rounds each."""
    every = load_demonstrations(asset_path("driving_fog_paper.nc"))
    return every.select_people([0, 3]).select_rounds(slice(0, 2))


@pytest.fixture(scope="module")
def table(human, recordings):
    """All 9604 combinations of the first round."""
    return build_view_table(human, recordings.select_rounds([0]))


def policy(human, people=1):
    """Implants of the policy at the median of the prior."""
    zeros = torch.zeros(people, 1, LATENT + 1, RESIDUAL_HIDDEN)
    return {
        "consistency": torch.full((people, 1), 3.0),
        "lapse": torch.full((people, 1), 0.02),
        "residual_in": zeros,
        "residual_out": torch.zeros(people, 1, RESIDUAL_HIDDEN + 1, ACTIONS),
    }


# --- perceive, by hand ------------------------------------------------------------------------


def looked_at(positions, lane=0):
    """Observations ``[1, T, ...]`` of cars at these positions ``[T][4]``."""
    position = torch.tensor(positions)
    state = DrivingState(torch.full((len(positions),), lane), position, torch.ones_like(position))
    return {name: value[None] for name, value in DRIVING.observe(state).items()}


def nothing_told(steps):
    return {name: torch.zeros(1, steps, 4, dtype=torch.bool) for name in ("visual", "verbal")}


def sight(clear=0, closing=0, **bins):
    """Perceptual implants ``[1]``: bins by direction, 0 where not given."""
    values = {site: bins.get(site.removeprefix("sight_"), 0) for site in SIGHTS}
    values |= {"assumes_clear": clear, "assumes_closing": closing}
    return {site: torch.tensor([value]) for site, value in values.items()}


# Front-left, front-right, rear-left, rear-right; which direction each is in from either lane.
DIRECTIONS = {
    0: ("front_own", "front_other", "back_own", "back_other"),
    1: ("front_other", "front_own", "back_other", "back_own"),
}


@pytest.mark.parametrize("lane", [0, 1])
@pytest.mark.parametrize("car", range(4))
def test_threshold_of_its_direction_decides_at_every_edge(human, lane, car):
    side = 1 if car < 2 else -1
    distances = list(range(0 if side > 0 else 1, ROAD_END + 1))  # abreast counts as ahead
    far = [ROAD_END, ROAD_END, -ROAD_END, -ROAD_END]
    positions = [[*far[:car], side * distance, *far[car + 1 :]] for distance in distances]
    # One look at each distance.
    observation = {name: value[0] for name, value in looked_at(positions, lane).items()}
    direction = DIRECTIONS[lane][car]
    for index, edge in enumerate(BINS):
        seen = human.sees(sight(**{direction: index}), observation, 0)
        expected = [distance <= edge for distance in distances]
        assert seen["visual"][:, car].tolist() == expected
        assert not seen["verbal"].any()
        # No other threshold matters to it.
        others = {name: 6 for name in DRIVING.directions if name != direction}
        implants = sight(**others, **{direction: index})
        assert human.sees(implants, observation, 0)["visual"][:, car].tolist() == expected
        # Each look the first of a round: a car seen twice would be known wherever it is then.
        rounds = {name: value[:, None] for name, value in observation.items()}
        view = perceived(human, implants, rounds, nothing_told(1))
        assert view.visible["visual"][:, 0, car].tolist() == expected
        assert not view.visible["verbal"].any()


def test_many_people_perceive_at_once_as_they_do_alone(human, recordings):
    implants = {site: torch.randint(len(BINS), (7,)) for site in SIGHTS}
    implants |= {site: torch.randint(2, (7,)) for site in ASSUMED}
    observation = {name: value[:1, 0, :STEPS] for name, value in recordings.observation().items()}
    told = {name: torch.rand(1, STEPS, 4) < 0.1 for name in ("visual", "verbal")}
    together = perceived(human, implants, observation, told)
    assert all(mask.any() for mask in together.taken.values())
    for row in range(7):
        own = {site: value[row : row + 1] for site, value in implants.items()}
        alone = perceived(human, own, observation, told)
        assert torch.equal(together.numbers()[row], alone.numbers()[0])
        for name in told:
            assert torch.equal(together.visible[name][row], alone.visible[name][0])
            assert torch.equal(together.taken[name][row], alone.taken[name][0])
            assert torch.equal(together.imagined[name][row], alone.imagined[name][0])


def test_messages_are_overlaid_on_sight(human):
    observation = looked_at([[5, 9, -3, -4]] * 3)
    told = nothing_told(3)
    told["visual"][0, 1, 0] = True
    told["verbal"][0, 2, 3] = True
    view = perceived(human, sight(back_own=3), observation, told)
    # The car behind is seen, and from the second time on known; one ahead is shown at step 1;
    # another is spoken of at step 2.
    expected = [
        [False, False, True, False],
        [True, False, True, False],
        [False, False, True, True],
    ]
    assert view.visible["visual"][0].tolist() == expected
    expected = [[False] * 4, [False, False, True, False], [False, False, True, True]]
    assert view.visible["verbal"][0].tolist() == expected
    assert not any(mask.any() for mask in view.taken.values())


def test_absent_is_what_was_never_seen_nor_communicated(human):
    # Seen at one step, spoken of at one, seen always, never.
    observation = looked_at([[3, 9, -1, -4], [2, 9, -1, -4], [3, 9, -1, -4]])
    told = nothing_told(3)
    told["verbal"][0, 1, 1] = True
    view = perceived(human, sight(1, front_own=2, back_own=1), observation, told)
    assert view.taken["visual"][0].tolist() == [
        [True, True, False, True],
        [False, False, False, True],
        [False, False, False, True],
    ]
    assert not view.taken["verbal"].any()
    assert (view.imagined["visual"][..., 0][view.taken["visual"]] == ROAD_END).all()
    view = perceived(human, sight(0, front_own=2, back_own=1), observation, told)
    assert not any(mask.any() for mask in view.taken.values())


def test_a_car_seen_once_comes_closer_until_they_know_better(human):
    # Shown at step 0 only; in truth it draws away. From two cells on they would see it.
    observation = looked_at([[5, 9, -9, -9], [6, 9, -9, -9], [7, 9, -9, -9], [8, 9, -9, -9]])
    told = nothing_told(4)
    told["visual"][0, 0, 0] = True
    view = perceived(human, sight(closing=1, front_own=3), observation, told)
    assert view.visible["visual"][0, :, 0].tolist() == [True, False, True, True]
    assert view.visible["verbal"][0, :, 0].tolist() == [False, False, True, True]
    assert view.taken["visual"][0, :, 0].tolist() == [False, True, False, False]
    assert view.taken["verbal"][0, :, 0].tolist() == [True, True, False, False]
    assert view.imagined["visual"][0, :2, 0].tolist() == [[5, 0], [4, 0]]
    assert view.imagined["verbal"][0, :2, 0].tolist() == [[5, 0, -1], [4, 0, -1]]
    # Whoever sees less far goes on believing it, and others take nothing for granted.
    view = perceived(human, sight(closing=1, front_own=1), observation, told)
    assert view.taken["visual"][0, :, 0].tolist() == [False, True, True, True]
    assert view.imagined["visual"][0, :, 0, 0].tolist() == [5, 4, 3, 2]
    view = perceived(human, sight(closing=0, front_own=1), observation, told)
    assert not any(mask.any() for mask in view.taken.values())


def test_each_car_is_taken_as_what_is_known_of_it_allows(human):
    # All draw away: one shown ahead, one behind, one spoken of, one never. They see three cells.
    observation = looked_at([[5, -5, 4, 9], [6, -6, 5, 9], [7, -7, 6, 9], [8, -8, 7, 9]])
    told = nothing_told(4)
    told["visual"][0, 0, :2] = True
    told["verbal"][0, 0, 2] = True
    for clear in (0, 1):
        view = perceived(human, sight(clear, 1, front_own=3, front_other=3), observation, told)
        # From 5 cells ahead it would be at 3 cells at step 2, and in sight; it is not.
        visual = [[0, 0, 0, clear], [1, 1, 0, clear], *[[0, 1, 0, clear]] * 2]
        assert view.taken["visual"][0].int().tolist() == visual
        # Of the speed not even the first sight tells.
        verbal = [*[[1, 1, 0, 0]] * 2, *[[0, 1, 0, 0]] * 2]
        assert view.taken["verbal"][0].int().tolist() == verbal
        assert view.imagined["verbal"][0, :, 1].tolist() == [[-5 + t, 1, 1] for t in range(4)]
        assert view.visible["visual"][0].int().tolist() == [
            [1, 1, 1, 0],
            [0, 0, 1, 0],
            [1, 0, 1, 0],
            [1, 0, 1, 0],
        ]
        assert view.visible["verbal"][0].int().tolist() == [
            *[[0, 0, 1, 0]] * 2,
            *[[1, 0, 1, 0]] * 2,
        ]


def test_numbers_of_views_are_equal_where_views_are(human, recordings):
    observation, _ = first_round(recordings)
    told = {name: torch.rand(1, STEPS, 4) < 0.1 for name in ("visual", "verbal")}
    view = perceived(human, sight(1, 1, front_own=3, back_other=2), observation, told)
    numbers = view.numbers()
    for name, mask in view.taken.items():
        assert mask.any() and not mask.all()
        value = view.imagined[name]
        # Of what is not taken, and of the ego, it does not matter what was imagined.
        other = torch.where(mask[..., None], value, value + 1)
        imagined = view.imagined | {name: other, "ego": 1 - view.imagined["ego"]}
        assert torch.equal(View(view.visible, view.taken, imagined).numbers(), numbers)
        for feature in range(value.shape[-1]):
            other = value.clone()
            other[..., feature] += 0.5
            changed = View(view.visible, view.taken, view.imagined | {name: other})
            assert torch.equal(changed.numbers() != numbers, mask.any(-1))
    for group in ("visible", "taken"):
        masks = getattr(view, group)
        for name, mask in masks.items():
            changed = replace(view, **{group: {**masks, name: ~mask}})
            assert (changed.numbers() != numbers).all()


def test_steps_by_hand_are_those_of_the_round(human, recordings):
    implants = {site: torch.randint(len(BINS), (7,)) for site in SIGHTS}
    implants |= {site: torch.randint(2, (7,)) for site in ASSUMED}
    observation = {name: value[:1, 0, :STEPS] for name, value in recordings.observation().items()}
    told = {name: torch.rand(1, STEPS, 4) < 0.1 for name in ("visual", "verbal")}
    view = perceived(human, implants, observation, told)
    assert torch.equal(view.imagined["ego"], observation["ego"])
    whole = view.numbers()
    knowledge = DRIVING.nothing_known(1)
    for step in range(STEPS):
        now = {name: value[:, step] for name, value in observation.items()}
        heard = {name: mask[:, step] for name, mask in told.items()}
        view, knowledge = human.perceive(implants, knowledge, now, heard, step)
        assert torch.equal(view.numbers(), whole[:, step])


def test_a_model_may_say_what_is_visible_and_no_more(human, recordings):
    class Attentive(HumanModel):
        """They see every other car, whatever the distance."""

        def sees(self, implants, observation, step):
            seen = super().sees(implants, observation, step)
            return seen | {"visual": (torch.arange(4) % 2 == 0).expand(seen["visual"].shape)}

    observation, actions = first_round(recordings)
    model = Attentive(human.self_model)
    view = perceived(model, sight(), observation, nothing_told(STEPS))
    assert view.visible["visual"][0].all(0).tolist() == [True, False, True, False]
    bare = View(view.visible)
    torch.testing.assert_close(
        beliefs_of(model, bare, observation, actions), beliefs_of(model, view, observation, actions)
    )


# --- believe ----------------------------------------------------------------------------------


def first_round(recordings):
    """Observations ``[1, T, ...]`` and actions ``[1, T]`` of the first round."""
    observation = {name: value[:1, 0, :STEPS] for name, value in recordings.observation().items()}
    return observation, recordings.actions[:1, 0]


def emptied(observation):
    """The same lane and an empty road: every car beyond its visible end."""
    empty = {name: value.clone() for name, value in observation.items()}
    for name in ("visual", "verbal"):
        empty[name][..., 0] = ROAD_END
    empty["verbal"][..., 2] = 0.0
    return empty


def view_of(visible, absent=None, observation=None):
    """A view ``[1, T, 4]`` with nothing said, and some cars taken to be absent."""
    nothing = torch.zeros_like(visible)
    seen = {"visual": visible, "verbal": nothing}
    if absent is None:
        return View(seen)
    return View(seen, {"visual": absent, "verbal": nothing}, emptied(observation))


def test_belief_in_full_view_is_that_of_the_robot(human, recordings):
    observation, actions = first_round(recordings)
    for share in (1.0, 0.5):
        masks = {name: torch.rand(1, STEPS, 4) < share for name in ("visual", "verbal")}
        model = human.self_model
        expected = model.believe(model.evidence(observation, masks, actions[:, :-1]))
        nothing = {name: torch.zeros_like(mask) for name, mask in masks.items()}
        # Whether nothing is said of what is taken for granted, or that nothing is.
        for view in (View(masks), View(masks, nothing, emptied(observation))):
            belief = beliefs_of(human, view, observation, actions)
            torch.testing.assert_close(belief, expected)
    assert belief.shape == (1, STEPS, LATENT)


def test_assuming_absence_is_like_seeing_an_empty_road(human, recordings):
    observation, actions = first_round(recordings)
    everything = torch.ones(1, STEPS, 4, dtype=torch.bool)
    belief = beliefs_of(human, view_of(~everything, everything, observation), observation, actions)
    empty = emptied(observation)
    torch.testing.assert_close(belief, beliefs_of(human, view_of(everything), empty, actions))
    # One car seen and the others taken to be absent: like seeing a road with one car.
    only = everything & (torch.arange(4) == 1)
    mixed = {name: value.clone() for name, value in empty.items()}
    mixed["visual"][..., 1, :] = observation["visual"][..., 1, :]
    belief = beliefs_of(human, view_of(only, ~only, observation), observation, actions)
    torch.testing.assert_close(belief, beliefs_of(human, view_of(everything), mixed, actions))
    # And not like knowing nothing of them.
    unknown = beliefs_of(human, view_of(only), observation, actions)
    assert (unknown - belief).abs().max() > 0.1


def test_what_is_imagined_is_believed_like_what_is_seen_and_said(human, recordings):
    observation, actions = first_round(recordings)
    lane = observation["ego"][..., 0].long()
    speed = torch.where(torch.rand(1, STEPS, 4) < 0.5, -1, 1)
    imagined = DRIVING.observe(DrivingState(lane, torch.randint(-11, 12, (1, STEPS, 4)), speed))
    taken = {name: torch.rand(1, STEPS, 4) < 0.5 for name in ("visual", "verbal")}
    visible = {name: (torch.rand(1, STEPS, 4) < 0.5) & ~mask for name, mask in taken.items()}
    belief = beliefs_of(human, View(visible, taken, imagined), observation, actions)
    mixed = {"ego": observation["ego"]} | {
        name: torch.where(mask[..., None], imagined[name], observation[name])
        for name, mask in taken.items()
    }
    both = View({name: visible[name] | mask for name, mask in taken.items()})
    torch.testing.assert_close(belief, beliefs_of(human, both, mixed, actions))
    # Where they are themselves, people do not imagine.
    imagined["ego"] = 1 - imagined["ego"]
    same = beliefs_of(human, View(visible, taken, imagined), observation, actions)
    assert torch.equal(same, belief)


def test_masks_of_every_step_are_used(human, recordings):
    # The released MIRROR code applied the mask of the first frame to all of them.
    observation, actions = first_round(recordings)
    everything = torch.ones(1, STEPS, 4, dtype=torch.bool)
    full = beliefs_of(human, view_of(everything), observation, actions)
    for step in range(STEPS):
        less = everything.clone()
        less[:, step] = False
        belief = beliefs_of(human, view_of(less), observation, actions)
        assert torch.equal(belief[:, :step], full[:, :step])
        assert (belief[:, step:] != full[:, step:]).any(-1).all()
        absent = beliefs_of(human, view_of(less, ~less, observation), observation, actions)
        assert torch.equal(absent[:, :step], full[:, :step])
        assert not torch.equal(absent[:, step], belief[:, step])


@pytest.mark.parametrize("name", ["visual", "verbal"])
@pytest.mark.parametrize("clear", [0, 1])
@pytest.mark.parametrize("closing", [0, 1])
def test_a_message_counts_from_its_step_on(human, recordings, name, clear, closing):
    observation, actions = first_round(recordings)
    implants = sight(clear, closing)
    quiet = perceived(human, implants, observation, nothing_told(STEPS))
    before = beliefs_of(human, quiet, observation, actions)
    for step in (0, 6, STEPS - 1):
        told = nothing_told(STEPS)
        told[name][0, step, 2] = True
        view = perceived(human, implants, observation, told)
        belief = beliefs_of(human, view, observation, actions)
        assert torch.equal(belief[:, :step], before[:, :step])
        assert (belief[:, step:] != before[:, step:]).any(-1).all()


def test_belief_reads_the_action_before_it_and_never_the_last(human, recordings):
    observation, actions = first_round(recordings)
    view = view_of(torch.ones(1, STEPS, 4, dtype=torch.bool))
    full = beliefs_of(human, view, observation, actions)
    for step in range(STEPS):
        other = actions.clone()
        other[:, step] = 1 - other[:, step]
        belief = beliefs_of(human, view, observation, other)
        assert torch.equal(belief[:, : step + 1], full[:, : step + 1])
        assert (belief[:, step + 1 :] != full[:, step + 1 :]).any(-1).all()


# --- act --------------------------------------------------------------------------------------


def random_policy(*batch):
    return {
        "consistency": torch.rand(*batch, 1) * 5,
        "lapse": torch.rand(*batch, 1) * 0.2,
        "residual_in": torch.randn(*batch, 1, LATENT + 1, RESIDUAL_HIDDEN),
        "residual_out": torch.randn(*batch, 1, RESIDUAL_HIDDEN + 1, ACTIONS),
    }


def act_by_hand(one, belief, values):
    """Probabilities ``[B, A]`` of one person's actions under one draw of their implants."""
    hidden = torch.tanh(belief @ one["residual_in"][:-1] + one["residual_in"][-1])
    delta = hidden @ one["residual_out"][:-1] + one["residual_out"][-1]
    chosen = torch.softmax(one["consistency"] * values + delta, -1)
    return (1 - one["lapse"]) * chosen + one["lapse"] / ACTIONS


@pytest.mark.parametrize(("draws", "people"), [(1, 3), (2, 3), (2, 1)])
def test_act_is_a_distribution_and_each_person_their_own(human, draws, people):
    belief, values = torch.randn(3, 75, LATENT), torch.randn(3, 75, ACTIONS)
    implants = random_policy(draws, people)
    result = human.act(implants, belief, values)
    assert result.shape == (draws, 3, 75, ACTIONS)
    torch.testing.assert_close(result.exp().sum(-1), torch.ones(result.shape[:-1]))
    for draw in range(draws):
        alone = human.act({name: value[draw] for name, value in implants.items()}, belief, values)
        torch.testing.assert_close(alone, result[draw], rtol=1e-4, atol=1e-5)
        for person in range(3):
            own = person if people > 1 else 0
            one = {name: value[draw, own, 0] for name, value in implants.items()}
            expected = act_by_hand(one, belief[person], values[person])
            found = result[draw, person].exp()
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_prior_keeps_the_residual_small(human):
    with pyro.plate("draw", 500, dim=-3), pyro.plate("person", 1, dim=-2):
        implants = human.prior()
    spread = residual(implants, torch.randn(1, 4, LATENT)).std()
    # Each weight out has standard deviation 0.1; at most 8 units and a bias feed on them.
    assert 0.1 < spread < 0.1 * math.sqrt(1 + RESIDUAL_HIDDEN)


# --- every implant matters --------------------------------------------------------------------


def test_every_continuous_implant_gets_a_gradient_from_the_likelihood(human, table):
    implants = {name: value.requires_grad_() for name, value in random_policy(2).items()}
    likelihood = log_likelihoods(human, implants, table)
    likelihood[:, 0].sum().backward()
    for name, value in implants.items():
        assert (value.grad.flatten(1).abs().amax(1) > 0).all(), name


def test_every_continuous_implant_gets_a_gradient_from_the_elbo(human, table):
    """The gradient of the guide differs from what it would be without recordings."""

    def gradients(table):
        torch.manual_seed(0)
        compiled = ViewTables(human, table)
        guide = continuous_guide(compiled)
        torch.manual_seed(1)
        model = config_enumerate(compiled.program, "parallel")
        TraceEnum_ELBO(max_plate_nesting=2)(model, guide)().backward()
        return {name: value.grad for name, value in guide.named_parameters()}

    with pyro.settings.context(module_local_params=True):
        learned = gradients(table)
        alone = gradients(replace(table, steps=torch.zeros_like(table.steps)))
    assert len(learned) == 2 * len(policy(human))
    for name, value in learned.items():
        assert (value - alone[name]).abs().max() > 1e-3, name


def test_every_discrete_implant_changes_the_likelihood(human, recordings):
    # In the released MIRROR code latent states were drawn without reparameterization, so what a
    # person sees had a gradient of exactly zero: whatever they did, sight stayed where it began.
    table = build_view_table(human, recordings)
    joint = log_joint(human, table, policy(human, 2)).unflatten(-1, table.sizes)
    assert table.sites == (*SIGHTS, *ASSUMED)
    for axis, site in enumerate(table.sites, start=1):
        spread = joint.amax(axis) - joint.amin(axis)
        assert spread.flatten(1).amax(1).min() > 0.5, site


# --- models of users --------------------------------------------------------------------------

HEAD = """
import pyro
import pyro.distributions as dist
import torch
from mirror_ppl.models import HumanModel, View
"""
HASTY = """
class Hasty(HumanModel):
    def prior(self):
        return {**super().prior(), "haste": pyro.sample("haste", dist.Beta(1.0, 4.0))}

    def act(self, implants, belief, values):
        haste = implants["haste"][..., None]
        return torch.log((1 - haste) * super().act(implants, belief, values).exp() + haste / 2)
"""
GLANCER = """
class Glancer(HumanModel):
    def prior(self):
        every = pyro.sample("every", dist.Categorical(torch.tensor([0.5, 0.3, 0.2])))
        return {**super().prior(), "every": every}

    def perceive(self, implants, knowledge, observation, told, step):
        view, knowledge = super().perceive(implants, knowledge, observation, told, step)
        looks = step % (implants["every"] + 1) == 0
        view.visible["visual"] = view.visible["visual"] & looks[..., None]
        return view, knowledge
"""


def user_model(tmp_path, human, code, name):
    path = tmp_path / "mine.py"
    path.write_text(HEAD + textwrap.dedent(code))
    return load_human_model(f"{path}:{name}", human.self_model)


@pytest.mark.parametrize(
    ("code", "name", "site"), [(HASTY, "Hasty", "haste"), (GLANCER, "Glancer", "every")]
)
def test_model_with_a_new_site_works_unchanged(tmp_path, human, recordings, code, name, site):
    mine = user_model(tmp_path, human, code, name)
    check_contract(mine)
    one = recordings.select_rounds([0]).select_people([0])
    whole = build_view_table(mine, one, [torch.arange(0, 9604, 100)])
    assert (site in whole.sites) == (site == "every")
    posterior = fit_implants(ViewTables(mine, whole), SVIOptions(steps=2), 6, seed=0)
    draws = posterior.draws
    assert set(draws) == {*SIGHTS, *ASSUMED, *policy(human), site}
    assert draws[site].shape == (6, 1, 1)
    assert ((draws[site] >= 0) & (draws[site] <= 2)).all()
    # Combinations that were not looked at are never drawn.
    combination = whole.combination({name: draws[name] for name in whole.sites})
    assert (whole.index[0, 0, combination.flatten()] != NO_VIEW).all()
    predicted = predict_actions(mine, whole, draws)
    assert predicted.shape == (6, 1, 1, STEPS, ACTIONS)
    torch.testing.assert_close(predicted.exp().sum(-1), torch.ones(6, 1, 1, STEPS))


def test_models_own_methods_are_called(tmp_path, human, recordings):
    mine = user_model(tmp_path, human, GLANCER, "Glancer")
    observation, _ = first_round(recordings)
    implants = sight(front_own=6, front_other=6) | {"every": torch.tensor([0])}
    told = nothing_told(STEPS)
    often = perceived(mine, implants, observation, told).visible["visual"]
    rarely = perceived(mine, {**implants, "every": torch.tensor([2])}, observation, told)
    looks = torch.arange(STEPS) % 3 == 0
    assert often.any()
    assert torch.equal(rarely.visible["visual"], often & looks[:, None])


@pytest.mark.parametrize(
    ("specification", "message"),
    [
        ("mine.py", r'"mine\.py" is not of the form path/to/file\.py:Class'),
        ("mine.py:My-Class", "is not of the form"),
        ("miror", 'perhaps you meant "mirror"'),
        ("nowhere.py:Mine", r"nowhere\.py: there is no such file"),
        (".:Mine", "is not a regular file"),
        ("mine.txt:Mine", "not a Python file"),
        ("mine.py:Other", r"no class Other derived from .*HumanModel; it has: Mine, Naughty"),
        ("mine.py:pyro", "no class pyro derived from"),
        ("mine.py:Naughty", r"Naughty cannot be made: KeyError: 'naught' \(mine\.py, line 11\)"),
        (
            "broken.py:Mine",
            r"broken\.py does not import: ZeroDivisionError.*\(broken\.py, line 3\)",
        ),
        ("syntax.py:Mine", r"syntax\.py does not import: SyntaxError"),
        ("needs.py:Mine", r"does not import: ModuleNotFoundError: No module named 'nonesuch'"),
    ],
)
def test_what_is_not_a_human_model_is_refused(tmp_path, monkeypatch, human, specification, message):
    monkeypatch.chdir(tmp_path)
    code = """
        class Mine(HumanModel):
            pass
        class Naughty(HumanModel):
            def __init__(self, self_model):
                {}["naught"]
        """
    (tmp_path / "mine.py").write_text(HEAD + textwrap.dedent(code))
    (tmp_path / "mine.txt").write_text("no code")
    (tmp_path / "broken.py").write_text("a = 1\nb = 0\na / b\n")
    (tmp_path / "syntax.py").write_text("class Mine(:\n")
    (tmp_path / "needs.py").write_text("import nonesuch\n")
    with pytest.raises(HumanModelError, match=message) as caught:
        load_human_model(specification, human.self_model)
    assert "\n" not in str(caught.value)
    assert type(load_human_model(None, human.self_model)) is HumanModel


@pytest.mark.parametrize(
    ("method", "body", "message"),
    [
        ("prior(self)", "return 1 / 0", r"Mine\.prior fails: ZeroDivisionError.*mine\.py, line 9"),
        ("prior(self)", "return None", "prior returned NoneType, expected a dict of sites"),
        (
            "perceive(self, implants, knowledge, observation, told, step)",
            "return torch.zeros(2) + torch.zeros(3)",
            r"Mine\.perceive fails: RuntimeError.*mine\.py, line 9",
        ),
        ("perceive(self, implants)", "return None", r"Mine\.perceive fails: TypeError"),
        ("perceive(self, *look)", "return None", r"Mine\.perceive fails: TypeError"),
        ("evidence(self, view, observation)", "return view.seen", r"Mine\.evidence fails: Attr"),
        ("believe(self, *now)", "return None", r"Mine\.believe fails"),
        (
            "believe(self, belief, evidence, action, still=None)",
            "return torch.cat([belief, belief], -1)",
            r"believe returned shape \(2, 96\), expected \(2, 48\) for 2 beliefs",
        ),
        (
            "act(self, implants, belief, values)",
            "return values[..., 0]",
            r"act returned shape \(2, 1\), expected \(2, 1, 2\)",
        ),
        (
            "perceive(self, implants, knowledge, observation, told, step)",
            'return implants["lapse"]',
            r'perceive\(\) reads "lapse", which is not a discrete site of prior\(\)',
        ),
        ("act(self, implants, belief, values)", "return values", "they do not sum to 1"),
        ("act(self, implants, belief, values)", 'return implants["mood"]', "KeyError: 'mood'"),
        (
            "act(self, implants, belief, values)",
            'return values + pyro.sample("mood", dist.Beta(1.0, 4.0))[..., None]',
            'act samples "mood" at every step; sample it in prior',
        ),
        (
            "act(self, implants, belief, values)",
            'return values.log_softmax(-1) + 0 * pyro.param("mood", torch.ones(()))',
            '"mood" is a pyro.param',
        ),
        (
            "prior(self)",
            'pyro.sample("mood", dist.Poisson(3.0)); return super().prior()',
            '"mood" is discrete without finite support',
        ),
        (
            "prior(self)",
            'pyro.sample("mood", dist.Normal(torch.zeros(5), 1.0)); return super().prior()',
            r'"mood" has batch shape \(2, 5\), expected \(2, 1\) for 2 people',
        ),
        (
            "prior(self)",
            'pyro.param("mood", torch.ones(())); return super().prior()',
            '"mood" is a pyro.param',
        ),
    ],
)
def test_a_broken_contract_is_reported_before_any_work(tmp_path, human, method, body, message):
    code = f"""
        class Mine(HumanModel):
            def {method}:
                {body}
        """
    mine = user_model(tmp_path, human, code, "Mine")
    state = torch.random.get_rng_state()
    with pytest.raises(HumanModelError, match=message):
        check_contract(mine)
    assert torch.equal(torch.random.get_rng_state(), state)


def test_own_model_keeps_the_contract(human):
    state = torch.random.get_rng_state()
    check_contract(human)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert not any(part.requires_grad for part in human.parameters())
