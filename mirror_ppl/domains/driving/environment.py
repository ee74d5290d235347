"""The driving domain as a Gymnasium environment, one round at a time."""

from __future__ import annotations

from typing import ClassVar

from mirror_ppl.domains.driving.knowledge import ROAD_END
from mirror_ppl.domains.driving.world import Driving
from mirror_ppl.domains.environment import DomainEnv


class DrivingEnv(DomainEnv):
    """Two lanes, four cars that never yield, and what one person sees of them.

    ## Description
    A round of `mirror_ppl.domains.driving.Driving`, seen by an unaided person in one of the
    domain's settings. All mechanics are the domain's: this class only draws the round, hides what
    the setting hides and counts steps.

    ## Action Space
    `Discrete(2)`: 0 stays in the lane, 1 is in the other lane at the next step.

    ## Observation Space
    A `Dict`; cars are in the order front-left, front-right, rear-left, rear-right, named by where
    they start. A masked value is 0.

    | key           | shape  | type    | feature           | unit       | range     |
    |---------------|--------|---------|-------------------|------------|-----------|
    | `ego`         | (1,)   | float32 | lane of the ego   | index      | 0 or 1    |
    | `visual`      | (4, 2) | float32 | distance ahead    | cells      | -12 to 12 |
    |               |        |         | lane offset       | lanes      | -1 to 1   |
    | `visual_mask` | (4,)   | int8    | the car is seen   |            | 0 or 1    |
    | `verbal`      | (4, 3) | float32 | distance ahead    | cells      | -12 to 12 |
    |               |        |         | lane offset       | lanes      | -1 to 1   |
    |               |        |         | relative speed    | cells/step | -1 to 1   |
    | `verbal_mask` | (4,)   | int8    | car communicated  |            | 0 or 1    |

    This environment has no messages, so the verbal part is always masked; it is included to keep
    the layout of the domain's observations.

    `info` holds the `scenario`'s name and, in `state`, the true `lane`, `position` (cells ahead,
    not saturated) and `speed` (cells/step); after a step also the `rewards`, terms by name.

    ## Rewards
    The sum of the domain's terms, of the action and the state that it leads to: `proximity` (-2 for
    each car of the ego's lane at most two cells away), `collision` (-5 for each car in the ego's
    cell), `off_road` (-5, never met with these actions) and `lane_change` (-1).

    ## Starting State
    A random lane, cars at random distances of 1 to 11 cells, and a random scenario unless one is
    given.

    ## Episode End
    Truncated after 15 steps; never terminated.

    ## Arguments
    `setting` ("clear" or "fog"), `scenario` (a name among `Driving.scenarios`, or None for a random
    one in each round) and `render_mode` ("rgb_array" or None):
    `gymnasium.make("mirror_ppl/Driving-v0", setting="fog")`.

    ## Version History
    * v0: first version.

    Raises:
        UnknownNameError: if the setting, the scenario or the render mode is not a known one.
    """

    domain = Driving()
    limits: ClassVar[dict[str, tuple[list[float], list[float]]]] = {
        "ego": ([0.0], [1.0]),
        "visual": ([-ROAD_END, -1.0], [ROAD_END, 1.0]),
        "verbal": ([-ROAD_END, -1.0, -1.0], [ROAD_END, 1.0, 1.0]),
    }
