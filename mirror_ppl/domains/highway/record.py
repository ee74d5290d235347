"""The record of highway driving: settings of networks, training and planning."""

from mirror_ppl.domains.record import Record

BASELINE_SIZES = {"hidden": 128, "layers": (128, 128, 128)}
"""Networks of baselines, as in the supplement."""
RECORD = Record(
    networks={
        "latent": 128,
        "encoder": 128,
        "transition": 128,
        "decoder": 128,
        "reward": 128,
        "q_network": 128,
        "value_bins": 77,
        "least_value": -140.0,
        "most_value": 12.0,
    },
    training={
        "phases": 12,
        "rounds": 640,
        "steps": 2500,
        "batch": 48,
        "beta": 0.5,
        "beta_decay": 0.5,
        "epsilon": 0.4,
        "epsilon_decay": 0.8,
        "epsilon_floor": 0.1,
        "discount": 1.0,
        "world_weight": 2.0,
        "window": 24,
        "stride": 4,
        "bin_weight": 100.0,
        "ranked_weight": 2.0,
        "choice_weight": 200.0,
        "distil": True,
        "kinds": (0.5, 0.1, 0.4),
        "assumed": 0.5,
    },
    consistency=1.0,
    likelihood_power=0.25,
    sight_scale=1.0,
    measured=100,
    people="mirror_ppl.domains.highway.participants:DRIVERS",
    human_models="mirror_ppl.domains.highway.human_variants:HUMAN_MODELS",
    pictures="mirror_ppl.domains.highway.sight:PICTURES",
    planning={"predict_with": "values", "items": 2},
    baselines={
        "bc": {**BASELINE_SIZES, "learning_rate": 0.01, "weight_decay": 1.0},
        "sqil": {
            **BASELINE_SIZES,
            "learning_rate": 0.003,
            "discount": 0.0,
            "weight_decay": 1.0,
        },
    },
)
