"""The Pyro programs: the robot's self-model, and the model of people that is made of it."""

from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.self_model import Rounds, SelfModel
from mirror_ppl.models.view import View

__all__ = ["HumanModel", "Implants", "Rounds", "SelfModel", "View"]
