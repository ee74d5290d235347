"""Groups of people of whom studies are tried."""

from example_recordings import shipped
from few_reaches import robot_of_few_reaches

from mirror_ppl.domains import get_domain
from mirror_ppl.evaluation.learners import RECORDED, Group

FOG = Group("driving", "fog", "paper", 2, 0)


class Shipped(Group):
    """People whose recordings ship."""

    def recordings(self, rounds=RECORDED):
        return shipped(self.domain, self.setting, self.people, rounds, self.population)


class FewReaches(Group):
    """Drivers, to whom the robot ascribes one of few thresholds of sight: quickly inferred."""

    @property
    def self_model(self):
        return robot_of_few_reaches()


def worst(domain):
    return get_domain(domain).settings[-1]
