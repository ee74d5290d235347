"""The record of search and rescue: settings, people and pictures."""

from mirror_ppl.domains.record import SQIL_IN_LONG_ROUNDS, Record

RECORD = Record(
    networks={"encoder": 128, "decoder": 64, "q_network": 200},
    training={
        "phases": 400,
        "rounds": 400,
        "steps": 40,
        "learning_rate": 2e-3,
        "beta": 1.0,
        "beta_decay": 0.98,
        "epsilon_decay": 0.9,
        "discount": 0.95,
        "target_rate": 0.02,
        "world_weight": 0.01,
        "length": 16,
        "stride": 2,
        "difference_weight": 4.0,
        "exact": True,
    },
    planning={
        "horizon": 16,
        "terminal_value": True,
        "enumerate_above": 0.4,
        "items": 2,
        "min_standard_errors": 1.0,
    },
    baselines={
        "bc": {"learning_rate": 0.003, "weight_decay": 3.0},
        # Rounds are long, so networks need many steps to imitate people.
        "sqil": {
            **SQIL_IN_LONG_ROUNDS,
            "learning_rate": 0.01,
            "weight_decay": 0.1,
        },
    },
    consistency=13.0,
    value_error=0.15,
    slow=("sqil-everything", "sqil-pooled"),
    people="mirror_ppl.domains.search_rescue.participants:FIREFIGHTERS",
    pictures="mirror_ppl.domains.search_rescue.pictures:PICTURES",
)
