"""What to tell a person, when, through which channel, and why.

Three layers: the person (`minds`, posterior draws of a human model carried through a round), value
(`objectives`, what candidate messages are worth) and search (`search`, which candidates there are).
`Communicator` puts them together.
"""

from mirror_ppl.communication.communicator import Communicator, Decision, Gain
from mirror_ppl.communication.messages import Channels, Message, every_message
from mirror_ppl.communication.minds import Person, Standing
from mirror_ppl.communication.objectives import Divergence, ExpectedUtility, Objective, Valued
from mirror_ppl.communication.rounds import RoundSoFar
from mirror_ppl.communication.search import Automatic, CrossEntropy, Exhaustive, Patient, Search
from mirror_ppl.communication.worlds import Futures, SelfModelWorld, SimulatorWorld, World

__all__ = [
    "Automatic",
    "Channels",
    "Communicator",
    "CrossEntropy",
    "Decision",
    "Divergence",
    "Exhaustive",
    "ExpectedUtility",
    "Futures",
    "Gain",
    "Message",
    "Objective",
    "Patient",
    "Person",
    "RoundSoFar",
    "Search",
    "SelfModelWorld",
    "SimulatorWorld",
    "Standing",
    "Valued",
    "World",
    "every_message",
]
