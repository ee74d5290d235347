"""What the package knows of bomb defusal besides its rules."""

from mirror_ppl.domains.record import Record

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
    # Costs grow so fast that no third item is worth its own; the oracle looks at two, too. A bomb
    # does nothing by itself, so what helps cannot wait; and where the next stage takes as long,
    # steps that are looked at are used up all the same, whenever this one ends.
    # A wrong button costs much more than a message: it is rash to be silent until a gain is sure.
    planning={
        "horizon": 12,
        "terminal_value": True,
        "enumerate_above": 0.4,
        "items": 2,
        "patience": 1,
        "min_standard_errors": 0.0,
    },
    baselines={
        # People also do one thing, waiting, at most steps of long rounds.
        "sqil": {
            "batch": 5,
            "sampled": 5,
            "kept": 50,
            "epochs": 1500,
            "check_every": 10,
            "patience": 60,
            "learning_rate": 0.05,
            "weight_decay": 1.0,
            "reward": 10.0,
        },
    },
    slow=("mirror-svi", "sqil-everything", "sqil-pooled"),
    people="mirror_ppl.domains.bomb_defusal.participants:DEFUSERS",
    human_models="mirror_ppl.domains.bomb_defusal.human_variants:HUMAN_MODELS",
)
