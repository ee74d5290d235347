"""Groups of people of whom studies are tried."""

from mirror_ppl.domains import get_domain
from mirror_ppl.evaluation.learners import Group

FOG = Group("driving", "fog", "paper", 2, 0)


def worst(domain):
    return get_domain(domain).settings[-1]
