"""The order in which rounds are compiled."""

import torch

from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.likelihood import telling
from mirror_ppl.likelihood.screening import Screening
from mirror_ppl.likelihood.tables import rounds_of
from mirror_ppl.likelihood.telling import some_of, telling_first
from mirror_ppl.likelihood.view_table_builder import ViewTableBuilder
from mirror_ppl.models.human import HumanModel
from mirror_ppl.models.weights import load_self_model, shipped_weights


def test_the_round_that_puts_most_behind_comes_first():
    found = torch.zeros(2, 3, 4)
    found[:, 1, 1:] = -9.0  # puts three combinations behind
    found[:, 2, 2] = -30.0  # puts one far behind, which counts up to the margin
    assert telling_first(found, torch.zeros(2, 4), 15.0) == [1, 2, 0]


def test_what_the_policy_that_suits_it_best_explains_is_not_behind():
    found = torch.zeros(2, 2, 3)
    found[0, 1, 1] = -20.0  # the other policy explains it
    found[:, 0, 2] = -1.0
    assert telling_first(found, torch.zeros(2, 3), 15.0)[0] == 0


def test_samples_are_always_the_same_and_of_those_left():
    left = torch.arange(100, 400)
    assert torch.equal(some_of(left), some_of(left))
    assert len(some_of(left)) == telling.SAMPLE
    assert set(some_of(left).tolist()) <= set(left.tolist())


def test_tables_are_in_the_order_of_the_recordings(monkeypatch):
    human = HumanModel(load_self_model(shipped_weights("driving"), "driving")[0])
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc"))
    rounds = rounds_of(recordings.select_rounds([0, 1, 2, 3]), 0)
    gone_through, tables = [], []
    add = ViewTableBuilder._add_together
    for turned in (False, True):
        if turned:
            monkeypatch.setattr(ViewTableBuilder, "_order", lambda self, rounds: [2, 0, 3, 1])
        else:
            monkeypatch.setattr(ViewTableBuilder, "_order", lambda self, rounds: [0, 1, 2, 3])
        monkeypatch.setattr(
            ViewTableBuilder,
            "_add_together",
            lambda self, some: (gone_through.append(some.actions), add(self, some)),
        )
        builder = ViewTableBuilder(human, Screening(margin=1e9, resolution=0.0))
        builder.add(rounds)
        tables.append(builder.table())
    assert not torch.equal(gone_through[0], gone_through[4])
    for name in ("index", "moments", "belief", "values", "acted", "recorded", "steps"):
        assert torch.equal(*(getattr(table, name) for table in tables)), name
