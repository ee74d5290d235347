"""Worlds from small deterministic Gymnasium environments, by tabulating their states.

Inference and planning simulate thousands of histories at once, while an environment steps one at a
time. So every state that can be reached from some seeds is visited once, each action is tried
there, and the outcomes are tabulated. The world is then a look-up, and exact action values follow.
The tables are cached in a file.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import pickle
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Generic

import gymnasium as gym
import torch
from torch import Tensor

from mirror_ppl.checkpoints import read_checkpoint, save_checkpoint
from mirror_ppl.domains.base import Observation, Visibility
from mirror_ppl.domains.counterfactual import decisive_items
from mirror_ppl.domains.environment_world import CLOSE, UNSEEN, EnvironmentWorld, as_tensors
from mirror_ppl.errors import CheckpointError, DomainError, OutputError
from mirror_ppl.progress import Progress
from mirror_ppl.row_hashing import as_whole_numbers, row_numbers

SWEEPS = 1000
"""Maximum number of sweeps of value iteration."""
SOONER, LITTLE = 0.95, 1e-4
"""A discount to break ties between undiscounted values, and the weight of these values."""
CACHED = ("tables", "_names", "_path", "_values", "_decisive")
"""Attributes that are computed once."""
TRIED_TWICE = 200
"""Number of states tried again when reached on another way, to detect unobserved state."""


@dataclass(frozen=True)
class Place:
    """Index of a state in the table, ``[...]``."""

    number: Tensor


@dataclass(frozen=True)
class Tables:
    """Observations, transitions and rewards of S states.

    Attributes:
        observation: full observation of each, ``[S, ...]``.
        following: the state after each action ``[S, A]``.
        terms: reward terms of each action by name, ``[S, A]``.
        over: where the task is done, ``[S]``.
        begins: where rounds may begin, ``[S]``.
    """

    observation: dict[str, Tensor]
    following: Tensor
    terms: dict[str, Tensor]
    over: Tensor
    begins: Tensor


class GymnasiumWorld(EnvironmentWorld):
    """Base class of a world from a small Gymnasium environment; derive from it.

    Implement ``make()`` and ``look(env)``. The environment is copied by pickling. Those with more
    states, or continuous actions, are for :class:`~mirror_ppl.domains.stepped_world.SteppedWorld`.

    Attributes:
        most_states: maximum number of states.
    """

    most_states: int = 100_000

    def begins(self, env: Any) -> bool:
        """True if rounds may also begin in this state, which need not follow a reset."""
        del env
        return False

    @cached_property
    def tables(self) -> Tables:
        """Tables of all states, read from their file or computed.

        Raises:
            DomainError: the environment fails, has actions that are not numbered, is not
                deterministic, or has too many states.
        """
        path, identity = self._path, {"world": self.name}
        if path is None:
            return _visited(self)
        try:
            content = read_checkpoint(path, identity)
        except (CheckpointError, OSError):
            content = vars(_visited(self))
            with suppress(OSError, OutputError):  # without room for it, it is done again
                path.parent.mkdir(parents=True, exist_ok=True)
                save_checkpoint(path, identity, content)
        return Tables(**{part.name: content[part.name] for part in fields(Tables)})

    @cached_property
    def _path(self) -> Path | None:
        return _file(self)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle with the tables, or with the file from which other processes read them.

        Other processes do not have the source of the class, and cannot visit the environment.
        """
        tables, path = self.tables, self._path
        kept = {"tables": tables} if path is None or not path.exists() else {}
        own = {name: part for name, part in vars(self).items() if name not in CACHED}
        return own | kept | {"_path": path}

    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> Place:
        """Draw states in which rounds may begin, uniformly."""
        del scenario
        return self._drawn(self.tables.begins, batch, generator)

    def anywhere(self, batch: int, generator: torch.Generator) -> Place:
        """Draw states in which the task is not done, uniformly."""
        return self._drawn(~self.tables.over, batch, generator)

    def _drawn(self, where: Tensor, batch: int, generator: torch.Generator) -> Place:
        device = generator.device
        known = where.nonzero().squeeze(-1).to(device)
        return Place(known[torch.randint(len(known), (batch,), generator=generator, device=device)])

    def transition(self, state: Place, action: Tensor) -> Place:
        """Look up the next state."""
        return Place(self.tables.following.to(action.device)[state.number, action])

    def rewards(self, state: Place, action: Tensor, following: Place) -> dict[str, Tensor]:
        """Look up the reward terms."""
        del following
        tables = self.tables.terms
        return {name: each.to(action.device)[state.number, action] for name, each in tables.items()}

    def over(self, state: Place) -> Tensor:
        """Return where the environment has terminated."""
        return self.tables.over.to(state.number.device)[state.number]

    def observe(self, state: Place) -> Observation:
        """Look up the full observation."""
        device = state.number.device
        return {
            name: value.to(device)[state.number] for name, value in self.tables.observation.items()
        }

    def state_behind(self, observation: Observation) -> Place:
        """Return the state with this observation, or the nearest state if there is none."""
        rows = _rows(observation)
        names, order = self._names
        names, order = names.to(rows.device), order.to(rows.device)
        place = torch.searchsorted(names, row_numbers(rows)).clamp(max=len(names) - 1)
        found = order[place]
        strange = (_rows(self.tables.observation).to(rows.device)[found] != rows).any(-1)
        if bool(strange.any()):
            nearest = self._nearest({name: value[strange] for name, value in observation.items()})
            found = found.masked_scatter(strange, nearest)
        return Place(found)

    def knows(self, observation: Mapping[str, Any]) -> bool:
        """True if an observation from `look` is that of a visited state."""
        one = as_tensors(observation)
        behind = self.tables.observation
        number = self.state_behind(one).number
        return all(bool((behind[name][number] == value).all()) for name, value in one.items())

    @cached_property
    def _names(self) -> tuple[Tensor, Tensor]:
        names, order = row_numbers(_rows(self.tables.observation)).sort()
        return names, order

    def nearest(self, observation: Observation) -> Observation:
        """Return the observation of the nearest state, with features in units of their scales."""
        shape = observation["ego"].shape[:-1]
        flat = {n: v.reshape(-1, *v.shape[len(shape) :]) for n, v in observation.items()}
        return self.observe(Place(self._nearest(flat).view(shape)))

    def _nearest(self, observation: Observation) -> Tensor:
        """Return indices ``[n]`` of the states nearest to observations ``[n, ...]``."""
        known, own = (
            torch.cat([part.flatten(1) for part in self._scaled(each).values()], -1)
            for each in (self.tables.observation, observation)
        )
        parts = own.split(1024)
        return torch.cat([torch.cdist(part, known.to(part), p=1).argmin(-1) for part in parts])

    def _scaled(self, observation: Observation) -> dict[str, Tensor]:
        scales = {m.name: torch.tensor(m.scales) for m in self.modalities}
        return {
            name: observation[name] / scales[name].to(observation[name])
            if name in scales
            else value
            for name, value in sorted(observation.items())
        }

    @cached_property
    def _values(self) -> dict[float, Tensor]:
        return {}  # by discount, once requested

    def reference_values(self, state: Place, discount: float) -> Tensor:
        """Return exact values ``[..., A]`` by value iteration; undiscounted to the horizon.

        Undiscounted ties are broken in favour of earlier rewards.
        """
        known = self._values
        if discount not in known:
            known[discount] = self._iterated(discount)
            if discount == 1:
                # Ties are broken in favour of sooner rewards, else an agent may wait forever.
                known[discount] = known[discount] + LITTLE * self._iterated(SOONER)
        return known[discount].to(state.number.device)[state.number]

    @cached_property
    def _decisive(self) -> Visibility:
        # With a discount, waiting is worse than acting, also where steps cost nothing.
        values = self.reference_values(Place(torch.arange(len(self.tables.over))), SOONER)
        names = [m.name for m in self.modalities]
        return decisive_items(self.tables.observation, values, names)

    def relevance(self, observation: Observation) -> dict[str, Visibility]:
        """Items ``[..., K]`` of which another value would change what is best to do."""
        number = self.state_behind(observation).number
        masks = {name: mask.to(number.device)[number] for name, mask in self._decisive.items()}
        return {"decisive": masks}

    def _iterated(self, discount: float) -> Tensor:
        tables, reward = self.tables, sum(self.tables.terms.values())
        values = torch.zeros_like(torch.as_tensor(reward))
        for _ in range(SWEEPS if discount < 1 else self.horizon):
            after = values.amax(-1).masked_fill(tables.over, 0.0)
            new = reward + discount * after[tables.following]
            done = bool((new - values).abs().max() < CLOSE)
            values = new
            if done:
                break
        return values


def _rows(observation: Observation) -> Tensor:
    """Return observations ``[...]`` as whole numbers ``[..., N]``, in the order of names."""
    dimensions = observation["ego"].dim() - 1
    parts = [as_whole_numbers(part).flatten(dimensions) for _, part in sorted(observation.items())]
    return torch.cat(parts, -1)


def _file(world: GymnasiumWorld) -> Path | None:
    """Return the cache file of a world's tables, by hash of its code; None without source."""
    kind, given = type(world), {n: v for n, v in vars(world).items() if n not in CACHED}
    content = f"{kind.version} {kind.layouts} {kind.horizon} {kind.moves} {given} {gym.__version__}"
    try:
        for each in (*kind.__mro__, *type(world.made().unwrapped).__mro__):
            if each not in (object, Generic):  # built in from Python 3.12 on
                content += inspect.getsource(each) + Path(inspect.getfile(each)).read_text()
    except (OSError, TypeError):
        return None
    digest = hashlib.sha256(content.encode()).hexdigest()[:16]
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "mirror_ppl" / f"{kind.__name__}-{digest}.pt"


def _visited(world: GymnasiumWorld) -> Tables:
    """Visit every state that can be reached."""
    env = world.made()
    if world.controls:
        raise DomainError(f"{world.name}: a world with controls has to be a SteppedWorld")
    if world.random:
        raise DomainError(f"{world.name}: a random world has to be a SteppedWorld")
    moves = world.commands(env)
    numbers: dict[bytes, int] = {}
    seen: list[dict[str, Tensor]] = []
    waiting: list[bytes] = []
    begins, over, following, terms = [], [], [], []
    again: list[tuple[int, bytes]] = []
    most = 0

    def visit(end: bool, begin: bool = False) -> int:
        own = as_tensors(world.seen(env))
        key = pickle.dumps([part.tolist() for part in own.values()])
        number = numbers.get(key)
        if number is None:
            number = numbers[key] = len(seen)
            if len(seen) >= world.most_states:
                raise DomainError(
                    f"{world.name}: more than {world.most_states} states; fewer layouts, or a "
                    "smaller world, or more of them in most_states"
                )
            seen.append(own)
            over.append(end)
            begins.append(False)
            waiting.append(b"" if end else pickle.dumps(env))
        elif over[number] != end:
            raise DomainError(f"{world.name}: both over and not over in {own}; {UNSEEN}")
        elif number < len(following) and not end and (begin or len(again) < most):
            again.append((number, pickle.dumps(env)))
        begins[number] |= not end and (begin or world.begins(env.unwrapped))
        return number

    def tried(snapshot: bytes) -> list[tuple[int, dict[str, float]]]:
        nonlocal env
        found = []
        for move in moves:
            env = pickle.loads(snapshot)
            _, reward, terminated, _, _ = env.step(move)
            found.append(
                (
                    visit(bool(terminated)),
                    world.named_terms(env, move, reward, terminated),
                )
            )
        return found

    with Progress(f"visit {world.name}", world.layouts) as progress:
        for seed in range(world.layouts):
            # Some per layout, because unobserved state may also differ between resets.
            most = len(again) + max(TRIED_TWICE // world.layouts, 5)
            env.reset(seed=seed)
            visit(False, begin=True)
            while len(following) < len(seen):
                number = len(following)
                if over[number]:
                    outcome = [(number, dict.fromkeys(world.reward_terms, 0.0))] * len(moves)
                else:
                    outcome = tried(waiting[number])
                    waiting[number] = b""
                following.append([one for one, _ in outcome])
                terms.append([own for _, own in outcome])
            progress.advance()
        for number, snapshot in tuple(again):
            found = tried(snapshot)
            same = [one for one, _ in found] == following[number] and all(
                abs(own[name] - value) <= CLOSE
                for (_, own), known in zip(found, terms[number], strict=True)
                for name, value in known.items()
            )
            if not same:
                raise DomainError(
                    f"{world.name}: outcomes of actions in "
                    f"{ {n: p.tolist() for n, p in seen[number].items()} } vary; "
                    f"{world.likely_cause}"
                )
    return Tables(
        {name: torch.stack([one[name] for one in seen]) for name in seen[0]},
        torch.tensor(following),
        {
            name: torch.tensor(
                [[own[name] for own in row] for row in terms], dtype=torch.get_default_dtype()
            )
            for name in world.reward_terms
        },
        torch.tensor(over),
        torch.tensor(begins),
    )
