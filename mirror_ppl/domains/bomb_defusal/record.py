"""The record of bomb defusal: settings, people and human models."""

from mirror_ppl.domains.record import SQIL_IN_LONG_ROUNDS, Record

RECORD = Record(
    networks={"encoder": 128, "decoder": 64, "q_network": 200, "image": 64, "stride": 2},
    paper_networks={"q_network": 2048},
    training={
        "phases": 200,
        "rounds": 400,
        "steps": 30,
        "batch": 192,
        "learning_rate": 2e-3,
        "beta": 1.0,
        "beta_decay": 0.98,
        "epsilon_decay": 0.9,
        "discount": 0.95,
        "target_rate": 0.02,
        "world_weight": 0.01,
        "speech_weight": 30.0,
        "length": 10,
        "stride": 2,
        "difference_weight": 4.0,
        "exact": True,
    },
    # A third item costs more than it can gain; the oracle considers two as well. The bomb does not
    # change by itself, so delaying a message never helps.
    # People search about 20 steps for a terminal. No value is added at the horizon: the best return
    # from there on would count as if what they have not done yet could not go wrong any more.
    # A wrong button costs much more than a message, so a gain need not be significant.
    planning={
        "horizon": 24,
        "enumerate_above": 0.4,
        "items": 2,
        "patience": 1,
        "min_standard_errors": 0.0,
    },
    baselines={
        # People wait at most steps of long rounds.
        "sqil": {
            **SQIL_IN_LONG_ROUNDS,
            "learning_rate": 0.05,
            "weight_decay": 1.0,
            "reward": 10.0,
        },
    },
    slow=("mirror-svi", "sqil-everything", "sqil-pooled"),
    people="mirror_ppl.domains.bomb_defusal.participants:DEFUSERS",
    human_models="mirror_ppl.domains.bomb_defusal.human_variants:HUMAN_MODELS",
)
