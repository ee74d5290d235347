"""`python -m mirror_ppl.evaluate`: what it compares, writes, reports and refuses."""

import csv
import json

import pytest
from example_groups import worst
from running import command

from mirror_ppl.commands import evaluate
from mirror_ppl.domains import DOMAINS, get_domain
from mirror_ppl.errors import OptionError
from mirror_ppl.evaluation import study
from mirror_ppl.evaluation.assistance import REFERENCES
from mirror_ppl.evaluation.learners import ASKED_FOR, LEARNERS, PLANNABLE

QUICK = ("no-implants", "logistic", "bc")


def test_prediction_writes_a_table_numbers_and_a_picture(tmp_path, capsys):
    args = ["prediction", "--setting", "fog", "--people", 2, "--seeds", 1, "--rounds", 2, 1]
    args += ["--models", *QUICK, "--jobs", 1, "--out", tmp_path]
    assert command(evaluate, *args) == 0
    out, err = capsys.readouterr()
    assert "driving, fog, paper: NLL of held-out actions" in out
    assert err.startswith("prediction: 0/6, 0 s\n")
    assert "prediction: 6/6 logistic of 2 rounds in driving, fog, seed 0" in err
    with (tmp_path / "prediction.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(QUICK) * 2 * 2
    assert {row["rounds"] for row in rows} == {"1", "2"}
    content = json.loads((tmp_path / "prediction.json").read_text())
    own = [float(row["nll"]) for row in rows if (row["model"], row["rounds"]) == ("bc", "2")]
    (entry,) = (one for one in content["nll"] if (one["model"], one["rounds"]) == ("bc", 2))
    assert entry["measured"]["mean"] == pytest.approx(sum(own) / 2)
    page = (tmp_path / "prediction.md").read_text()
    means = {
        one["rounds"]: one["measured"]["mean"] for one in content["nll"] if one["model"] == "bc"
    }
    assert f"| bc | {means[1]:.3f} | {means[2]:.3f} |" in page
    assert content["failed"] == {}
    words = content["command"].split()
    assert words[:4] == ["python", "-m", "mirror_ppl.evaluate", "prediction"]
    assert set(words[4:]) == {str(arg) for arg in args[1:] if arg != "--jobs"}
    assert set(content["seconds"]) == {
        f"{name} of {rounds} in driving, fog, seed 0"
        for name in QUICK
        for rounds in ("1 round", "2 rounds")
    }
    assert (tmp_path / "prediction.png").stat().st_size > 10_000
    # Again it does nothing, and says so; of more models it does the others.
    assert command(evaluate, *args) == 0
    assert "6/6 done before" in capsys.readouterr().err
    args[args.index("logistic")] = "policy-only"
    assert command(evaluate, *args) == 0
    assert len(list((tmp_path / "parts").iterdir())) == 2 * (len(QUICK) + 1)


def test_failures_are_reported_and_the_rest_is_shown(tmp_path, capsys, monkeypatch):
    def broken(group, rounds, seed, members):
        raise RuntimeError("this one cannot learn")

    monkeypatch.setitem(LEARNERS, "bc", broken)
    args = ["prediction", "--setting", "fog", "--people", 1, "--seeds", 1, "--rounds", 1]
    args += ["--models", "no-implants", "bc", "--jobs", 1, "--out", tmp_path]
    assert command(evaluate, *args) == 1
    out = capsys.readouterr().out
    assert (
        "failed: bc of 1 round in driving, fog, seed 0: RuntimeError: this one cannot learn" in out
    )
    content = json.loads((tmp_path / "prediction.json").read_text())
    assert list(content["failed"]) == ["bc of 1 round in driving, fog, seed 0"]
    assert {one["model"] for one in content["nll"]} == {"no-implants"}


def test_relevance_uses_what_assistance_played(tmp_path, capsys):
    args = ["--people", 1, "--seeds", 1, "--rounds", 1, "--played", 1, "--draws", 2]
    args += ["--models", "none", "all", "bc", "--jobs", 1, "--out", tmp_path]
    assert command(evaluate, "assistance", *args) == 0
    assert "net return per round" in capsys.readouterr().out
    assert command(evaluate, "relevance", *args) == 0
    out, err = capsys.readouterr()
    assert "3/3 done before" in err
    assert "driving, fog, paper: items about collision course" in out
    assert "no messages" in out  # by none
    content = json.loads((tmp_path / "relevance.json").read_text())["relevance"]
    assert set(content) == {"driving: collision_course", "driving: closing"}
    files = {path.name for path in tmp_path.iterdir()} - {"parts"}
    for name in ("assistance", "relevance"):
        files -= {f"{name}.{kind}" for kind in ("csv", "md", "json", "png")}
    assert not files


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("prediction", "--domain", "drivin"), 'unknown domain "drivin"'),
        (("prediction", "--models", "sqill"), 'unknown model "sqill"'),
        (("assistance", "--models", "logistic"), 'unknown model "logistic"'),
        (("prediction", "--models", "mine.py:Mine"), "mine.py: there is no such file"),
        (("prediction", "--setting", "smog"), 'unknown setting "smog"'),
        (
            ("prediction", "--domain", "driving", "bomb_defusal", "--setting", "fog"),
            "--setting: bomb_defusal has none of fog; it has labelled, unlabelled",
        ),
        (("prediction", "--population", "us"), 'unknown population "us"'),
        (("prediction", "--rounds", "0", "5"), "--rounds must be from 1 to 20, not 0"),
        (("prediction", "--rounds", "30"), "--rounds must be from 1 to 20, not 30"),
        (("prediction", "--people", "0"), "--people must be at least 1, not 0"),
        (("prediction", "--jobs", "0"), "--jobs must be at least 1, or -1 for all, not 0"),
        (("prediction", "--scheduler", "nowhere"), "--scheduler nowhere cannot be reached"),
        (("prediction", "--scheduler", " "), "--scheduler must be an address, such as tcp://"),
        (
            ("prediction", "--played", "3"),
            "--played is of assistance and relevance, not of prediction",
        ),
        (("prediction", "--draws", "9"), "--draws is of assistance and relevance, not of"),
    ],
)
def test_what_makes_no_sense_is_refused(args, message, tmp_path, capsys):
    assert command(evaluate, *args, "--out", tmp_path / "out") == 2
    assert message in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_by_default_everything_is_compared():
    cells = evaluate._cells(evaluate.Options("prediction", domain=DOMAINS))
    for domain in DOMAINS:
        for setting in get_domain(domain).settings:
            own = [c for c in cells if (c.group.domain, c.group.setting) == (domain, setting)]
            expected = {*LEARNERS} - {"mirror-nuts", *ASKED_FOR}
            if domain in ("bomb_defusal", "highway"):
                expected -= {"mirror-svi"}
            if not study._has_guide(domain):
                expected -= {"mirror-amortized"}
            if domain != "driving":
                expected -= {"sqil-everything", "sqil-pooled"}
            if setting not in ("fog", "smoke"):  # nothing is hidden: they would be the same
                expected -= {"bc-everything", "sqil-everything"}
            assert {cell.model for cell in own} == expected
            assert {cell.group.seed for cell in own} == set(range(5 if domain == "driving" else 2))
            assert len(own) == len(set(own))
    cells = evaluate._cells(evaluate.Options("assistance", domain=DOMAINS))
    assert {cell.group.setting for cell in cells} == {worst(domain) for domain in DOMAINS}
    assert {cell.model for cell in cells} == {*PLANNABLE, *REFERENCES}
    # Who has a prior says something of people of whom nothing is recorded.
    from_nothing = {cell.model for cell in cells if not cell.rounds} - {*REFERENCES}
    assert from_nothing == {"mirror", "perceptual-only", "policy-only", "no-implants"}
    # What learns nothing is played once, whatever learners plan with.
    assert {cell.draws for cell in cells if cell.model in REFERENCES} == {0}  # pyright: ignore
    # Relevance is of what assistance plays, after the most rounds.
    told = evaluate._cells(evaluate.Options("relevance", domain=DOMAINS))
    assert set(told) == {cell for cell in cells if cell.rounds == 20 or cell.model in REFERENCES}


def test_worlds_of_long_rounds_have_fewer_seeds_unless_more_are_asked_for():
    def seeds(**chosen):
        options = evaluate.Options(models=("mirror",), **chosen)
        return {
            name: {cell.group.seed for cell in cells if cell.group.domain == name}
            for cells in [evaluate._cells(options)]
            for name in chosen["domain"]
        }

    assert seeds(study="prediction", domain=DOMAINS) == {
        "driving": {*range(5)},
        "search_rescue": {0, 1},
        "bomb_defusal": {0, 1},
        "highway": {0, 1},
    }
    assert seeds(study="assistance", domain=DOMAINS) == {
        "driving": {0, 1},
        "search_rescue": {0},
        "bomb_defusal": {0},
        "highway": {0},
    }
    assert seeds(study="prediction", domain=("search_rescue",), seeds=3) == {
        "search_rescue": {0, 1, 2}
    }


def test_people_receive_messages_where_help_is_compared():
    """And by what was asked for, if anything was."""
    for name, told, expected in (
        ("prediction", None, 0.0),
        ("assistance", None, 0.03),
        ("relevance", None, 0.03),
        ("assistance", 0.0, 0.0),
        ("prediction", 0.1, 0.1),
    ):
        cells = evaluate._cells(evaluate.Options(name, models=("bc",), seeds=1, told=told))
        assert {cell.group.told for cell in cells} == {expected}
    with pytest.raises(OptionError, match="--told must be from 0 to 1, not 2"):
        evaluate.Options("assistance", told=2.0)
