"""`assist` plays the people of the posterior, whichever of a population they are."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from paths import ROOT
from running import command

import mirror_ppl
from mirror_ppl.arviz import az
from mirror_ppl.commands import assist
from mirror_ppl.data import asset_path, load_demonstrations
from mirror_ppl.inference.results.export import netcdf_content
from mirror_ppl.models import family
from mirror_ppl.models.loading import load_human_model
from mirror_ppl.models.simulation import simulate_from_prior
from mirror_ppl.models.weights import load_self_model, shipped_weights
from mirror_ppl.people import populations_of, simulated_people

SMALL = ("--rounds", "2", "--draws", "4", "--horizon", "2", "--jobs", "1")


@pytest.fixture(scope="module")
def some():
    recordings = load_demonstrations(asset_path("driving_fog_diverse.nc"))
    return recordings.select_people(["person-02", "person-07", "person-09"])


@pytest.fixture(scope="module")
def posterior_of(tmp_path_factory):
    """Writes the file of a posterior, without the pictures of a fit."""

    def write(recordings, **options):
        options = {"train_rounds": 0, "draws": 4, "explore": 0} | options
        path = tmp_path_factory.mktemp("fit") / "posterior.nc"
        fit = mirror_ppl.infer(recordings, **options)
        path.write_bytes(bytes(netcdf_content(fit.data)))
        return path

    return write


def decisions(path, tmp_path, *arguments):
    """The log's entries by person; numbers are rounded, as others play beside them."""
    log = tmp_path / "log.jsonl"
    chosen = ("--communicator", "nearest", "oracle", "--log", log)
    assert command(assist, "--posterior", path, *SMALL, *chosen, *arguments) == 0
    found: dict[str, list] = {}
    for line in log.read_text().splitlines():
        entry = json.loads(line, parse_float=lambda text: round(float(text), 3))
        found.setdefault(entry.pop("person"), []).append(entry)
    return found


def test_some_of_the_people_are_played_as_among_all(some, posterior_of, tmp_path, capsys):
    """Also one of them alone; their choices are those of nobody else."""
    every = posterior_of(load_demonstrations(asset_path("driving_fog_diverse.nc")))
    expected = decisions(every, tmp_path)
    among = decisions(posterior_of(some), tmp_path)
    assert among == {person: expected[person] for person in some.people}
    assert len({json.dumps(own) for own in among.values()}) == 3
    alone = decisions(posterior_of(some.select_people(["person-09"])), tmp_path)
    assert alone == {"person-09": expected["person-09"]}
    chosen = decisions(every, tmp_path, "--people", "person-09", "person-02")
    assert [*chosen.items()] == [(one, expected[one]) for one in ("person-02", "person-09")]
    assert [*decisions(every, tmp_path, "--people", "2")] == ["person-01", "person-02"]
    capsys.readouterr()


@pytest.mark.parametrize(
    ("world", "setting"),
    [
        ("driving", "fog"),
        ("search_rescue", "smoke"),
        ("bomb_defusal", "unlabelled"),
        ("highway", "fog"),
    ],
)
def test_people_do_not_depend_on_how_many_follow(world, setting):
    for population in populations_of(world):
        few, many = (
            simulated_people(world, setting, population, number, 3).truth() for number in (2, 4)
        )
        for site, value in few.items():
            torch.testing.assert_close(value, many[site][:2], rtol=0, atol=0)


def test_people_are_planned_for_with_their_own_posteriors(some, posterior_of):
    """Whichever of them are chosen, and in whichever order."""
    path = posterior_of(some, train_rounds=3)
    chosen = ("person-09", "person-02")
    options = assist.Options(posterior=path, people=chosen, draws=4)
    posterior, source = assist._people(options)
    pairing = assist._pairing(options, posterior, source, chosen)
    draws = posterior.draws(pairing.human, 4)
    for place, listener in zip((2, 0), pairing.listeners(chosen), strict=True):
        for site, value in listener.person.draws.items():
            torch.testing.assert_close(value, draws[site][:, [place]], rtol=0, atol=0)
    assert not torch.equal(draws["consistency"][:, 0], draws["consistency"][:, 2])


def test_unknown_truths_are_not_compared(some, posterior_of, tmp_path, capsys):
    unknown = {site: torch.full_like(value, torch.nan) for site, value in some.truth.items()}
    path = posterior_of(replace(some, truth=unknown))
    assert [*decisions(path, tmp_path)] == list(some.people)
    capsys.readouterr()


def test_people_who_are_not_those_of_the_population_are_refused(
    some, posterior_of, tmp_path, capsys
):
    swapped = replace(some, people=("person-09", "person-07", "person-02"))
    named = replace(some, people=("ann", "bob", "cem"))
    for recordings, message in (
        (swapped, "is not that of the population diverse with seed 0: sight_front_own is "),
        (named, "the id ann is none of simulated people (person-01, person-02, ...)"),
    ):
        path = posterior_of(recordings)
        assert command(assist, "--posterior", path, *SMALL, "--communicator", "none") == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and message in error


def test_the_human_model_is_that_of_the_file(some, posterior_of, tmp_path, capsys):
    path = posterior_of(some.select_people([0]), human="late")
    arguments = ("--posterior", path, *SMALL, "--communicator", "mirror")
    assert command(assist, *arguments) == 0
    assert command(assist, *arguments, "--human-model", "noticing") == 2
    assert "is of human model late, not noticing" in capsys.readouterr().err


class Late(family.Late):
    """A user's model with the name of one of the package's."""

    def sees(self, implants, observation, step):
        return super().sees(implants, observation, step)


def test_people_drawn_from_a_human_model_play_further_rounds(posterior_of, tmp_path, capsys):
    human = load_human_model("late", load_self_model(shipped_weights("driving"))[0])
    recorded = simulate_from_prior(human, 3, 2, "fog", seed=4)
    expected = decisions(posterior_of(recorded), tmp_path)
    one = posterior_of(recorded.select_people(["person-03"]))
    assert decisions(one, tmp_path) == {"person-03": expected["person-03"]}
    assert len({json.dumps(own) for own in expected.values()}) == 3
    capsys.readouterr()


LOOKS_AWAY = f"{ROOT}/docs/examples/looks_away.py:LooksAway"


def test_people_of_a_users_model_play_further_rounds(posterior_of, tmp_path, capsys):
    """As the model has it that is given, whatever model the posterior is of."""
    human = load_human_model(LOOKS_AWAY, load_self_model(shipped_weights("driving"))[0])
    recorded = simulate_from_prior(human, 3, 2, "fog", seed=4)
    path, given = posterior_of(recorded), ("--people-model", LOOKS_AWAY)
    expected = decisions(path, tmp_path, *given)
    assert len({json.dumps(own) for own in expected.values()}) == 3
    one = posterior_of(recorded.select_people(["person-03"]), human=human)
    with_own = decisions(one, tmp_path, *given, "--human-model", LOOKS_AWAY)
    assert with_own == {"person-03": expected["person-03"]}
    capsys.readouterr()


def test_another_people_model_is_refused(some, posterior_of, tmp_path, capsys):
    human = load_human_model(LOOKS_AWAY, load_self_model(shipped_weights("driving"))[0])
    recorded = simulate_from_prior(human, 1, 1, "fog", seed=4)
    blur = {"blur": (recorded.truth["blur"] + 1) % 4}
    other = f"{ROOT}/docs/examples/late_reactions.py:LatePerson"
    of_package = simulate_from_prior(family.Late(human.self_model), 1, 1, "fog", seed=4)
    for people, model, message in (
        (recorded, other, "are drawn from the prior of LooksAway, not LatePerson"),
        (recorded, "late", '"late" is not of the form path/to/file.py:Class'),
        (replace(recorded, truth=recorded.truth | blur), LOOKS_AWAY, "by another version of"),
        (some, LOOKS_AWAY, "--people-model is for people of your own human model; those of"),
        (of_package, LOOKS_AWAY, "are drawn from the prior of Late, not LooksAway"),
    ):
        arguments = ("--posterior", posterior_of(people), *SMALL, "--people-model", model)
        assert command(assist, *arguments, "--communicator", "none") == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and message in error


def test_people_of_another_self_model_or_of_a_user_s_model_are_refused(
    posterior_of, tmp_path, capsys
):
    robot, _ = load_self_model(shipped_weights("driving"))
    other = copy.deepcopy(robot)
    with torch.no_grad():
        next(other.parameters()).add_(0.1)
    someone = simulate_from_prior(family.Late(other), 1, 1, "fog", seed=4)
    own = simulate_from_prior(Late(robot), 1, 1, "fog", seed=4)
    shipped = simulate_from_prior(family.Late(robot), 1, 1, "fog", seed=4)
    for path, message in (
        (posterior_of(someone), "its people were simulated with another self-model"),
        (posterior_of(own), "drawn from the prior of Late, your own human model; give it by --peo"),
        (posterior_of(shipped, human=Late(robot)), "is of your own human model Late; give it as"),
    ):
        assert command(assist, "--posterior", path, *SMALL, "--communicator", "none") == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and message in error


def test_who_is_not_explained_gets_no_messages_unless_asked_for(posterior_of, tmp_path, capsys):
    recordings = load_demonstrations(asset_path("driving_fog_paper.nc"))
    path = posterior_of(recordings.select_people([0, 1]), train_rounds=2, draws=6)
    data = az.from_netcdf(path)
    data["model_check"]["verdict"] = "person", np.array(["unexplained", "suspect"])
    (tmp_path / "posterior.nc").write_bytes(netcdf_content(data))
    said = "the human model does not explain the actions of person-01 (verdict unexplained)"

    def played(*chosen):
        out = ("--json", tmp_path / "a.json", "--communicator", *chosen)
        assert command(assist, "--posterior", tmp_path, *SMALL, *out) == 0
        results = json.loads((tmp_path / "a.json").read_text())
        assert results["unexplained"] == ["person-01"]
        nets = {name: one["net_by_person"] for name, one in results["communicators"].items()}
        return nets, capsys.readouterr().err

    found, error = played("mirror", "none")
    assert said in error and "no messages are planned for them" in error
    anyway, error = played("mirror", "--plan-anyway")
    assert said in error and "may do harm" in error
    assert found["mirror"][0] == found["none"][0] != anyway["mirror"][0]
    assert found["mirror"][1] == anyway["mirror"][1]
    _, error = played("none")  # a rule plans nothing
    assert said not in error
    assert command(assist, "--posterior", path, *SMALL, "--communicator", "mirror") == 0
    assert said not in capsys.readouterr().err
