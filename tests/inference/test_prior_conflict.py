"""Priors at odds with people: found from draws, reported by a fit."""

from dataclasses import replace

import pyro
import pyro.distributions as dist
import pytest
import torch

import mirror_ppl
from mirror_ppl.errors import PriorConflict
from mirror_ppl.inference.engines import run_identity
from mirror_ppl.inference.results.prior_conflict import DRAWS, conflict_line, prior_conflicts
from mirror_ppl.models import HumanModel
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.prior import draw_prior
from mirror_ppl.models.weights import load_self_model, shipped_weights


class Uniform(HumanModel):
    """The ends of 99% of `strength` are anywhere from 0 to 1 and from 99 to 100."""

    def prior(self):
        """Two sites of a person."""
        strength = pyro.sample("strength", dist.Uniform(torch.tensor(0.0), 100.0))
        careless = pyro.sample("careless", dist.Beta(torch.tensor(1.0), 30.0))
        return {"strength": strength, "careless": careless}


class Measured(Uniform):
    """The prior has a factor besides its sites."""

    def prior(self):
        """With a factor."""
        known = super().prior()
        pyro.factor("asked", -known["strength"])
        return known


@pytest.fixture
def self_model():
    return load_self_model(shipped_weights("driving"), "driving")[0]


def conflicts(human, medians, rounds=None, site="strength"):
    """Conflicts with three draws for each person, ``[3, P, 1]``, around their medians."""
    middle = torch.tensor(medians)[None, :, None]
    draws = {name: torch.full_like(middle, 0.01) for name in ("strength", "careless")}
    draws["strength"] += 50
    draws[site] = torch.cat([middle - 1000, middle, middle + 1000])
    counts = torch.ones(len(medians), dtype=torch.int64) if rounds is None else torch.tensor(rounds)
    return prior_conflicts(human, draws, counts, 0)


@pytest.mark.parametrize(
    ("medians", "people"),
    [
        ((101.0, 101.0, 50.0), 2),
        ((101.0, 101.0, 50.0, 50.0), 0),
        ((-1.0, -1.0, 50.0), 2),
        ((98.0, 2.0), 0),
        ((101.0, 50.0, 50.0), 0),
        ((-1.0, 101.0, 50.0), 0),  # one on either side
        ((101.0,), 0),  # who may be unusual
    ],
)
def test_most_of_the_people_on_one_side_are_a_conflict(self_model, medians, people):
    found = conflicts(Uniform(self_model), medians)
    assert [each["people"] for each in found.values()] == [people] * (people > 0)


def test_a_conflict_has_people_their_median_and_the_interval(self_model):
    human = Uniform(self_model)
    (conflict,) = conflicts(human, (120.0, 130.0, 140.0, 50.0)).values()
    low, high = conflict.pop("prior")
    assert conflict == {"people": 3, "of": 4, "median": 130.0}
    values = draw_prior(human, 1, DRAWS, 0)["strength"].flatten().sort().values
    inside = (values >= low) & (values <= high)
    assert int(inside.sum()) - 1 == 0.99 * DRAWS  # between its ends, which are draws themselves
    width = int(inside.sum()) - 1
    assert high - low == pytest.approx(float((values[width:] - values[:-width]).min()))
    conflict["prior"] = [0.5, 99.5]
    assert conflict_line("strength", conflict) == (
        "The prior of strength is at odds with 3 of 4 people: 99% of it is from 0.5 to 99.5, and "
        "their posterior medians are about 130. Posteriors are pulled towards it, most of all "
        'after few rounds: fit with another prior (docs/trust.md, "Prior and data")'
    )


def test_people_without_rounds_do_not_count(self_model):
    human, medians = Uniform(self_model), (101.0, 101.0, 50.0, 50.0)
    assert conflicts(human, medians, [3, 1, 0, 0])["strength"]["of"] == 2
    assert conflicts(human, medians, [0, 1, 1, 1]) == conflicts(human, medians, [0] * 4) == {}


def test_a_value_where_the_prior_is_densest_is_none(self_model):
    """People who never lapse are no evidence against a prior that is highest at 0."""
    human = Uniform(self_model)
    assert conflicts(human, (1e-9, 1e-9), site="careless") == {}
    assert list(conflicts(human, (0.5, 0.5), site="careless")) == ["careless"]


def test_priors_with_factors_are_not_compared(self_model):
    assert conflicts(Measured(self_model), (101.0, 101.0)) == {}


def test_a_fit_warns_unless_people_are_pooled(self_model, monkeypatch):
    record = replace(self_model.domain.record, consistency=0.01)
    with monkeypatch.context() as changed:
        changed.setattr(self_model.domain, "record", record, raising=False)
        human = load_human_model("no-implants", self_model)
        some = mirror_ppl.load_recordings().select_people([0, 1])
        how = {"human": human, "train_rounds": 20, "explore": 0, "draws": 50}
        with pytest.warns(PriorConflict, match="prior of consistency is at odds with 2 of 2 peop"):
            fit = mirror_ppl.infer(some, **how)
        assert fit.summary["prior_conflicts"]["consistency"]["people"] == 2
        pooled = mirror_ppl.infer(some, **how, pooling="partial")
        assert pooled.summary["prior_conflicts"] is None
        other = run_identity(human, None, [])
    assert mirror_ppl.infer(some, **how).summary["prior_conflicts"] == {}
    assert run_identity(human, None, []) != other
