"""Highway driving as a Gymnasium environment on highway-env, one round at a time."""

from __future__ import annotations

import numpy as np
import torch

from mirror_ppl.domains.base import map_state
from mirror_ppl.domains.highway import vehicles
from mirror_ppl.domains.highway.road import TICKS
from mirror_ppl.domains.highway.rounds import RoundEnv
from mirror_ppl.domains.highway.state import HighwayState


class HighwayEnv(RoundEnv):
    """Three lanes, traffic with one manoeuvre that calls for a response, and lidar.

    ## Description
    A round of `mirror_ppl.domains.highway.DirectHighway`, seen by an unaided person in one of its
    settings. Vehicles are highway-env's and move by its physics; observations and rewards are the
    domain's. The domain's own batched physics agrees with it, which tests compare.

    ## Action Space
    `Box(-1, 1, (2,))`, for 0.2 s.

    | number | action       | at 1                               | at -1                |
    |--------|--------------|------------------------------------|----------------------|
    | 0      | steering     | 0.2 rad at the wheels to the right | 0.2 rad to the left  |
    | 1      | acceleration | 5 m/s2                             | braking with 5 m/s2  |

    ## Observation Space
    A `Dict`. A masked value is 0.

    | key           | shape   | type    | feature                    | unit  | range      |
    |---------------|---------|---------|----------------------------|-------|------------|
    | `ego`         | (7,)    | float32 | lane                       | index | 0 to 2     |
    |               |         |         | lane offset, to the right  | m     | -15 to 15  |
    |               |         |         | heading, clockwise         | rad   | -pi to pi  |
    |               |         |         | speed                      | m/s   | -1 to 20   |
    |               |         |         | last steering              | share | -1 to 1    |
    |               |         |         | last acceleration          | share | -1 to 1    |
    |               |         |         | accident                   |       | 0 or 1     |
    | `visual`      | (36, 3) | float32 | distance                   | m     | 0 to 60    |
    |               |         |         | relative velocity along    | m/s   | -60 to 60  |
    |               |         |         | relative velocity across   | m/s   | -60 to 60  |
    | `visual_mask` | (36,)   | int8    | the sector is seen         |       | 0 or 1     |
    | `verbal`      | (6, 1)  | float32 | sentence about a direction | index | 0 to 5     |
    | `verbal_mask` | (6,)    | int8    | it was said                |       | 0 or 1     |

    Sector *k* of `visual` looks 10 *k* degrees clockwise from the heading. This environment has no
    messages, so the verbal part is always masked; it is included to keep the layout of the domain's
    observations.

    `info` holds the `scenario`'s name and, in `state`, the fields of the true
    `mirror_ppl.domains.highway.HighwayState`; after a step also the `rewards`, terms by name.

    ## Rewards
    The sum of the terms of `mirror_ppl.domains.highway.reward`, for each action of 0.2 s. A
    manoeuvre has the same terms for 0.5 s, so that here an accident (-100) weighs 2.5 times less
    relative to what is earned per second.

    ## Starting State
    The domain's `initial`: a random scenario unless one is given.

    ## Episode End
    Terminated by a collision of the ego, and when its centre leaves the shoulder. Truncated after
    120 steps (24 s).

    ## Arguments
    `setting` ("clear" or "fog"), `scenario` (a name among `Highway.scenarios`, or None for a random
    one in each round) and `render_mode` ("rgb_array" or None):
    `gymnasium.make("mirror_ppl/Highway-v0", setting="fog")`.

    ## Version History
    * v0: first version.

    Raises:
        UnknownNameError: if the setting, the scenario or the render mode is not a known one.
    """

    def begin(self, scenario: int, seed: int) -> None:
        """Place vehicles as the domain does with this seed."""
        generator = torch.Generator().manual_seed(seed)
        batch = self.domain.initial(1, generator, torch.tensor([scenario]))
        self._road = vehicles.make_road(map_state(lambda part: part[0], batch))
        self._controls, self._tick = np.zeros(2), 0

    def advance(self, action: np.ndarray) -> None:
        """Let highway-env play four ticks, or fewer until a collision."""
        self._controls = action.astype(np.float64)
        ego = vehicles.ego_of(self._road)
        ego.drive(self._controls)
        for _ in range(TICKS):
            if not ego.hit_others:
                vehicles.tick(self._road, self._tick)
                self._tick += 1

    def simulated(self) -> HighwayState:
        """Return the state of highway-env's vehicles."""
        return vehicles.read_road(self._road, self._tick, self._controls)
