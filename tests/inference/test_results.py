"""Results of fits: which rounds are learned from, and what is said of people."""

import math

import pytest
import torch
from example_recordings import fields

from mirror_ppl.data import Demonstrations
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import DemonstrationsError
from mirror_ppl.inference.results.export import in_units
from mirror_ppl.inference.results.fitting import split_rounds
from mirror_ppl.inference.results.summary import score, summarize


def numbered(rounds, more=0):
    """One person's rounds, whose lane is their number, in arrays with room for more."""
    variables = fields([[1] * (rounds + more)])
    count = torch.tensor([rounds])
    lengths = (torch.arange(rounds + more) < rounds).long()[None]
    lane = torch.arange(float(rounds + more))[None, :, None, None].expand(1, -1, 2, 1)
    return Demonstrations(**variables | {"ego": lane, "round_counts": count, "lengths": lengths})


@pytest.mark.parametrize(
    ("rounds", "train_rounds", "train", "test"),
    [
        (40, None, range(20), range(30, 36)),
        (36, None, range(20), range(30, 36)),
        (40, 1, range(1), range(30, 36)),
        (40, 30, range(30), range(30, 36)),
        (40, 31, range(31), range(31, 40)),
        (40, 40, range(40), None),
        (35, None, range(27), range(27, 35)),
        (4, None, range(3), range(3, 4)),
        (2, None, range(2), None),
        (1, None, range(1), None),
        (10, 4, range(4), range(4, 10)),
    ],
)
@pytest.mark.parametrize("more", [0, 9], ids=["", "padded"])
def test_split_of_rounds(rounds, train_rounds, train, test, more):
    parts = split_rounds(numbered(rounds, more), train_rounds)
    numbers = [None if part is None else part.ego[0, :, 0, 0].tolist() for part in parts]
    assert numbers == [list(train), None if test is None else list(test)]


@pytest.mark.parametrize("train_rounds", [-1, 5])
def test_rounds_that_are_not_there_cannot_be_learned_from(train_rounds):
    with pytest.raises(DemonstrationsError, match=f"cannot train on {train_rounds} of 4 rounds"):
        split_rounds(numbered(4), train_rounds)


def test_summary_by_hand():
    train = Demonstrations(
        **fields([[2], [1]])
        | {"truth": {"bias": torch.tensor([0.25, math.nan]), "reach": torch.ones(2)}}
    )
    action, entropy = torch.tensor([[[1, 0]], [[0, 0]]]), torch.tensor([[[0.5, 0.1]], [[0.0, 0.0]]])
    given = fields([[2], []]) | {"actions": action, "action_entropy": entropy}
    test = Demonstrations(**given)
    draws = {
        "bias": torch.arange(20.0).repeat(2, 1).T * torch.tensor([1.0, -1.0]),
        "weights": torch.zeros(20, 2, 3),
    }
    # Two draws: of the actions 1 and 0, probabilities 0.9 and 0.2, or 0.5 and 0.6.
    exact = torch.tensor([[[0.1, 0.9], [0.2, 0.8]], [[0.5, 0.5], [0.6, 0.4]]])
    log_probabilities = exact.log()[:, None, None].expand(2, 2, 1, 2, 2)
    first, second = summarize(draws, train, score(log_probabilities, test))
    assert first["id"] == "a"
    assert (first["rounds"], second["rounds"]) == (1, 1)
    assert first["implants"] == {"bias": {"median": 9.0, "q05": 0.0, "q95": 18.0, "truth": 0.25}}
    assert second["implants"] == {
        "bias": {"median": -10.0, "q05": -19.0, "q95": -1.0, "truth": None}
    }
    # Mixed over draws: 0.7 and 0.4, so the second action is not the likeliest.
    assert first["test"]["nll"] == pytest.approx(-(math.log(0.7) + math.log(0.4)) / 2, rel=1e-5)
    assert first["test"]["accuracy"] == 0.5
    assert first["test"]["floor"] == pytest.approx(0.3)
    assert second["test"] is None
    assert summarize(draws, train, None)[0]["test"] is None
    unknown = Demonstrations(**given | {"action_entropy": None})
    assert score(log_probabilities, unknown)[0]["floor"] is None


def test_bins_are_reported_in_cells():
    draws = {"sight_front_own": torch.tensor([[[0]], [[5]], [[6]]]), "lapse": torch.ones(3, 1, 1)}
    units = in_units(get_domain("driving"), draws)
    assert units["sight_front_own"].tolist() == [[0.0], [6.0], [12.0]]
    assert units["lapse"].shape == (3, 1)
