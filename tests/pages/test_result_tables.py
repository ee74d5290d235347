"""Pages of studies are what their rows say: `make tables` changes nothing."""

import numpy as np
import pandas as pd
import pytest
import torch
import xarray as xr

from benchmarks import (
    consistency_prior,
    driving_messages,
    example_world,
    hearing,
    highway_gap,
    highway_messages,
    messages_of_kinds,
    model_check,
    planner_settings,
    pooling,
    sbc,
    sight_by_angle,
    ties,
    value_errors,
)
from benchmarks._rows import rows_in
from benchmarks.reach import ROWS, table
from benchmarks.sight_scale import ROWS as SCALES
from benchmarks.tables import DOCS, RESULTS, results_page, rows_of, studies, study_page
from mirror_ppl.evaluation.study_summary import interval, ways_to_oracle
from mirror_ppl.evaluation.tables import comma_separated
from mirror_ppl.inference.calibration.ranks import Calibration

STUDIES = studies()


@pytest.mark.parametrize("name", STUDIES)
def test_pages_are_what_their_rows_say(name):
    assert (RESULTS / f"{name}.md").read_text() == study_page(name, STUDIES[name])
    assert (RESULTS / f"{name}.png").stat().st_size > 0


def test_pages_are_the_same_of_rows_with_the_number_of_played_rounds(tmp_path):
    """Which rows that were kept before do not have."""
    for name in ("driving_assistance", "driving_relevance"):
        with_number = [row | {"played": 2} for row in STUDIES[name]]
        assert study_page(name, with_number) == study_page(name, STUDIES[name])
    file = tmp_path / "rows.csv"
    file.write_text(comma_separated(with_number))
    assert {row["played"] for row in rows_of(file)} == {2}
    assert rows_of(file) == with_number


def test_tables_of_the_page_of_results_are_what_their_rows_say():
    page = (DOCS / "results.md").read_text()
    assert results_page(page) == page
    assert page.count("<!-- end -->") >= 1
    assert "driving_relevance" in STUDIES and "highway_relevance" not in STUDIES


def test_a_number_that_is_not_in_the_rows_is_found():
    page = (DOCS / "results.md").read_text()
    before, end, after = page.partition("<!-- end -->")
    wrong = f"{before}| made up |\n{end}{after}"
    assert results_page(wrong) == page


def test_the_choice_of_the_prior_over_directions_is_what_its_rows_say():
    rows = rows_in(SCALES)
    total = {
        scale: sum(float(row["log_bayes_factor"]) for row in rows if row["scale"] == scale)
        for scale in ("0.5", "2", "inf")
    }
    words = " ".join((DOCS / "decisions.md").read_text().split())
    assert f"the data are {-total['inf']:.1f} nats more probable under it" in words
    gained, lost = f"{total['0.5']:.1f}".lstrip("0"), f"{-total['2']:.1f}"
    assert f"another {gained}, one of two bins loses {lost}" in words


def test_the_table_of_sight_by_angle_is_what_its_rows_say():
    page = (DOCS / "highway.md").read_text()
    found = page.partition("<!-- sight by angle -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == sight_by_angle.table(rows_in(sight_by_angle.ROWS))


def test_the_table_of_planner_settings_is_what_its_rows_say():
    page = (DOCS / "decisions.md").read_text()
    rows = rows_in(planner_settings.ROWS)
    found = page.partition("<!-- planner settings -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == planner_settings.table(rows)
    assert all(int(row["seed"]) >= 100 for row in rows)


def test_the_table_of_value_errors_is_what_its_rows_say():
    page = (DOCS / "decisions.md").read_text()
    found = page.partition("<!-- value errors -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == value_errors.table(rows_in(value_errors.ROWS))


def test_the_table_of_prior_medians_is_what_its_rows_say():
    page = (DOCS / "decisions.md").read_text()
    found = page.partition("<!-- consistency prior -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == consistency_prior.table(rows_in(consistency_prior.ROWS))


def test_the_table_of_equally_good_actions_is_what_its_rows_say():
    page = (DOCS / "self_model.md").read_text()
    found = page.partition("<!-- ties -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == ties.table(rows_in(ties.ROWS))


def test_separations_are_of_the_best_actions_alone():
    exact = torch.tensor([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [2.0, 2.0, 2.0]])
    values = torch.tensor([[0.9, 1.1, 5.0], [1.0, 0.0, 0.5], [1.0, 2.0, 4.0]])
    assert ties.separations(exact, values).tolist() == pytest.approx([0.2, 3.0])


def test_the_table_of_messages_to_drivers_is_what_its_rows_say():
    page = (DOCS / "highway.md").read_text()
    rows = rows_of(highway_messages.ROWS)
    for setting in ("fog", "clear"):
        after = page.partition(f"<!-- messages in {setting} -->\n")[2]
        found = after.partition("\n<!-- end -->")[0]
        assert found == highway_messages.table(rows, setting)
    found = page.partition("<!-- advantages -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == highway_messages.advantages(rows)
    words = " ".join(page.split())
    for setting, start in (("fog", "In fog"), ("clear", "in clear weather")):
        here = highway_messages.by_driver(row for row in rows if row["setting"] == setting)
        net = {
            key: np.array([row["net"] for row in here if (row["model"], row["rounds"]) == key])
            for key in (("mirror", 20), ("none", 0))
        }
        gain = interval(net["mirror", 20] - net["none", 0])
        shown = f"{gain.mean:.1f} [{gain.low:.1f}, {gain.high:.1f}]"
        assert f"{start} messages of `mirror` are worth {shown} a round" in words
        (way,) = (
            one.share for one in ways_to_oracle(here) if (one.model, one.rounds) == ("mirror", 20)
        )
        assert way is not None and f"{100 * way.mean:.0f}% of the way" in words


def test_the_table_of_what_messages_to_drivers_lose_is_what_its_rows_say():
    page = (DOCS / "highway.md").read_text()
    rows = rows_in(highway_gap.ROWS)
    found = page.partition("<!-- gap -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == highway_gap.table(rows)
    for receive, drivers, decisions in (("none", 10, 400), ("mirror", 20, 480)):
        own = [row for row in rows if row["receive"] == receive]
        assert len(own) == drivers and sum(int(row["decisions"]) for row in own) == decisions
    words = " ".join(page.split())
    cells = [line.split(" | ") for line in found.splitlines()[-3:]]
    state, choices, lidar = (cell[-1].split()[0] for cell in cells)
    assert f"it would gain {state}% with the values of the true state, and {choices}% with" in words
    assert f"values of the state that the lidar shows would gain {lidar}%" in words
    count = np.array([int(row["decisions"]) for row in own])
    values, choices, best, mirror = (
        count * np.array([float(row[way]) for row in own])
        for way in ("true_values", "true_choices", "best", "mirror")
    )
    apart = highway_gap.share_of_best(values - choices, best).replace(" ", " points ", 1)
    assert f"the difference is {apart}" in words
    silent = [row for row in rows if row["receive"] == "none"]
    lost = (
        np.array([float(row["decisions"]) * float(row[way]) for row in silent])
        for way in ("true_choices", "true_values", "best")
    )
    first, second, most = lost
    less = highway_gap.share_of_best(first - second, most).replace(" ", " points ", 1)
    assert f"with the values of the true state it would gain {less} less" in words
    left = np.sort(best - mirror)
    share = 100 * left[-2:].sum() / left.sum()
    assert (
        f"Two of the twenty drivers account for {share:.0f}% of the gain that `mirror` misses"
        in words
    )


def test_the_example_of_a_random_world_is_what_its_rows_say():
    page = (DOCS / "adding_a_world.md").read_text()
    found = page.partition("<!-- obstacles -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == example_world.table(rows_in(example_world.MESSAGES))
    assert example_world.held(rows_in(example_world.IMPLANTS)) == {
        "sight_around": 10,
        "consistency": 10,
    }
    assert "hold all ten thresholds and all ten consistencies" in " ".join(page.split())


def test_the_table_of_reaches_is_what_its_rows_say():
    page = (DOCS / "highway.md").read_text()
    rows = rows_in(ROWS)
    found = page.partition("<!-- reach -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == table(rows)
    people = {(row["fit"], row["person"]): row for row in rows}.values()
    assert len(people) == 50
    clear = sum(float(row["assumes_clear"]) == 1 for row in people)
    unreliable = sum(float(row["pareto_k"]) > 0.7 for row in people)
    suspect = sum(row["verdict"] == "suspect" for row in people)
    nats = [
        f"{sum(float(row[name]) for row in people) / 50:.2f}".lstrip("0")
        for name in ("nll", "floor", "nll_no_implants", "nll_base_rate")
    ]
    words = " ".join(page.split())
    assert f"{clear} of 50 are found to take the road for clear" in words
    weights = f"Importance weights of {unreliable}" if unreliable else "No importance weights"
    assert f"{weights} are unreliable" in words
    reasons = [row["reasons"] for row in people]
    earn, seldom = (
        sum(what in reason for reason in reasons)
        for what in ("earns more", "changes what they do less often")
    )
    assert f"{suspect} of 50 are `suspect`: {earn} earn more than predicted" in words
    assert f"and {seldom} change their action less often" in words
    own, entropy, none, base = nats
    assert (
        f"{own}; the drivers' own entropy is {entropy}, a robot without implants has {none}"
        in words
    )
    assert f"the base rate {base}." in words


def test_the_tables_of_messages_in_driving_are_what_their_rows_say():
    page = (DOCS / "communicator.md").read_text()
    rows = rows_in(driving_messages.ROWS)
    for name, expected in (
        ("fog", driving_messages.fog_table),
        ("elsewhere", driving_messages.short_table),
    ):
        found = page.partition(f"<!-- {name} -->\n")[2].partition("\n<!-- end -->")[0]
        assert found == expected(rows)
    words = " ".join(page.split())
    above = driving_messages.above_nearest(rows)
    assert f"`mirror` gains {above} more a round than `nearest`" in words
    readme = (DOCS.parent / "README.md").read_text()
    for population in ("paper", "diverse"):
        own = driving_messages.of(rows, "fog", population)
        names = ("none", "nearest", "mirror", "oracle")
        net = " | ".join(f"{float(own[name]['net']):.2f}" for name in names)
        way = driving_messages.interval(own["mirror"], "way_to_oracle", ".0f", 100)
        assert f"(`{population}`) | {net} | {way} |" in readme
    gains = []
    for where in driving_messages.ELSEWHERE:
        own = driving_messages.of(rows, *where)
        net = [driving_messages.net_of_people(own[name]) for name in ("mirror", "none")]
        gains.extend(net[0] - net[1])
    assert len(gains) == 30 and min(gains) >= 0.05
    assert (
        "each of the thirty people of the last table does better than in silence, by 0.05" in words
    )


def test_tables_of_trust_are_what_their_rows_say():
    page = (DOCS / "trust.md").read_text()
    checks = pd.read_csv(RESULTS / "model_check.csv")
    for name, expected in (
        ("verdicts", model_check.verdict_table(checks)),
        ("models", model_check.model_table(checks)),
        ("hearing", hearing.table(rows_in(hearing.ROWS))),
        ("calibration", sbc.table(rows_in(sbc.ROWS))),
        ("together", pooling.together_table(rows_in(pooling.ROWS))),
    ):
        found = page.partition(f"<!-- {name} -->\n")[2].partition("\n<!-- end -->")[0]
        assert found == expected
    assert all(int(row["seed"]) < 100 for row in rows_in(hearing.ROWS))
    assert (checks["seed"] < 100).all()
    assert all(int(row["seed"]) >= 100 for row in rows_in(pooling.ROWS))


def test_messages_to_drivers_of_other_kinds_are_what_their_rows_say():
    page, rows = (DOCS / "communicator.md").read_text(), rows_in(messages_of_kinds.ROWS)
    found = page.partition("<!-- kinds -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == messages_of_kinds.table(rows)
    found = page.partition("<!-- all ahead -->\n")[2].partition("\n<!-- end -->")[0]
    assert found == messages_of_kinds.ahead(rows)
    assert all(int(row["seed"]) < 100 for row in rows)


def test_rows_of_a_calibration_take_the_place_of_those_that_were_there(rng):
    """Of two people of bomb defusal, whose human model has a class of its own."""
    place = rng.random((1, 3, 2))
    data = xr.Dataset(
        {
            "rank": (("site", "rounds", "person"), (place * 10).astype(int)),
            "place": (("site", "rounds", "person"), place),
            **{name: (("site", "rounds", "person"), place) for name in ("width", "entropy")},
            "probability": (("site", "rounds", "person"), place),
            "pareto_k": (("site", "rounds", "person"), np.full_like(place, np.nan)),
            "discrete": ("site", [False]),
            **{f"prior_{n}": ("site", [2.0]) for n in ("width", "entropy", "probability")},
        },
        {"site": ["reads_type"], "rounds": [1, 5, 20]},
        {
            "draws": 9,
            "domain": "bomb_defusal",
            "setting": "unlabelled",
            "human_model": "BombDefusalHuman",
            "engine": "importance",
        },
    )
    before = rows_in(sbc.ROWS)
    new = sbc.new_rows(Calibration(data))
    assert [(row["human_model"], row["implant"], row["rounds"]) for row in new] == [
        ("mirror", "reads type", rounds) for rounds in ("1", "5", "20")
    ]
    assert new[0].keys() == before[0].keys()
    after = sbc.replaced(before, new)
    lines, old = (sbc.table(rows).splitlines() for rows in (after, before))
    assert [a for a, b in zip(lines, old, strict=True) if a != b] == [
        line for line in lines if line.startswith("| bomb defusal, `mirror`, `importance`, 2 |")
    ]
    assert len(after) == len(before) - 39 + 3
    first = [row | {"domain": "driving", "human_model": "other"} for row in new]
    after = sbc.replaced(before, first)
    last = max(n for n, row in enumerate(before) if row["domain"] == "driving")
    assert after[last + 1 : last + 4] == first and after[: last + 1] == before[: last + 1]
    with pytest.raises(SystemExit, match="not of .* in labelled"):
        sbc.new_rows(Calibration(data.assign_attrs(setting="labelled")))
    del data.attrs["engine"]
    with pytest.raises(SystemExit, match="does not name its engine"):
        sbc.new_rows(Calibration(data))
