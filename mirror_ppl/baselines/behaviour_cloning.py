"""Behaviour cloning: a recurrent network from what could be seen to what a person does.

Implements the baseline BC of MIRROR (Chen, Fong and Soh, RSS 2022; supplement, section D)::

    h_t = GRU(h_{t-1}, [ego_t, v_t * x_t, v_t, m_t, a_{t-1}])     48 units
    a_t ~ Categorical(softmax(output(relu(layer(h_t)))))          one layer of 32

with a network of its own for each person, fitted to that person's rounds by maximum likelihood.
``x_t`` are the domain's symbols of all items of all modalities and ``v_t`` masks: which items the
setting lets an unaided person see, or were told; ``m_t`` is which of them were told.

Departures from the supplement:

- It feeds ``x_t, a_t`` to predict ``a_t``. The action at t cannot be an input to its own
  prediction, so the GRU reads ``a_{t-1}`` ("none yet" at first), as the supplement's other
  recurrent clone, that of CARLA, does.
- It does not say whether BC reads all items or only those in sight. ``sight`` has both. With
  "setting" the clone is *given* the sight that MIRROR has to infer wherever the setting alone
  limits people's sight; with "everything" it has as much to go by as MIRROR has.
- Masks are inputs, so that what is communicated can enter, and by itself which items were told:
  of what the setting shows anyway a message may still say that it counts.
- Weights on inputs begin at zero: a symbol that the recordings lack adds nothing. The output's bias
  begins at the frequencies of the person's actions.
- Weight decay, and early stopping on the person's validation rounds; `BehaviourCloneOptions` tells
  what was searched.
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
from mirror_ppl.people.base import derived_generator


@dataclass(frozen=True)
class BehaviourCloneOptions(TrainingOptions):
    """Settings of behaviour cloning.

    The defaults are good at 20 training rounds. They were searched, one or two settings at a time,
    by the validation NLL of ten people in fog, of seeds 100 to 103. For both populations and both
    sights: learning rates .02 to .04 (of .003 to .05 for one of them) and weight decays 1 to 10
    (.01 to 30). Weight decay matters most, .288 nats an action at 1 and .268 to .274 from 4 to 10;
    choosing one for each person by their validation rounds predicts held-out rounds no better.
    Beside it there was no gain from dropout (.3 and .4 after the GRU and the layer, .2 on the
    inputs) or from torch's usual initial input weights, and a loss of .02 to .04 from scaled
    numbers in place of symbols. In other domains, in both settings, `benchmarks.baselines` found:
    in search and rescue a tenth of the learning rate halves what is missed in clear air (1.203 to
    .555 nats of 20 rounds, .599 to .593 in smoke); in bomb defusal all values are alike.

    Attributes:
        layer: units of the layer after the GRU (supplement: 32).
        full_decay_rounds: a person with more training rounds gets less weight decay, in inverse
            proportion, as a prior does that stays the same. At 60 and 200 rounds (paper population)
            this was better on validation than the full decay.
    """

    BASELINE = "bc"

    learning_rate: float = 0.03
    weight_decay: float = 6.0
    check_every: int = 3
    layer: int = 32
    full_decay_rounds: int = 20

    COUNTS = (*TrainingOptions.COUNTS, "layer", "full_decay_rounds")


class BehaviourClone(RecurrentNetworks):
    """``p(a_t | x_{1:t}, v_{1:t}, a_{1:t-1})``: outputs are logits.

    Made by `fit_behaviour_clone`.
    """


def fit_behaviour_clone(
    train: Demonstrations,
    validation: Demonstrations,
    options: BehaviourCloneOptions,
    seed: int,
    report: Report = no_report,
) -> BehaviourClone:
    """Clone P people, each from their own rounds and by a network of their own.

    Args:
        train: rounds to learn from, of any lengths and numbers.
        validation: rounds of the same people in the same order, by which training is stopped.
        options: settings.
        seed: seed of everything random here; with a person's id and rounds it determines their
            network.
        report: called at each look at the validation rounds with the number of gradient steps
            done, in the end ``options.epochs`` even if training stopped early, and a message.

    Returns:
        The clone, on the device of the training rounds.

    Raises:
        DemonstrationsError: somebody has no round to learn from or none to validate with; or the
            validation rounds are of another domain or other people.
    """
    check_parts(train, validation)
    # By name and not by place: a person's network is the same whoever else is fitted.
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
    weights = initial_weights(domain, options.hidden, (options.layer,), generators)
    chosen = torch.stack([(train.actions == action).sum((1, 2)) for action in range(actions)], -1)
    # One more of each, lest an action that was never taken counts as impossible.
    weights["output_bias"] = ((chosen + 1) / (chosen + 1).sum(-1, True)).log()[:, None].cpu()
    return weights
