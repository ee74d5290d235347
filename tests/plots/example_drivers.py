"""A posterior of two drivers, made up, and figures drawn."""

import arviz as az
import numpy as np

PEOPLE = ["anna", "ben"]
SITES = ("sight_front_own", "sight_front_other", "sight_back_own", "sight_back_other")
# Four draws of each reach, of anna; ben sees everything.
REACH = {
    "sight_front_own": [2, 2, 2, 4],
    "sight_front_other": [0, 1, 1, 12],
    "sight_back_own": [0, 0, 0, 0],
    "sight_back_other": [0, 1, 2, 3],
}
TRUTH = {
    "sight_front_own": 2.0,
    "sight_front_other": 1.0,
    "sight_back_own": 0.0,
    "sight_back_other": 3.0,
}
B, T = 3, 4
# Two rounds of anna, the second of two steps; three of ben. 1 switches lanes, -1 is padding.
ACTION = np.array(
    [
        [[0, 1, 1, 0], [1, 0, -1, -1], [-1, -1, -1, -1]],
        [[0, 0, 0, 0], [1, 1, 1, 1], [0, 1, 0, 0]],
    ]
)


def made_up(rng, people=PEOPLE, with_truth=True, with_test=True):
    """The groups that figures read: 4 draws of each person, 3 rounds of 4 steps."""
    P = len(people)

    def implants(number):
        drawn = {
            "assumes_clear": rng.integers(0, 2, (1, number, P)),
            "assumes_closing": rng.integers(0, 2, (1, number, P)),
            "consistency": rng.lognormal(1, 0.5, (1, number, P)),
            "lapse": rng.beta(1, 30, (1, number, P)),
            "residual_in": rng.normal(size=(1, number, P, 2, 3)),
        }
        for site in SITES:
            drawn[site] = rng.choice([0.0, 1, 2, 3, 4, 6, 12], (1, number, P))
        return drawn

    posterior = implants(4)
    posterior["assumes_closing"][0, :, 0] = [0, 1, 1, 1]
    for site in SITES:
        posterior[site][0, :, 0] = REACH[site]
        posterior[site][0, :, 1:] = 12
    action = np.concatenate([ACTION, np.repeat(ACTION[1:], P - 2, 0)]) if P > 1 else ACTION[:1]
    lane = np.concatenate([np.zeros((P, B, 1)), np.maximum(action, 0).cumsum(-1) % 2], -1)
    start = np.array([3, 11, -2, -12])
    visual = np.zeros((P, B, T + 1, 4, 2))
    visual[..., 0] = np.clip(start + np.arange(T + 1)[:, None] * [-1, 1, 1, 0], -12, 12)
    visual[..., 1] = np.array([0, 1, 0, 1]) - lane[..., None]
    after_end = np.concatenate([np.zeros((P, B, 1), bool), action < 0], -1)
    lane[after_end] = np.nan
    visual[after_end] = np.nan
    constants = {"observed_action": action, "ego": lane[..., None], "visual": visual}
    if with_truth:
        for site in SITES:
            constants["truth_" + site] = np.array([TRUTH[site], *[np.nan] * (P - 1)])
        constants["truth_assumes_closing"] = np.ones(P)
        constants["truth_consistency"] = np.full(P, 3.0)
    rounds = ["person", "round", "step"]
    dims = {name: ["person"] for name in [*posterior, *constants]}
    dims |= {
        "residual_in": ["person", "input", "unit"],
        "action": rounds,
        "observed_action": rounds,
        "ego": ["person", "round", "time", "ego_feature"],
        "visual": ["person", "round", "time", "visual_item", "visual_feature"],
        "action_probability": ["person", "test_round", "step", "action_name"],
    }
    groups = {}
    if with_test:
        probability = rng.beta(1, 5, (1, 4, P, B, T))
        probability = np.stack([1 - probability, probability], -1)
        groups["predictions"] = {"action_probability": probability}
        groups["predictions_constant_data"] = dict(constants)
    result = az.from_dict(
        posterior=posterior,
        prior=implants(50),
        posterior_predictive={"action": rng.integers(0, 2, (1, 4, P, B, T))},
        prior_predictive={"action": rng.integers(0, 2, (1, 50, P, B, T))},
        observed_data={"action": action},
        constant_data=constants,
        coords={
            "person": list(people),
            "action_name": ["stay", "switch"],
            "visual_feature": ["distance_ahead", "lane_offset"],
        },
        dims=dims,
        **groups,
    )
    result.posterior.attrs |= {"domain": "driving", "setting": "fog"}
    if with_test:
        result.rename({"round": "test_round"}, groups="predictions_constant_data", inplace=True)
    return result


def draw(figure):
    """Bytes of the figure as PNG; warnings while drawing are errors."""
    content = figure._repr_png_()
    assert content.startswith(b"\x89PNG")
    return content
