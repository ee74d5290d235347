"""Bomb defusal: three stages, and rules that the robot got wrong (supplement, sections A and E).

Description
    A bomb is defused in three stages; at each a button has to be pressed. Which of four it is
    depends on the type of the bomb, A or B, and on the symbol that one of six terminals shows::

        type    cross    plus    frame    bars     as the robot was taught, instead
        A       red      green   yellow   blue     frame blue, bars yellow
        B       yellow   blue    green    red      cross green, frame yellow

    That terminal is lit; symbols of the others do not matter. Every stage has new terminals.

    The robot's rules and the true rules are two instances of this domain, see
    `BombDefusal.as_believed`.

Actions
    0 wait, 1 red, 2 green, 3 blue, 4 yellow. A press leads to the next stage, right or wrong.

Observations
    ========  ============  =======  ===============================================================
    ego       stage         count    present stage, 0 to 2; 3 when all is done; always known
    ego       since         steps    steps since it began; always known
    visual    75 numbers    0 to 1   pixels of each terminal: row, column, red-green-blue
    verbal    kind          0 or 1   the type of the bomb in the utterance: 1 if it is B
    ========  ============  =======  ===============================================================

    In the setting ``labelled`` the type is written on the bomb; in ``unlabelled`` it is hidden.
    All terminals are in view in both: how soon people find the lit one depends on the person, not
    on the setting.

Rewards, of the action and the state that it leads to
    =====  ===  =====================================
    right  +5   for the right button
    wrong  -5   for another
    time   -1   for each step until the third press
    =====  ===  =====================================

Start and end
    A round begins at the first stage, and is over after the third press or 60 steps.

Version history
    1: first version.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from mirror_ppl.domains.base import Observation, Visibility, require_known
from mirror_ppl.domains.bomb_defusal.drawing import LEGEND, draw_panel
from mirror_ppl.domains.bomb_defusal.knowledge import BombKnowledge
from mirror_ppl.domains.bomb_defusal.panel import (
    BUTTONS,
    KINDS,
    OLD_RULES,
    PICTURE,
    RULES,
    STAGES,
    SYMBOLS,
    TERMINALS,
    Rules,
    panel,
    read_panel,
    right_button,
)
from mirror_ppl.domains.bomb_defusal.record import RECORD
from mirror_ppl.domains.modality import Modality
from mirror_ppl.domains.world import World

RIGHT, WRONG, TIME = 5.0, -5.0, -1.0
WAIT = 0
LIVE_NOWHERE = -1
PIXELS = PICTURE[0] * PICTURE[1] * PICTURE[2]


@dataclass(frozen=True)
class BombState:
    """State of a batch of rounds.

    Attributes:
        stage: ``[...]``, 0 to 2; 3 when all is done.
        since: steps since the stage began ``[...]``, at most the horizon.
        kind: type of the bomb ``[...]``, 0 for A and 1 for B.
        live: the lit terminal of each stage ``[..., 3]``.
        symbols: symbols of the terminals of each stage ``[..., 3, 6]``, indices into ``SYMBOLS``.
    """

    stage: Tensor
    since: Tensor
    kind: Tensor
    live: Tensor
    symbols: Tensor


class BombDefusal(World):
    """The domain of bomb defusal; see the module's description.

    Args:
        rules: the right buttons.
    """

    name = "bomb_defusal"
    record = RECORD
    version = "1"
    modalities: tuple[Modality, ...] = (
        Modality(
            "visual",
            tuple(f"terminal {number}" for number in range(1, TERMINALS + 1)),
            tuple(
                f"pixel {row} {column} {colour}"
                for row in range(PICTURE[0])
                for column in range(PICTURE[1])
                for colour in ("red", "green", "blue")
            ),
            ("intensity",) * PIXELS,
            (1.0,) * PIXELS,
            0.3,
            image=PICTURE,
        ),
        Modality(
            "verbal",
            ("type",),
            ("kind",),
            ("truth",),
            (1.0,),
            0.5,
            utterances=(tuple(f"{kind} bomb" for kind in KINDS),),
        ),
    )
    ego_features: tuple[str, ...] = ("stage", "since")
    symbol_sizes: Mapping[str, int] = {"ego": STAGES + 1, "visual": PIXELS, "verbal": len(KINDS)}
    actions: tuple[str, ...] = ("wait", *BUTTONS)
    horizon = 60
    over_at_horizon = False
    settings: tuple[str, ...] = ("labelled", "unlabelled")
    scenarios: tuple[str, ...] = tuple(f"{kind} bomb" for kind in KINDS)
    reward_terms: tuple[str, ...] = ("right", "wrong", "time")
    mishap: tuple[str, str] = ("wrong", "wrong buttons")
    picture_legend = LEGEND
    directions: tuple[str, ...] = ("panel",)
    reach_bins: tuple[float, ...] = (0.0,)
    """All people have the same reach: every terminal is in front of them."""
    reach_unit = "steps"
    told_practice = 0.5
    # The robot assumes people to be about as quick as needed for waiting to pay.
    notice_practice = (0.25, 1.0)
    partial_views: Mapping[str, tuple[float, ...]] = {}

    def __init__(self, rules: Rules = RULES) -> None:
        self.rules = rules

    @property
    def as_believed(self) -> BombDefusal:
        """World as the robot was taught it: with the old rules."""
        return BombDefusal(OLD_RULES)

    def initial(
        self, batch: int, generator: torch.Generator, scenario: Tensor | None = None
    ) -> BombState:
        """Draw states ``[batch]`` at the first stage.

        Args:
            batch: number of rounds.
            generator: source of randomness; its device is that of the states.
            scenario: indices ``[batch]`` into ``scenarios``; drawn uniformly unless given.
        """
        device = generator.device

        def drawn(most: int, *shape: int) -> Tensor:
            return torch.randint(most, (batch, *shape), generator=generator, device=device)

        scenario = self.scenario(batch, generator, scenario)
        nothing = torch.zeros(batch, dtype=torch.long, device=device)
        return BombState(
            stage=nothing,
            since=nothing,
            kind=scenario,
            live=drawn(TERMINALS, STAGES),
            symbols=drawn(len(SYMBOLS), STAGES, TERMINALS),
        )

    def anywhere(self, batch: int, generator: torch.Generator) -> BombState:
        """Draw states ``[batch]`` at the beginning of any stage."""
        state = self.initial(batch, generator)
        stage = torch.randint(STAGES, (batch,), generator=generator, device=generator.device)
        return replace(state, stage=stage)

    def transition(self, state: BombState, action: Tensor) -> BombState:
        """Return the state at t + 1; ``action`` ``[...]`` is an index into ``actions``."""
        presses = (action != WAIT) & ~self.over(state)
        waits = (action == WAIT) & ~self.over(state)
        return replace(
            state,
            stage=state.stage + presses.long(),
            since=torch.where(presses, 0, state.since + waits.long()).clamp(max=self.horizon),
        )

    def rewards(self, state: BombState, action: Tensor, following: BombState) -> dict[str, Tensor]:
        """Return reward terms ``[...]`` by name, in units of reward."""
        del following
        _, symbol = self._shown(state)
        presses = (action != WAIT) & ~self.over(state)
        right = action - 1 == right_button(self.rules, state.kind, symbol)
        dtype = torch.get_default_dtype()
        return {
            "right": RIGHT * (presses & right).to(dtype),
            "wrong": WRONG * (presses & ~right).to(dtype),
            "time": TIME * (~self.over(state)).to(dtype),
        }

    def _panel(self, state: BombState) -> tuple[Tensor, Tensor]:
        """Return the lit terminal ``[...]`` and all symbols ``[..., 6]`` of the present stage."""
        stage = state.stage.clamp(max=STAGES - 1)
        live = state.live.take_along_dim(stage[..., None], -1).squeeze(-1)
        symbols = state.symbols.take_along_dim(stage[..., None, None], -2).squeeze(-2)
        return live, symbols

    def _shown(self, state: BombState) -> tuple[Tensor, Tensor]:
        """Return the lit terminal ``[...]`` and its symbol."""
        live, symbols = self._panel(state)
        return live, symbols.take_along_dim(live[..., None], -1).squeeze(-1)

    def over(self, state: BombState) -> Tensor:
        """Return where the third button was pressed ``[...]``."""
        return state.stage >= STAGES

    def observe(self, state: BombState) -> Observation:
        """Return ego ``[..., 2]``, visual ``[..., 6, 75]`` and verbal ``[..., 1, 1]``.

        When all is done no terminal is lit.
        """
        dtype = torch.get_default_dtype()
        live, symbols = self._panel(state)
        live = torch.where(self.over(state), LIVE_NOWHERE, live)
        return {
            "ego": torch.stack([state.stage, state.since], -1).to(dtype),
            "visual": panel(live, symbols).to(dtype),
            "verbal": state.kind[..., None, None].to(dtype),
        }

    def visibility(self, setting: str, observation: Observation) -> Visibility:
        """Return what an unaided person sees in a setting.

        Raises:
            UnknownNameError: if the setting is neither ``labelled`` nor ``unlabelled``.
        """
        require_known(setting, "setting", self.settings, self.name)
        everything = self.communicable(observation)
        if setting == "labelled":
            return everything
        return {**everything, "verbal": torch.zeros_like(everything["verbal"])}

    def sought(self, observation: Observation) -> Tensor:
        """Return a mask of the lit terminal ``[..., 6]``, if there is one."""
        live, _ = read_panel(observation["visual"])
        lit = torch.arange(TERMINALS, device=live.device) == live[..., None]
        return lit & (observation["ego"][..., :1] < STAGES)

    def faults(self, observation: Observation) -> dict[str, Tensor]:
        """Return which observations ``[...]`` break each rule of recordings, by rule."""
        stage, since = observation["ego"].unbind(-1)
        kind = observation["verbal"][..., 0, 0]
        possible = (stage == stage.round()) & (stage >= 0) & (stage <= STAGES)
        live, symbols = read_panel(observation["visual"])
        live = torch.where(stage >= STAGES, LIVE_NOWHERE, live)
        unlike = (observation["visual"] - panel(live, symbols)).abs().amax((-1, -2))
        return {
            "stage has to be 0, 1, 2 or 3": ~possible,
            "since has to be a whole number, 0 or more": (since != since.round()) | (since < 0),
            "kind has to be 0 or 1": (kind != 0) & (kind != 1),
            "one terminal has to be lit until all is done, and each to show a symbol": (
                unlike > 1e-3  # noqa: PLR2004 - of rounding
            ),
        }

    def nothing_known(self, *batch: int, device: torch.device | None = None) -> BombKnowledge:
        """Return knowledge ``[*batch]`` before anything was observed."""
        return BombKnowledge.nothing(*batch, device=device)

    def learn(
        self,
        knowledge: BombKnowledge,
        observation: Observation,
        visible: Visibility,
        sees: Callable[[Observation], Visibility],
    ) -> BombKnowledge:
        """Return knowledge after a step: the type stays known, terminals until the next stage."""
        del sees
        return knowledge.learn(observation, visible)

    def known(self, knowledge: BombKnowledge) -> Visibility:
        """Return terminals ``[..., 6]`` and utterances ``[..., 1]`` whose content is known."""
        return knowledge.items()

    def symbols(self, observation: Observation) -> dict[str, Tensor]:
        """Encode observations for networks.

        Returns:
            ego ``[..., 4]``, one-hot stage; visual ``[..., 6, 75]``, raw pixels; verbal
            ``[..., 1, 2]``, one-hot which of the two utterances is true.
        """
        ego = one_hot(observation["ego"][..., 0].long(), STAGES + 1).to(observation["ego"])
        said = one_hot(observation["verbal"][..., 0].long(), len(KINDS)).to(observation["ego"])
        return {"ego": ego, "visual": observation["visual"], "verbal": said}

    def distance(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Return zeros ``[..., 6]``: there is one direction, and all terminals are at hand."""
        distance = torch.zeros_like(observation["visual"][..., 0])
        return distance.long(), distance

    def state_behind(self, observation: Observation) -> BombState:
        """Return the state ``[...]`` with this full observation.

        Other stages cannot be observed: their terminals are set to the present ones.
        """
        stage, since = observation["ego"].round().long().unbind(-1)
        live, symbols = read_panel(observation["visual"])
        return BombState(
            stage=stage,
            since=since,
            kind=observation["verbal"][..., 0, 0].round().long(),
            live=live[..., None].expand(*live.shape, STAGES),
            symbols=symbols[..., None, :].expand(*live.shape, STAGES, TERMINALS),
        )

    def nothing_new(self, observation: Observation) -> Tensor:
        """Return the steps ``[T + 1]`` but the first of a stage, as bombs do not change within."""
        stage = observation["ego"][:, 0]
        return torch.cat([torch.zeros_like(stage[:1], dtype=torch.bool), stage[1:] == stage[:-1]])

    def next_observation(self, observation: Observation, action: Tensor) -> Observation:
        """Return the observation after an action ``[...]``; NaN for terminals of a new stage."""
        state = self.state_behind(observation)
        following = self.transition(state, action)
        expected = self.observe(following)
        new = (following.stage != state.stage) & ~self.over(following)
        visual = expected["visual"].masked_fill(new[..., None, None], torch.nan)
        return {**expected, "visual": visual}

    def possible_rewards(self, observation: Observation, action: Tensor) -> Tensor:
        """Return the rewards ``[..., 2]`` of a right and a wrong press, or twice that of waiting.

        Recorded rewards decide which rules are inferred, so that either press is possible.
        """
        del observation
        right, wrong = (
            torch.where(action == WAIT, TIME, TIME + outcome) for outcome in (RIGHT, WRONG)
        )
        return torch.stack([right, wrong], -1)

    def nearest(self, observation: Observation) -> Observation:
        """Return the possible observation nearest to decoded values."""
        stage, since = observation["ego"].round().unbind(-1)
        live, symbols = read_panel(observation["visual"])
        stage = stage.clamp(0, STAGES)
        live = torch.where(stage >= STAGES, LIVE_NOWHERE, live)
        return {
            "ego": torch.stack([stage, since.clamp(min=0)], -1),
            "visual": panel(live, symbols).to(observation["visual"]),
            "verbal": observation["verbal"].round().clamp(0, 1),
        }

    def relevance(self, observation: Observation) -> dict[str, Visibility]:
        """Return the lit terminal and the type (supplement, section F)."""
        return {"terminal_and_type": self.decisive(observation)}

    def decisive(self, observation: Observation) -> Visibility:
        """Return the lit terminal and the type, until all is done."""
        under_way = observation["ego"][..., :1] < STAGES
        return {
            "visual": self.sought(observation),
            "verbal": under_way.expand(observation["verbal"].shape[:-1]),
        }

    def describe(self, observation: Observation, modality: str, item: str) -> str:
        """Describe an item, such as "Type A bomb", or "terminal 2 (lit, cross)"."""
        if modality == "verbal":
            return f"{KINDS[int(observation['verbal'][0, 0])]} bomb"
        live, symbols = read_panel(observation["visual"])
        number = self.modalities[0].items.index(item)
        shows = tuple(SYMBOLS)[int(symbols[number])]
        return f"{item} ({'lit, ' if number == int(live) else ''}{shows})"

    def deed(self, observation: Observation, item: str | None, action: int) -> str:
        """Describe an action, such as "press red"."""
        del observation, item
        return "wait" if action == WAIT else f"press {self.actions[action]}"

    def reference_values(self, state: BombState, discount: float) -> Tensor:
        """Return exact action values ``[..., 5]`` of known states, without a horizon."""
        _, symbol = self._shown(state)
        right = right_button(self.rules, state.kind, symbol)
        presses = torch.arange(len(BUTTONS), device=right.device) == right[..., None]
        left = torch.arange(STAGES + 1, device=right.device).flip(0)
        weights = discount ** torch.arange(STAGES, device=right.device)
        best = torch.cat([weights.new_zeros(1), weights.cumsum(0)])[left] * (RIGHT + TIME)
        now, following = best[state.stage], best[(state.stage + 1).clamp(max=STAGES)]
        values = torch.where(presses, RIGHT, WRONG) + (discount * following + TIME)[..., None]
        values = torch.cat([(TIME + discount * now)[..., None], values], -1)
        return torch.where(self.over(state)[..., None], 0.0, values)

    def render(self, state: BombState) -> np.ndarray:
        """Draw ``uint8 [height, width, 3]`` of one state: the terminals, the type, the stage."""
        pixels = self.observe(state)["visual"]
        return draw_panel(pixels, int(state.stage), int(state.kind))
