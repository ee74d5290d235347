"""Plans what to communicate to a person, when, through which channel, and explains why.

Three layers: the person (`person`, posterior draws of a human model tracked through a round), value
(`objectives`, utilities of candidate messages) and search (`search`, which candidates to value).
`Communicator` combines them.
"""

from mirror_ppl.communication.communicator import Communicator
from mirror_ppl.communication.companion import Companion
from mirror_ppl.communication.decision import Decision, Gain
from mirror_ppl.communication.messages import Channels, Message, every_message
from mirror_ppl.communication.objectives import Divergence, ExpectedUtility, Objective, Valued
from mirror_ppl.communication.person import Person, PlanningContext
from mirror_ppl.communication.rollouts import RolloutTree, SelfModelWorld, SimulatorWorld, World
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.communication.search import Automatic, CrossEntropy, Exhaustive, Patient, Search

__all__ = [
    "Automatic",
    "Channels",
    "Communicator",
    "Companion",
    "CrossEntropy",
    "Decision",
    "Divergence",
    "Exhaustive",
    "ExpectedUtility",
    "RolloutTree",
    "Gain",
    "Message",
    "Objective",
    "Patient",
    "Person",
    "RoundSoFar",
    "Search",
    "SelfModelWorld",
    "SimulatorWorld",
    "PlanningContext",
    "Valued",
    "World",
    "every_message",
]
