"""Searches in bomb defusal: played, proposed from actions, and inferred."""

import pytest
import torch
from example_bomb import RESIDUAL, WAIT, WORLD, course, implants

from mirror_ppl.communication import Person, RoundSoFar
from mirror_ppl.domains.bomb_defusal.human import BombDefusalHuman
from mirror_ppl.domains.bomb_defusal.panel import read_panel
from mirror_ppl.inference.adaptive_importance import ImportanceOptions, sample_importance
from mirror_ppl.likelihood.attention import Proposal
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.networks import Gaussian
from mirror_ppl.models.self_model import SelfModel
from mirror_ppl.models.simulation import play_rounds
from mirror_ppl.people import simulate


@pytest.fixture(scope="module")
def defuser():
    torch.manual_seed(0)
    return BombDefusalHuman(SelfModel(WORLD))


def test_who_is_asked_to_play_searches_for_what_each_stage_shows():
    """Terminal 1 is found at once, all others never: a stage ends if it shows terminal 1."""
    torch.manual_seed(0)
    human = BombDefusalHuman(Knowing(WORLD))
    quick = {f"notices_terminal {k}": torch.tensor([[1e-6]]) for k in range(2, 7)}
    quick |= {"notices_terminal 1": torch.tensor([[1 - 1e-6]])}
    quick |= {"consistency": torch.tensor([[20.0]]), "lapse": torch.tensor([[1e-6]])}
    quick |= {name: torch.zeros(1, 1, *shape) for name, shape in RESIDUAL.items()}
    played = play_rounds(human, quick, 200, "labelled", torch.Generator().manual_seed(0))
    live, _ = read_panel(played.observations["visual"][0])
    stage = played.ego[0, ..., 0]
    for first, after, where in zip(stage[:, 0], stage[:, 20], live[:, :20], strict=True):
        assert int(first) == 0
        assert int(after) == sum(bool((where[: number + 1] == 0).all()) for number in range(3))
    assert (stage[:, 20] > 0).float().mean() == pytest.approx(
        1 / 6, abs=4.5 * (5 / 36 / 200) ** 0.5
    )


def test_actions_identify_when_it_was_found(defuser):
    observation, _ = course([WAIT] * 4 + [2] + [WAIT] * 3)
    own = {name: value[0] for name, value in observation.items()}
    actions = torch.tensor([WAIT] * 4 + [2] + [WAIT] * 3)
    found = defuser.log_proposal(own, actions)
    # Pressed at the fifth step: found just then, rather than before or after.
    assert int(found["found_0"].argmax()) == 4
    assert set(found) == {"found_0", "found_1"}
    later = found["found_1"]
    assert later[3:].tolist() == [0.0] * 58 and (later[:2] < 0).all()
    proposal = Proposal(defuser, *(2 * [{n: v[None] for n, v in implants(defuser).items()}]), 64)
    covariates = {name: value.view(1, 1) for name, value in defuser.covariates(observation).items()}
    chosen = proposal.values(None, 0, covariates, found)
    weights = torch.bincount(chosen.values["found_0"], minlength=61)
    assert int(weights.argmax()) == 4
    assert chosen.covariates.keys() == covariates.keys()


def test_who_is_in_a_round_has_not_found_what_they_wait_for(defuser):
    """A consistent person who waited four steps: most draws have not found it yet."""
    some = implants(defuser, **{"notices_terminal 1": 0.2}, consistency=20.0, lapse=0.01)
    draws = {name: value.expand(40, *value.shape).clone() for name, value in some.items()}
    observation, _ = course([WAIT] * 4)
    rounds = RoundSoFar.begin(WORLD, {name: value[0, 0] for name, value in observation.items()})
    quiet = {"visual": torch.zeros(6, dtype=torch.bool), "verbal": torch.zeros(1).bool()}
    for step in range(1, 5):
        now = {name: value[0, step] for name, value in observation.items()}
        rounds = rounds.then(quiet, WAIT, now)
    person = Person(defuser, draws).in_round(rounds)
    found = person.percepts["found_0"][person.percept]
    assert len(found) == 40 and found.unique().numel() > 1


def test_a_person_s_probabilities_come_out_of_their_rounds():
    """With a self-model that presses when it knows and waits until then, by hand."""
    torch.manual_seed(0)
    human = BombDefusalHuman(Knowing(WORLD))
    recorded = simulate("bomb_defusal", "labelled", people=1, rounds=12, seed=0)
    human.fit_world(recorded)
    builder = ViewTableBuilder(human, Screening())
    builder.add(rounds_of(recorded, 0))
    found = sample_importance(human, builder.table(), ImportanceOptions(256, 50.0))
    draws = found.sample(200, builder.grid)
    mean = torch.stack([draws[f"notices_terminal {k}"].mean() for k in range(1, 7)]).mean()
    # About 30 finds, and a prior worth one: a standard error of a fifth.
    truth = recorded.truth["notices_terminal 1"][0]
    assert abs((mean / truth).log()) < 4.5 / 30**0.5
    assert draws["reads_type"].float().mean() > 0.99


class Knowing(SelfModel):
    """A self-model that believes what there is to see, and values it by the old rules."""

    class Reader(torch.nn.Module):
        """Beliefs are values: those of a press are known of a lit terminal of a known type."""

        def __init__(self, action):
            super().__init__()
            self.action = action

        def embed(self, symbols):
            """Values of a bomb of either type ``[..., 1, 10]``, for every terminal."""
            ego = torch.nn.functional.pad(symbols["ego"].argmax(-1, keepdim=True).float(), [0, 1])
            values = []
            for kind in (0.0, 1.0):
                seen = {"ego": ego, "visual": symbols["visual"]}
                seen["verbal"] = torch.full((*ego.shape[:-1], 1, 1), kind)
                state = WORLD.state_behind(seen)
                values.append(WORLD.as_believed.reference_values(state, 0.9))
            lit = WORLD.sought({"ego": ego, **symbols})
            return {"ego": torch.cat(values, -1), "visual": lit, "verbal": symbols["verbal"]}

        def evidence(self, symbols, visible):
            return self.combine(self.embed(symbols), visible)

        def combine(self, embedded, visible):
            kind = embedded["verbal"][..., 0, 1:]
            known = visible["verbal"].float()
            first, second = embedded["ego"].split(5, -1)
            values = (1 - kind) * first + kind * second
            found = (visible["visual"] & embedded["visual"]).any(-1, keepdim=True) & (known > 0)
            wait = torch.tensor([0.0, -5.0, -5.0, -5.0, -5.0])
            values = torch.where(found, values, wait)
            kind = kind.expand(*values.shape[:-1], 1)
            return torch.nn.functional.pad(torch.cat([values, kind], -1), [0, 128 - 6])

        def previous_actions(self, actions):
            return torch.zeros(*actions.shape[:-1], actions.shape[-1] + 1, 128)

        def forward(self, previous, evidence):
            mean = evidence[..., :48]
            return Gaussian(mean, torch.ones_like(mean))

    def __init__(self, domain):
        super().__init__(domain)
        with torch.no_grad():
            self.encoder.action.weight.zero_()
        self.encoder = self.Reader(self.encoder.action)
        self.decoders["verbal"] = Kind()

    def action_values(self, belief):
        return belief[..., :5]


class Kind(torch.nn.Module):
    """Reads the type off a belief of `Knowing`."""

    def forward(self, belief):
        return type("Decoded", (), {"mean": belief[..., 5, None, None]})
