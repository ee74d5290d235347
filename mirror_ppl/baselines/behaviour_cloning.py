"""Behaviour cloning: a recurrent network that predicts a person's actions from observations.

Implements the baseline BC of MIRROR (Chen, Fong and Soh, RSS 2022; supplement, section D)::

    h_t = GRU(h_{t-1}, [ego_t, v_t * x_t, v_t, m_t, a_{t-1}])     48 units
    a_t ~ Categorical(softmax(output(relu(layer(h_t)))))          one layer of 32

On the highway the GRU has 128 units and is followed by three layers of 128.

Each person has a separate network, fitted to that person's rounds by maximum likelihood. ``x_t``
are the domain's symbols of all items of all modalities. The mask ``v_t`` marks items that the
setting shows to an unaided person or that were communicated; ``m_t`` marks the latter alone.

Departures from the supplement:

- The supplement feeds ``x_t, a_t`` to predict ``a_t``. The action at t cannot be an input to its
  own prediction, so the GRU reads ``a_{t-1}`` ("none yet" at first), as the supplement's other
  recurrent clone, that of CARLA, does.
- The supplement does not say if BC reads all items or only visible ones; ``sight`` selects. With
  "setting" the clone is *given* the sight that MIRROR has to infer, wherever the setting alone
  limits people's sight; with "everything" it reads the same observations as MIRROR.
- Masks are inputs, so that messages can enter. ``m_t`` is separate, as a message may make an item
  relevant that the setting shows anyway.
- Input weights are initialized at zero: a symbol that the recordings lack adds nothing. The
  output's bias is initialized at the log-frequencies of the person's actions.
- Training has weight decay, and early stopping on the person's validation rounds;
  `BehaviourCloneOptions` describes the search of settings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mirror_ppl.baselines.inputs import StepInputs
from mirror_ppl.baselines.recurrent import RecurrentNetworks, initial_weights
from mirror_ppl.baselines.training import (
    Report,
    TrainingOptions,
    check_parts,
    mean_nll,
    no_report,
    train_each,
)
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.randomness import derived_generator


@dataclass(frozen=True)
class BehaviourCloneOptions(TrainingOptions):
    """Settings of behaviour cloning.

    The defaults are for 20 training rounds. They were searched one or two settings at a time, by
    the validation NLL of ten people in fog, seeds 100 to 103. For both populations and both sights:
    learning rates .02 to .04 and weight decays 1 to 10; for one combination .003 to .05, .01 to 30.

    Weight decay matters most: .288 nats an action at 1, .268 to .274 from 4 to 10. A weight decay
    chosen for each person on their validation rounds predicts held-out rounds no better. Dropout
    (.3 and .4 after the GRU and the layer, .2 on the inputs) and torch's default input weights gain
    nothing; scaled numbers in place of symbols lose .02 to .04.

    In other domains (`benchmarks.baselines`, both settings, 20 rounds): in search and rescue a
    tenth of the learning rate lowers the NLL from 1.203 to .555 nats in clear air and from .599 to
    .593 in smoke; in bomb defusal all values are equivalent; on the highway, with larger networks,
    a third of the rate and a sixth of the decay lower it from 1.032 to .869 nats in fog.

    Attributes:
        full_decay_rounds: above this number of training rounds, weight decay falls in inverse
            proportion, as the weight of a fixed prior does. At 60 and 200 rounds (paper population)
            this was better on validation than the full decay.
    """

    BASELINE = "bc"

    learning_rate: float = 0.03
    weight_decay: float = 6.0
    check_every: int = 3
    full_decay_rounds: int = 20

    COUNTS = (*TrainingOptions.COUNTS, "full_decay_rounds")


class BehaviourClone(RecurrentNetworks):
    """Networks of ``p(a_t | x_{1:t}, v_{1:t}, a_{1:t-1})``: outputs are logits.

    Made by `fit_behaviour_clone`.
    """


def fit_behaviour_clone(
    train: Demonstrations,
    validation: Demonstrations,
    options: BehaviourCloneOptions,
    seed: int,
    report: Report = no_report,
) -> BehaviourClone:
    """Fit a separate network to each of P people.

    Args:
        train: rounds to learn from, of any lengths and numbers.
        validation: rounds of the same people in the same order, for early stopping.
        options: settings.
        seed: seed of everything random here; with a person's id and rounds it determines their
            network.
        report: called at each validation with the number of gradient steps done (in the end
            ``options.epochs``, even after early stopping) and a message.

    Returns:
        The clone, on the device of the training rounds.

    Raises:
        DemonstrationsError: a person has no training or no validation round; or the validation
            rounds are of another domain or other people.
    """
    check_parts(train, validation)
    # By id, not by position: a person's network does not depend on the other people.
    generators = [derived_generator(seed, "behaviour clone", name) for name in train.people]
    weights = _initial_weights(train, options, generators)
    clone = BehaviourClone(get_domain(train.domain), train.people, options.sight, weights)
    clone.to(train.actions.device)
    decay = options.weight_decay / (train.round_counts / options.full_decay_rounds).clamp(min=1)

    def loss(step: int, inputs: StepInputs, actions: Tensor) -> Tensor:
        del step
        return mean_nll(clone(inputs).log_softmax(-1), actions)

    train_each(clone, (train, validation), loss, options, generators, report, decay)
    return clone.requires_grad_(False)


def _initial_weights(
    train: Demonstrations, options: BehaviourCloneOptions, generators: Sequence[torch.Generator]
) -> dict[str, Tensor]:
    """Weights ``[P, inputs, outputs]`` and biases ``[P, 1, outputs]`` of each layer by name."""
    domain = get_domain(train.domain)
    actions = len(domain.actions)
    weights = initial_weights(domain, options.hidden, options.layers, generators)
    chosen = torch.stack([(train.actions == action).sum((1, 2)) for action in range(actions)], -1)
    # One is added to each count, so that an action that was never taken is not impossible.
    weights["output_bias"] = ((chosen + 1) / (chosen + 1).sum(-1, True)).log()[:, None].cpu()
    return weights
