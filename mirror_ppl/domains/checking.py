"""Checks a world against the contract of worlds."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor

from mirror_ppl.domains.base import map_state, total_reward
from mirror_ppl.domains.checking_attributes import faults_of_attributes
from mirror_ppl.domains.world import World, offers
from mirror_ppl.errors import DomainError
from mirror_ppl.randomness import forked
from mirror_ppl.user_code import describe

ROUNDS = 6
"""Number of rounds that a check plays."""
TOLERANCE = 1e-4
REWARD_TOLERANCE = 1e-3
"""That of recorded rewards."""


def require_sound(world: World) -> World:
    """Return the world if it has no faults.

    Raises:
        DomainError: it has faults; the message has the first.
    """
    found = faults_of(world)
    if found:
        more = f" (and {len(found) - 1} more: python -m mirror_ppl.check_domain)" * (len(found) > 1)
        raise DomainError(f"{type(world).__name__}: {found[0]}{more}")
    return world


def faults_of(world: World) -> list[str]:
    """Return the faults of a world, each with what was expected and what was found.

    Plays rounds of random actions; checks stop at the first stage with faults.
    """
    faults: list[str] = faults_of_attributes(world)
    if faults:
        return faults
    try:
        with forked():
            for check in (_begins, _goes_on, _of_its_own, _looks):
                faults += check(world)
                if faults:
                    return faults
    except _CallError as error:
        return [str(error)]
    return faults


class _CallError(Exception):
    """A method of the world raised something."""


def _call(world: World, name: str, *arguments: Any) -> Any:
    try:
        return getattr(world, name)(*arguments)
    except DomainError as error:
        raise _CallError(str(error)) from error
    except (Exception, SystemExit) as error:
        raise _CallError(f"{name} fails: {describe(error)}") from error


def _begins(world: World) -> list[str]:
    """Check initial states: dataclasses of tensors, determined by the seed."""
    first = _start(world)
    if not is_dataclass(first) or isinstance(first, type):
        return [f"initial: expected a dataclass of tensors, found {type(first).__name__}"]
    for part in fields(first):
        value = getattr(first, part.name)
        if not isinstance(value, Tensor):
            return [f"initial: {part.name} has to be a tensor, found {type(value).__name__}"]
        if value.shape[:1] != (ROUNDS,):
            return [
                f"initial: {part.name} of {ROUNDS} rounds has to begin with the dimension "
                f"{ROUNDS}, found {tuple(value.shape)}"
            ]
    scenario = torch.zeros(ROUNDS, dtype=torch.long)
    _call(world, "initial", ROUNDS, torch.Generator().manual_seed(0), scenario)
    if not _same(first, _start(world)):
        return ["initial: equal generators give different states; draw with the one that is passed"]
    return _faults_of_scenarios(world)


def _faults_of_scenarios(world: World) -> list[str]:
    """Return the fault of several scenarios that all give the same states."""
    first = None
    for number in range(len(world.scenarios)):
        scenario = torch.full((ROUNDS,), number)
        state = _call(world, "initial", ROUNDS, torch.Generator().manual_seed(0), scenario)
        if first is not None and not _same(first, state):
            return []
        first = state
    if len(world.scenarios) == 1:
        return []
    return [
        f"initial: all {len(world.scenarios)} scenarios begin in the same states; use the argument "
        "scenario, self.scenario(batch, generator, scenario) where it is None"
    ]


def _start(world: World) -> Any:
    return _call(world, "initial", ROUNDS, torch.Generator().manual_seed(0))


def _goes_on(world: World) -> list[str]:
    """Check transitions and rewards: pure, batched, of the same types, finite."""
    state = _start(world)
    generator = torch.Generator().manual_seed(1)
    over = _call(world, "over", state)
    if fault := _fault("over", "", over, (ROUNDS,), bool):
        return [fault]
    if bool(over.any()):
        return ["over: true at the start of a round; rounds have at least one step"]
    for step in range(world.horizon):
        action = torch.randint(len(world.actions), (ROUNDS,), generator=generator)
        before = copy.deepcopy(state)
        following = _call(world, "transition", state, action)
        if type(following) is not type(state):
            return [f"transition: expected {_kind(state)}, found {_kind(following)}"]
        for part in fields(state):
            old, new = (getattr(one, part.name) for one in (state, following))
            if old.shape != new.shape or old.dtype != new.dtype:
                return [f"transition: {part.name} was {_about(old)} and becomes {_about(new)}"]
        if not _same(before, state):
            return ["transition: changes the state that it is given; return a new one"]
        if not _same(following, _call(world, "transition", state, action)):
            return ["transition: is not pure, the same state and action lead to different states"]
        terms = _call(world, "rewards", state, action, following)
        if not isinstance(terms, Mapping) or set(terms) != set(world.reward_terms):
            named = ", ".join(terms) if isinstance(terms, Mapping) else _kind(terms)
            return [f"rewards: expected the terms {', '.join(world.reward_terms)}, found {named}"]
        for name, value in terms.items():
            if fault := _fault("rewards", name, value, (ROUNDS,), float):
                return [f"{fault} (step {step})"]
        if fault := _fault("over", "", _call(world, "over", state), (ROUNDS,), bool):
            return [fault]
        state = following
    return []


def _looks(world: World) -> list[str]:
    """Check observations, and methods that read them, along rounds ``[B, T]``."""
    generator = torch.Generator().manual_seed(2)
    states, actions = [_start(world)], []
    for _ in range(world.horizon):
        actions.append(torch.randint(len(world.actions), (ROUNDS,), generator=generator))
        states.append(_call(world, "transition", states[-1], actions[-1]))
    along = map_state(lambda *parts: torch.stack(parts, 1), *states)
    shape = (ROUNDS, world.horizon + 1)
    observation = _call(world, "observe", along)
    expected = {"ego": (*shape, len(world.ego_features))} | {
        m.name: (*shape, len(m.items), len(m.features)) for m in world.modalities
    }
    if not isinstance(observation, Mapping) or set(observation) != set(expected):
        named = ", ".join(observation) if isinstance(observation, Mapping) else _kind(observation)
        return [f"observe: expected {', '.join(expected)}, found {named}"]
    found = [_fault("observe", n, observation[n], own, float) for n, own in expected.items()]
    if any(found):
        return [fault for fault in found if fault]
    items = {m.name: (*shape, len(m.items)) for m in world.modalities}
    masks = {"communicable": _call(world, "communicable", observation)}
    for setting in world.settings:
        masks[f"visibility in {setting}"] = _call(world, "visibility", setting, observation)
    for name, mask in masks.items():
        if not isinstance(mask, Mapping) or set(mask) != set(items):
            named = ", ".join(mask) if isinstance(mask, Mapping) else _kind(mask)
            return [
                f"{name}: expected masks of {', '.join(items)} (also of modalities that are only "
                f"said), found {named}"
            ]
        found += [_fault(name, key, mask[key], own, bool) for key, own in items.items()]
    for rule, broken in _call(world, "faults", observation).items():
        if bool(broken.any()):
            found.append(f"observe: {rule}, but it is not")
    placed = _call(world, "distance", observation)
    if not isinstance(placed, tuple) or len(placed) != 2:  # noqa: PLR2004
        return [f"distance: expected directions and distances, found {_kind(placed)}"]
    direction, distance = placed
    found.append(_fault("distance", "", distance, items["visual"], None))
    if any(found):
        return [fault for fault in found if fault]
    if bool((direction < 0).any()) or bool((direction >= len(world.directions)).any()):
        found.append(f"distance: expected directions from 0 to {len(world.directions) - 1}")
    elif float(distance.max()) > world.reach_bins[-1]:
        found.append(
            f"reach_bins: the last one has to be all the world, {float(distance.max()):g} "
            f"{world.reach_unit}, found {world.reach_bins[-1]:g}"
        )
    symbols = _call(world, "symbols", observation)
    if set(symbols) != set(world.symbol_sizes):
        return [f"symbols: expected {', '.join(world.symbol_sizes)}, found {', '.join(symbols)}"]
    for name, value in symbols.items():
        size = world.symbol_sizes[name]
        found.append(_fault("symbols", name, value, (*expected[name][:-1], size), float))
    if not any(found):
        found += _faults_of_symbols(world, observation, symbols)
    if world.random:
        found.append(_fault_of_chance(world, along, observation))
    behind = _call(world, "state_behind", observation)
    if type(behind) is not type(along):
        return [f"state_behind: expected {_kind(along)}, found {_kind(behind)}"]
    again = _call(world, "observe", behind)
    following = _call(
        world,
        "next_observation",
        {n: v[:, :-1] for n, v in observation.items()},
        torch.stack(actions, 1),
    )
    for name, value in observation.items() if not (world.partly_observed or world.random) else ():
        if bool(((again[name] - value).abs() > TOLERANCE).any()):
            found.append(f"state_behind: {name} of the state is not what was observed")
        elif bool(((following[name] - value[:, 1:]).abs() > TOLERANCE).any()):
            found.append(
                f"state_behind: the next {name} is not that of the true state; something that "
                "matters cannot be observed"
            )
    if offers(world, "reference_values"):
        values = _call(world, "reference_values", along, 0.9)
        wanted = (*shape, len(world.actions))
        found.append(_fault("reference_values", "", values, wanted, float))
    if offers(world, "possible_rewards"):
        found.append(_fault_of_rewards(world, along, torch.stack(actions, 1), observation))
    if offers(world, "reflected"):
        found += _faults_of_reflection(world, along, observation)
    return [fault for fault in found if fault] or _of_one(world, along, observation)


def _of_its_own(world: World) -> list[str]:
    return _call(world, "own_faults")


def _faults_of_symbols(
    world: World, observation: Mapping[str, Tensor], symbols: Mapping[str, Tensor]
) -> list[str]:
    """Return faults of symbols ``[..., K, D]``: an item's may depend on it and the ego only.

    Beliefs of what a person imagines rest on that: some items are as observed, some as imagined.
    """
    every = {name: part for name, part in observation.items() if name != "ego"}
    other = {name: part.flip(1) for name, part in every.items()}
    chosen = {name: torch.arange(part.shape[-2]) % 2 == 0 for name, part in every.items()}
    mixed = {n: torch.where(chosen[n][:, None], part, other[n]) for n, part in every.items()}
    ego = {"ego": observation["ego"]}
    there, both = _call(world, "symbols", ego | other), _call(world, "symbols", ego | mixed)
    return [
        f"symbols: {name} of an item has to depend on that item and the ego only"
        for name in every
        if not torch.equal(
            both[name], torch.where(chosen[name][:, None], symbols[name], there[name])
        )
    ]


def _fault_of_chance(world: World, states: Any, observation: Mapping[str, Tensor]) -> str:
    """Return the fault of `World.redrawn`: it has to change seeds, and nothing that is observed."""
    others = _call(world, "redrawn", states, torch.Generator().manual_seed(3))
    for name, value in _call(world, "observe", others).items():
        if not torch.equal(value, observation[name]):
            return f"redrawn: changes {name}, expected states that look alike"
    return "redrawn: returns the same states, expected other seeds" * _same(states, others)


def _fault_of_rewards(
    world: World, states: Any, actions: Tensor, observation: Mapping[str, Tensor]
) -> str:
    """Return the fault of `World.possible_rewards`: they have to hold those of `rewards`."""
    now = {name: part[:, :-1] for name, part in observation.items()}
    possible = _call(world, "possible_rewards", now, actions)
    if possible is None:
        return ""
    shape = (*actions.shape, possible.shape[-1] if getattr(possible, "ndim", 0) else 1)
    if fault := _fault("possible_rewards", "", possible, shape, float):
        return fault
    before, after = (
        map_state(lambda part, at=at: part[:, at], states)
        for at in (slice(None, -1), slice(1, None))
    )
    earned = total_reward(_call(world, "rewards", before, actions, after))
    missing = ((possible - earned[..., None]).abs() > REWARD_TOLERANCE).all(-1)
    missing = missing & ~_call(world, "over", before)
    if not bool(missing.any()):
        return ""
    place = tuple(missing.nonzero()[0].tolist())
    listed = ", ".join(f"{each:g}" for each in possible[place].tolist())
    return f"possible_rewards: expected {earned[place].item():g} among them, found {listed}"


def _faults_of_reflection(
    world: World, states: Any, observation: Mapping[str, Tensor]
) -> list[str]:
    """Return faults of `World.reflected`: the image of an image has to be what there was."""
    found = []
    numbers = {f"reflected_items: {m.name}": len(m.items) for m in world.modalities}
    images = {f"reflected_items: {name}": image for name, image in world.reflected_items.items()}
    numbers["reflected_actions"] = len(world.actions)
    images["reflected_actions"] = world.reflected_actions
    for name, number in numbers.items():
        image = images.get(name, ())
        twice = [image[place] for place in image] if sorted(image) == [*range(number)] else []
        if twice != [*range(number)]:
            found.append(f"{name}: expected the mirror image of each of {number}, found {image}")
    twice = _call(world, "reflected", _call(world, "reflected", states))
    for name, value in _call(world, "observe", twice).items():
        if bool(((value - observation[name]).abs() > TOLERANCE).any()):
            found.append(f"reflected: {name} of the mirror image of a mirror image differs")
    return found


def _of_one(world: World, states: Any, observations: Mapping[str, Tensor]) -> list[str]:
    """Check that methods for one state, and memory, can be called."""
    state = map_state(lambda part: part[0, 0], states)
    now = {name: value[0, 0] for name, value in observations.items()}
    behind = _call(world, "state_behind", now)
    again = _call(world, "observe", behind)
    if any(again[name].shape != value.shape for name, value in now.items()):
        return ["state_behind: of one observation without a batch expected one state"]
    _call(world, "next_observation", now, torch.tensor(0))
    _call(world, "render", state)
    for modality in world.modalities:
        for item in (*modality.items, *(name for name, _ in modality.groups)):
            _call(world, "describe", now, modality.name, item)
    for action in range(len(world.actions)):
        _call(world, "deed", now, None, action)
    _call(world, "anywhere", 2, torch.Generator().manual_seed(0))
    for name in ("relevance", "decisive", "nearest"):
        _call(world, name, now)
    knowledge = _call(world, "nothing_known")
    unseen = _call(world, "visibility", world.settings[0], now)
    knowledge = _call(world, "learn", knowledge, now, unseen, lambda seen: unseen)
    _call(world, "known", knowledge)
    assumed, _ = _call(world, "assume", knowledge, now)
    if set(assumed) != set(world.assumptions):
        return [f"assume: expected {', '.join(world.assumptions) or 'none'} (assumptions)"]
    makes = {name: torch.tensor(True) for name in world.assumptions}
    _call(world, "supposed", state, knowledge, makes)
    return []


def _fault(where: str, name: str, value: Any, shape: tuple[int, ...], kind: type | None) -> str:
    """Return the fault of a tensor, or an empty text."""
    named = f"{where}: {name}".rstrip(": ")
    if not isinstance(value, Tensor):
        return f"{named} has to be a tensor, found {_kind(value)}"
    if tuple(value.shape) != shape:
        return f"{named} has shape {tuple(value.shape)}, expected {shape}"
    if kind is bool and value.dtype != torch.bool:
        return f"{named} has {value.dtype}, expected torch.bool"
    if kind is float and value.dtype != torch.get_default_dtype():
        return f"{named} has {value.dtype}, expected {torch.get_default_dtype()}"
    if value.is_floating_point() and not bool(value.isfinite().all()):
        return f"{named} has {value[~value.isfinite()][0].item():g}, expected finite numbers"
    return ""


def _kind(value: Any) -> str:
    return type(value).__name__


def _about(value: Tensor) -> str:
    return f"{value.dtype} {tuple(value.shape)}".removeprefix("torch.")


def _same(first: Any, second: Any) -> bool:
    return all(
        torch.equal(getattr(first, part.name), getattr(second, part.name)) for part in fields(first)
    )
