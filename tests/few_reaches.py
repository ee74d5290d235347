"""Driving with three thresholds of sight instead of seven: posteriors take little to sum."""

from mirror_ppl.domains.driving import Driving
from mirror_ppl.models.weights import load_self_model, shipped_weights


class FewReaches(Driving):
    """A thirtieth of the combinations of implants."""

    reach_bins = (0.0, 2.0, 4.0)


def robot_of_few_reaches():
    """Return the robot's self-model of driving in this world."""
    robot = load_self_model(shipped_weights("driving"), "driving")[0]
    robot.domain = FewReaches()
    return robot
