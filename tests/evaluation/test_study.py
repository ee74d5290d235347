"""Cells of studies: the rows they give, and what their identity depends on."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from example_groups import FOG

from mirror_ppl.commands import evaluate
from mirror_ppl.evaluation import study
from mirror_ppl.evaluation.study import Assistance, Prediction, assist, predict

BESIDE_RESULTS = {
    *("commands", "evaluation", "plots", "training"),
    *(f"{name}.py" for name in ("__init__", "__main__", "arviz", "checkpoints", "checks")),
    *(f"{name}.py" for name in ("console", "devices", "errors", "face", "files", "fitted")),
    *(f"{name}.py" for name in ("jobs", "lazy", "limits", "netcdf", "option_help", "progress")),
    *(f"{name}.py" for name in ("stepping", "timing", "user_code", "version", "workers")),
    *(f"{name}.py" for name in ("assist", "calibrate", "check_domain", "compare", "evaluate")),
    *(f"{name}.py" for name in ("fit", "simulate", "train")),
}
"""Files and folders of the package that do not change the results of a study."""


def test_messages_are_counted_and_paid_for():
    cell = Assistance(FOG, "all", 0, 2, 4)
    rows = assist(cell)
    assert [row["person"] for row in rows] == ["person-01", "person-02"]
    for row in rows:
        assert row["net"] == pytest.approx(row["task"] - row["cost"])
        # Items are totals over the two rounds, whose number the row has.
        assert row["played"] == 2
        # More than one car in each of 30 steps, shown and said.
        assert row["items_visual"] > 30 and row["items_verbal"] > 30
        for notion in ("collision_course", "closing"):
            assert 0 < row[f"{notion}_visual"] <= row["items_visual"]
    silent = assist(Assistance(FOG, "none", 0, 2, 4))
    assert all(row["cost"] == row["items_visual"] == row["items_verbal"] == 0 for row in silent)


def test_mirror_speaks_in_two_ways_and_baselines_in_one(monkeypatch):
    asked = []
    real = study.speaker

    def spying(name, listener, *rest):
        asked.append((name, type(listener.person.human).__name__, listener.person.number))
        return real("none", listener, *rest)

    monkeypatch.setattr(study, "speaker", spying)
    for model in ("mirror", "bc"):
        rows = assist(Assistance(replace(FOG, people=1), model, 1, 1, 5))
        expected = ["mirror", "mirror-kl"] if model == "mirror" else ["bc"]
        assert [row["model"] for row in rows] == expected
        assert {row["rounds"] for row in rows} == {1}
    assert asked == [
        ("mirror", "HumanModel", 5),
        ("mirror-kl", "HumanModel", 5),
        ("mirror", "NetworkPerson", 5),
    ]


def test_a_human_model_of_ones_own_is_compared(tmp_path):
    """One that is the package's own predicts and plans as that does; its file counts."""
    file = tmp_path / "mine.py"
    file.write_text(
        "from mirror_ppl.models import HumanModel\n\nclass Mine(HumanModel):\n    ...\n"
    )
    name, group = f"{file}:Mine", replace(FOG, people=1)
    own, mirror = (predict(Prediction(group, model, 1)) for model in (name, "mirror"))
    assert [row["model"] for row in own] == [name]
    assert [row["nll"] for row in own] == [row["nll"] for row in mirror]
    own, mirror = (assist(Assistance(group, model, 1, 1, 5)) for model in (name, "mirror"))
    assert [row["model"] for row in own] == [name]
    assert own[0]["net"] == mirror[0]["net"]
    assert [cell.model for cell in study.prediction_cells(group, (name, "bc", name), (1,))] == [
        "bc",
        name,
    ]
    cells = [Prediction(group, model, 1) for model in (name, "mirror")]
    before = [study.identities(["driving"])(cell) for cell in cells]
    file.write_text(file.read_text() + "\n")
    after = [study.identities(["driving"])(cell) for cell in cells]
    assert before[0] != after[0] and before[1] == after[1]


def test_results_depend_on_the_code_that_made_them():
    root = Path(evaluate.__file__).parents[1]
    files = {path for part in study.CODE for path in root.glob(part)}
    for name in (
        "models/human.py",
        "evaluation/study.py",
        "domains/driving/world.py",
        "data/schema.py",
    ):
        assert root / name in files
    for part in study.CODE:
        assert list(root.glob(part)), part
    found = [
        Path(module.__file__)
        for name, module in sys.modules.items()
        if name.partition(".")[0] == "mirror_ppl" and getattr(module, "__file__", None)
    ]
    others = {path.relative_to(root).parts[0] for path in {*found} - files}
    assert others <= BESIDE_RESULTS
    assert root / "plots/study.py" not in files
    cell = Prediction(FOG, "mirror", 1)
    before = study.identities(["driving"])(cell)
    assert before == study.identities(["driving", "bomb_defusal"])(cell)
    assert before != study.identities(["bomb_defusal"])(
        Prediction(replace(FOG, domain="bomb_defusal"), "mirror", 1)
    )
