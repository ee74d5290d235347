"""Search and rescue as a Gymnasium environment, one round at a time."""

from __future__ import annotations

from typing import ClassVar

from mirror_ppl.domains.environment import DomainEnv
from mirror_ppl.domains.search_rescue.house import SIDE
from mirror_ppl.domains.search_rescue.world import SearchRescue


class SearchRescueEnv(DomainEnv):
    """A burning house in nine portions, and what one firefighter sees and hears of it.

    ## Description
    A round of `mirror_ppl.domains.search_rescue.SearchRescue`, seen by an unaided person in one of
    the domain's settings. All mechanics are the domain's.

    ## Action Space
    `Discrete(4)`: 0 up, 1 down, 2 left, 3 right.

    ## Observation Space
    A `Dict`; portions are in reading order, utterances about the left and the right corridor and
    the rooms at the top left, middle and right. A masked value is 0.

    | key           | shape   | type    | feature                      | unit      | range  |
    |---------------|---------|---------|------------------------------|-----------|--------|
    | `ego`         | (3,)    | float32 | row, column                  | cells     | 0 to 8 |
    |               |         |         | carrying the victim          | truth     | 0 or 1 |
    | `visual`      | (9, 27) | float32 | pixels of the portion: row,  | intensity | 0 to 1 |
    |               |         |         | column, red-green-blue       |           |        |
    | `visual_mask` | (9,)    | int8    | the portion is seen          |           | 0 or 1 |
    | `verbal`      | (5, 1)  | float32 | corridor blocked, victim here| truth     | 0 or 1 |
    | `verbal_mask` | (5,)    | int8    | the utterance is heard       |           | 0 or 1 |

    `info` holds the `scenario`'s name and, in `state`, the true `place` (row and column), `found`,
    `home`, `blocked` (0 none, 1 left, 2 right) and `victim` (index of the room); after a step also
    the `rewards`, terms by name.

    ## Rewards
    The sum of the domain's terms, of the action and the state that it leads to: `found` (+1),
    `returned` (+15), `collision` (-10 for walking into the obstacle) and `time` (-0.1 a step until
    they are back with the victim).

    ## Starting State
    At the entrance, in a random scenario unless one is given.

    ## Episode End
    Terminated when they are back at the entrance with the victim; else truncated after 48 steps.

    ## Arguments
    `setting` ("clear" or "smoke"), `scenario` (a name among `SearchRescue.scenarios`, or None for
    a random one in each round) and `render_mode` ("rgb_array" or None):
    `gymnasium.make("mirror_ppl/SearchRescue-v0", setting="smoke")`.

    ## Version History
    * v0: first version.

    Raises:
        UnknownNameError: if the setting, the scenario or the render mode is not a known one.
    """

    domain = SearchRescue()
    limits: ClassVar[dict[str, tuple[list[float], list[float]]]] = {
        "ego": ([0.0, 0.0, 0.0], [SIDE - 1, SIDE - 1, 1.0]),
        "visual": ([0.0], [1.0]),
        "verbal": ([0.0], [1.0]),
    }
