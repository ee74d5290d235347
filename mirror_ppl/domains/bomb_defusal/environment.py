"""Bomb defusal as a Gymnasium environment, one round at a time."""

from __future__ import annotations

from typing import ClassVar

from mirror_ppl.domains.bomb_defusal.panel import STAGES
from mirror_ppl.domains.bomb_defusal.world import BombDefusal
from mirror_ppl.domains.environment import DomainEnv


class BombDefusalEnv(DomainEnv):
    """A bomb with three stages, and what one person sees and hears of it.

    ## Description
    A round of `mirror_ppl.domains.bomb_defusal.BombDefusal`, with the true rules, seen by an
    unaided person in one of the domain's settings. All mechanics are the domain's. All terminals
    are in view: how soon people find the lit one depends on the person.

    ## Action Space
    `Discrete(5)`: 0 wait, 1 red, 2 green, 3 blue, 4 yellow.

    ## Observation Space
    A `Dict`; a masked value is 0.

    | key           | shape   | type    | feature                      | unit      | range   |
    |---------------|---------|---------|------------------------------|-----------|---------|
    | `ego`         | (2,)    | float32 | stage                        | count     | 0 to 3  |
    |               |         |         | steps since it began         | steps     | 0 to 60 |
    | `visual`      | (6, 75) | float32 | pixels of the terminal: row, | intensity | 0 to 1  |
    |               |         |         | column, red-green-blue       |           |         |
    | `visual_mask` | (6,)    | int8    | the terminal is in view      |           | 0 or 1  |
    | `verbal`      | (1, 1)  | float32 | the bomb is of Type B        | truth     | 0 or 1  |
    | `verbal_mask` | (1,)    | int8    | the type is known            |           | 0 or 1  |

    `info` holds the `scenario`'s name and, in `state`, the true `stage`, `since`, `kind` (0 for A),
    `live` (the lit terminal of each stage) and `symbols` (of all terminals at each stage);
    after a step also the `rewards`, terms by name.

    ## Rewards
    The sum of the domain's terms, of the action and the state that it leads to: `right` (+5),
    `wrong` (-5) and `time` (-1 a step until the third press).

    ## Starting State
    At the first stage, with a random bomb of a random type unless a scenario is given.

    ## Episode End
    Terminated after the third press; else truncated after 60 steps.

    ## Arguments
    `setting` ("labelled" or "unlabelled"), `scenario` (a name among `BombDefusal.scenarios`, or
    None for a random one in each round) and `render_mode` ("rgb_array" or None):
    `gymnasium.make("mirror_ppl/BombDefusal-v0", setting="unlabelled")`.

    ## Version History
    * v0: first version.

    Raises:
        UnknownNameError: if the setting, the scenario or the render mode is not a known one.
    """

    domain = BombDefusal()
    limits: ClassVar[dict[str, tuple[list[float], list[float]]]] = {
        "ego": ([0.0, 0.0], [STAGES, BombDefusal.horizon]),
        "visual": ([0.0], [1.0]),
        "verbal": ([0.0], [1.0]),
    }
