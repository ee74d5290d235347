"""The Pyro programs: the robot's self-model, and the human model built on it."""

from mirror_ppl.models.human import HumanModel, Implants
from mirror_ppl.models.self_model import Rounds, SelfModel
from mirror_ppl.models.spans import Span
from mirror_ppl.models.view import View

__all__ = ["HumanModel", "Implants", "Rounds", "SelfModel", "Span", "View"]
