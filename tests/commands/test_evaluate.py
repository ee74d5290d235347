"""The paper's comparisons: who learns what, what comes out, and what is refused."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from running import command

from mirror_ppl.baselines import NetworkPerson
from mirror_ppl.baselines.training import mean_nll
from mirror_ppl.commands import evaluate
from mirror_ppl.domains import DOMAINS, get_domain
from mirror_ppl.domains.bomb_defusal.panel import OLD_RULES, RULES
from mirror_ppl.errors import OptionError
from mirror_ppl.evaluation import learners, study
from mirror_ppl.evaluation.assistance import REFERENCES
from mirror_ppl.evaluation.learned import SAME_DRAWS
from mirror_ppl.evaluation.learners import ASKED_FOR, LEARNERS, PLANNABLE, TEST, Group, learn
from mirror_ppl.evaluation.study import Assistance, Prediction, assist, predict
from mirror_ppl.evaluation.study_report import REPORTS
from mirror_ppl.evaluation.study_summary import (
    Interval,
    ModelResult,
    Place,
    Share,
    means_table,
    shares_table,
)
from mirror_ppl.inference.engines import InferenceOptions, Inferred
from mirror_ppl.inference.results.fitting import fit_people
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.world_knowledge import planning_domain
from mirror_ppl.plots.study import STYLES, plot_curves, plot_relevance

FOG = Group("driving", "fog", "paper", 2, 0)
QUICK = ("no-implants", "logistic", "bc")


def worst(domain):
    return get_domain(domain).settings[-1]


# --- learners ---------------------------------------------------------------------------------


def test_mirror_predicts_what_a_fit_predicts():
    """The same draws of the same posterior, by the command's function and by the study's."""
    human = load_human_model(None, FOG.self_model)
    fit = fit_people(human, FOG.recordings(), InferenceOptions(), seed=3, train_rounds=2)
    rows = predict(Prediction(FOG, "mirror", 2))
    assert [row["person"] for row in rows] == ["person-01", "person-02"]
    found = learn("mirror", FOG, 2, 3)
    test = FOG.recordings().select_rounds(TEST)
    own = found.log_predictive(test).gather(-1, test.actions[..., None]).squeeze(-1)
    for number, person in enumerate(fit.summary["people"]):
        assert -own[number].mean().item() == pytest.approx(person["test"]["nll"], abs=1e-5)
    assert {row["floor"] for row in rows} == {p["test"]["floor"] for p in fit.summary["people"]}


@pytest.mark.parametrize(
    ("name", "domain"),
    [
        # On the highway it takes minutes; tests/domains/highway infers a driver.
        *(("perceptual-only", domain) for domain in DOMAINS if domain != "highway"),
        *(("policy-only", domain) for domain in DOMAINS),
        *(("no-implants", domain) for domain in DOMAINS),
        *(("logistic", domain) for domain in DOMAINS),
        *(("bc", domain) for domain in DOMAINS),
        # Others take long, and share their code with these.
        ("mirror-amortized", "driving"),
        ("mirror-svi", "driving"),
        ("mirror-svi", "search_rescue"),
        ("sqil", "driving"),
    ],
)
def test_everybody_learns_everywhere(name, domain):
    """One person, one round (eight, where there is much to learn): probabilities of all actions of
    held-out rounds, and better ones than if all were alike."""
    group = Group(domain, worst(domain), "paper", 1, 0)
    test, actions = group.recordings().select_rounds(slice(30, 32)), get_domain(domain).actions
    few = 8 if name == "bc" or (name, domain) == ("logistic", "highway") else 1
    found = learn(name, group, few, 0).log_predictive(test)
    assert found.shape == (*test.shape, len(actions))
    torch.testing.assert_close(found.exp().sum(-1), torch.ones(test.shape), rtol=0, atol=1e-4)
    assert mean_nll(found, test.actions).item() < math.log(len(actions))


@pytest.mark.parametrize(
    ("name", "guide"),
    [("mirror", "importance"), ("mirror-amortized", "amortized")]
    + [(f"mirror-{guide}", guide) for guide in ("svi", "nuts")],
)
def test_mirror_is_inferred_by_the_guide_of_its_name(name, guide, monkeypatch):
    asked = []

    def noted(human, rounds, options, *args, **others):
        asked.append(options.engine)
        return Inferred({})

    monkeypatch.setattr("mirror_ppl.evaluation.learners.infer", noted)
    learn(name, FOG, 1, 0)
    assert asked == [guide]


def test_a_population_is_learned_from_others(monkeypatch):
    """Of the same setting and number, and the same for all seeds; then it is everybody's prior."""
    asked = []

    def spying(human, rounds, options, seed, network=None, population=None):
        asked.append((rounds, options.pooling, population))
        return Inferred({}, population="theirs")  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(learners, "infer", spying)
    learners.population_of.cache_clear()
    try:
        for seed in (4, 5):
            learn("mirror-population", replace(FOG, seed=seed), 3, 0)
    finally:
        learners.population_of.cache_clear()
    (others, pooling, unknown), *own = asked
    assert (pooling, unknown) == ("partial", None)
    assert others.shape[:2] == (2, 20) and others.setting == "fog"
    for (rounds, pooling, known), seed in zip(own, (4, 5), strict=True):
        assert (pooling, known) == ("none", "theirs")
        expected = replace(FOG, seed=seed).recordings().select_rounds(slice(3))
        assert torch.equal(rounds.actions, expected.actions)
        assert not torch.equal(others.actions[:, :3], rounds.actions)


def test_baselines_know_what_rewards_identify_of_the_world():
    """Recorded rewards say that the robot's rules are out of date; each planner gets to know it."""
    group = Group("bomb_defusal", "unlabelled", "paper", 2, 0)
    person = learn("bc", group, 20, 0).person(1, 3)  # pyright: ignore[reportAttributeAccessIssue]
    assert isinstance(person.human, NetworkPerson)
    assert person.human.networks.people == ("person-02",)
    assert person.number == 3
    more = learn("bc", group, 1, 0).person(1, 64)  # pyright: ignore[reportAttributeAccessIssue]
    assert more.number == SAME_DRAWS < 64
    world = planning_domain(person.human, person.draws)
    assert world.rules == RULES  # pyright: ignore[reportAttributeAccessIssue]
    assert world.rules != OLD_RULES  # pyright: ignore[reportAttributeAccessIssue]


# --- rows -------------------------------------------------------------------------------------


def test_messages_are_counted_and_paid_for():
    cell = Assistance(FOG, "all", 0, 2, 4)
    rows = assist(cell)
    assert [row["person"] for row in rows] == ["person-01", "person-02"]
    for row in rows:
        assert row["net"] == pytest.approx(row["task"] - row["cost"])
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


# --- the command ------------------------------------------------------------------------------


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
    assert "6/6 6 were done before" in capsys.readouterr().err
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
    assert "3 were done before" in err
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
    assert root / "plots/study.py" not in files
    cell = Prediction(FOG, "mirror", 1)
    before = study.identities(["driving"])(cell)
    assert before == study.identities(["driving", "bomb_defusal"])(cell)
    assert before != study.identities(["bomb_defusal"])(
        Prediction(replace(FOG, domain="bomb_defusal"), "mirror", 1)
    )


# --- pictures ---------------------------------------------------------------------------------


def test_every_model_has_a_look_of_its_own():
    models = {*LEARNERS, "mirror-kl", *REFERENCES}
    assert models == set(STYLES)
    assert len({STYLES[name] for name in LEARNERS}) == len(LEARNERS)


def result(model, rounds, mean, place=Place("driving", "fog", "paper")):  # noqa: B008
    return ModelResult(place, model, rounds, Interval(mean, mean - 0.1, mean + 0.1), 3, None)


def test_tables_say_where_a_person_is_missing():
    """A cell of bc failed: its mean is of one person, and the advantage over it, too."""
    rows = [
        Place("driving", "fog", "paper")._asdict()
        | {"seed": seed, "person": "a", "model": model, "rounds": 1}
        | {"nll": nll, "accuracy": 0.5, "floor": 0.1}
        for seed, model, nll in ((0, "mirror", 0.2), (1, "mirror", 0.4), (1, "bc", 0.5))
    ]
    nll, accuracy = REPORTS["prediction"](rows).tables
    assert "mean over 2 people" in nll.caption
    assert dict(nll.rows) == {
        "mirror": "0.300",
        "bc": "0.500 (1 of 2 people)\n+0.100\n[+0.100, +0.100]\n100%",
    }
    assert dict(accuracy.rows)["bc"] == "0.500 (1 of 2 people)\n+0.000\n[+0.000, +0.000]\n50%"


def test_relevance_has_a_panel_for_each_place(monkeypatch):
    """Two settings of one domain: two tables, and two panels."""
    rows = [
        {"domain": "driving", "setting": setting, "population": "paper", "seed": 0}
        | {"person": "a", "model": "bc", "rounds": 20, "items_visual": 2, "items_verbal": 0}
        | {f"{n}_{m}": 1 for n in ("collision_course", "closing") for m in ("visual", "verbal")}
        for setting in ("clear", "fog")
    ]
    picture = REPORTS["relevance"](rows).picture
    assert [ax.get_title() for ax in picture.axes] == ["driving clear paper", "driving fog paper"]
    assert [len(ax.patches) for ax in picture.axes] == [2, 2]


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


def test_curves_by_ratio_are_numbered_as_they_are_read():
    results = [result("mirror", 1, 0.2), result("mirror", 20, 0.18), result("bc", 1, 1.1)]
    picture = plot_curves(means_table(results), "NLL", by_ratio=True)
    (ax,) = picture.axes
    assert ax.get_yscale() == "log"
    low, high = ax.get_ylim()
    shown = [tick for tick in ax.get_yticks() if low <= tick <= high]
    assert [round(tick, 2) for tick in shown if tick > 0.19] == [0.2, 0.3, 0.4, 0.6, 0.8, 1.0]
    picture.canvas.draw()
    assert {"0.2", "0.3", "1"} <= {label.get_text() for label in ax.get_yticklabels()}


def test_curves_have_a_panel_for_each_place_and_level_lines():
    clear = Place("driving", "clear", "paper")
    results = [result("mirror", 20, 0.1), result("mirror", 1, 0.3), result("none", 0, 0.5)]
    picture = plot_curves(
        means_table([*results, result("bc", 1, 0.4, clear)]), "NLL", {clear: 0.05}
    )
    fog, other = picture.axes
    curve, level = fog.lines
    assert list(curve.get_xdata()) == [1, 20] and list(curve.get_ydata()) == [0.3, 0.1]
    assert set(level.get_ydata()) == {0.5}
    assert [fog.get_title(), other.get_title()] == ["driving fog paper", "driving clear paper"]
    assert {line.get_label() for line in other.lines} == {"bc", "people's own entropy"}
    (legend,) = picture.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "mirror",
        "bc",
        "none",
        "people's own entropy",
    ]


def test_models_of_ones_own_are_called_by_file_and_class_unless_two_are_called_so():
    names = ["mirror", "a/mine.py:Mine", "b/mine.py:Mine", "b/other.py:Mine"]
    (ax,) = plot_curves(means_table([result(name, 1, 0.1) for name in names]), "NLL").axes
    labels = ["mirror", "a/mine.py:Mine", "b/mine.py:Mine", "other.py:Mine"]
    assert [line.get_label() for line in ax.lines] == labels
    assert len({line.get_linestyle() for line in ax.lines[1:]}) == len(names) - 1


def test_levels_that_would_flatten_the_curves_are_given_in_words():
    """Curves from .1 to .5 with their intervals: a level at 1.9 is drawn, one at -90 is not."""
    results = [result("mirror", 20, 0.2), result("bc", 1, 0.4)]
    results += [result("none", 0, 1.9), result("all", 0, -90.0)]
    (ax,) = plot_curves(means_table(results), "net return").axes
    assert {line.get_label() for line in ax.lines} == {"mirror", "bc", "none"}
    assert [text.get_text() for text in ax.texts] == ["all: -90.0, off the scale"]
    assert ax.get_ylim()[0] > -1


def test_bars_are_of_the_most_rounds_and_silence_is_named():
    place = Place("driving", "fog", "paper")
    shares = [
        Share(place, "mirror", 1, "all", 5, Interval(0.9, 0.8, 1.0)),
        Share(place, "mirror", 20, "all", 5, Interval(0.6, 0.5, 0.7)),
        Share(place, "none", 0, "all", 0, None),
    ]
    (ax,) = plot_relevance(shares_table(shares)).axes
    (bar,) = ax.patches
    assert bar.get_height() == pytest.approx(60)  # pyright: ignore[reportAttributeAccessIssue]
    assert [text.get_text() for text in ax.texts] == ["none: no messages"]


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
