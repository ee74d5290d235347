"""The page about worlds of one's own: its file, its commands, and what is refused."""

import hashlib
import re
import shlex
from importlib import import_module

import pytest
import torch
from paths import ROOT
from running import command

import mirror_ppl
from mirror_ppl.domains import DOMAINS, Modality, World, add_domain, get_domain
from mirror_ppl.domains.capabilities import CAPABILITIES
from mirror_ppl.domains.checking import faults_of
from mirror_ppl.domains.registry import code_of, load_world
from mirror_ppl.errors import DomainError, UnknownNameError
from mirror_ppl.inference.results.posterior_predictive import predict_rounds
from mirror_ppl.people import simulate, simulated_people
from mirror_ppl.user_code import misspelt

PAGE = (ROOT / "docs" / "adding_a_world.md").read_text()
FILE = ROOT / "docs" / "examples" / "round_table.py"
WORLD = f"{FILE}:RoundTable"
SMALL = {
    "train": {"--phases": "1", "--steps": "20"},
    "simulate": {"--people": "2", "--rounds": "5"},
    "fit": {"--train-rounds": "3", "--draws": "50", "--jobs": "2"},
    "assist": {"--rounds": "1", "--people": "1", "--draws": "4", "--jobs": "1"},
}


def test_the_page_shows_the_whole_file():
    assert FILE.read_text() in PAGE
    assert FILE.read_text().count("\n") <= 100


def test_the_page_lists_what_a_world_may_offer():
    rows = re.findall(r"^\| `(\w+)` \| (.+?) \| (.+?) \|$", PAGE, re.MULTILINE)
    assert rows == [(one.method, one.otherwise, one.gives) for one in CAPABILITIES]


@pytest.fixture(scope="module")
def gone_through(tmp_path_factory):
    """The folder in which all commands of the page were run, with small settings."""
    folder = tmp_path_factory.mktemp("table")
    lines = [line for line in PAGE.splitlines() if line.startswith("python -m mirror_ppl.")]
    lines = [line for line in lines if "round_table.py:RoundTable" in line]
    assert len(lines) == 5
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "docs").symlink_to(ROOT / "docs")
        for line in lines:
            _, _, module, *given = shlex.split(line)
            name = module.removeprefix("mirror_ppl.")
            for option, value in SMALL.get(name, {}).items():
                if option in given:
                    place = given.index(option)
                    del given[place : place + 2]
                given += [option, value]
            own = import_module(f"mirror_ppl.commands.{name}")
            assert command(own, *given) == 0, line
    return folder


def test_every_command_of_the_page_works(gone_through):
    made = {path.name for path in (gone_through / "runs" / "table").iterdir()}
    assert {"posterior.nc", "summary.json", "sight.png", "check.png"} <= made
    assert (gone_through / "runs" / "round_table_self_model.safetensors").exists()


def test_it_is_inferred_from_python(gone_through, monkeypatch):
    monkeypatch.chdir(gone_through)
    fit = mirror_ppl.infer("runs/table.nc", domain=WORLD, train_rounds=2, draws=20)
    assert fit.human.domain.name == "round_table"
    assert fit.plot.sight() is not None
    with pytest.raises(mirror_ppl.face.InputError, match="recordings are of round_table"):
        mirror_ppl.infer("runs/table.nc", domain="driving")


def test_people_like_the_robot_are_the_human_model(gone_through, monkeypatch):
    """What simulated people do has the probabilities that the program gives them."""
    monkeypatch.chdir(gone_through)
    get_domain(WORLD)
    rounds = simulate("round_table", "dark", "diverse", 3, 4, seed=5, told=0.2)
    people = simulated_people("round_table", "dark", "diverse", 3, 5)
    human, known = people.modelled()
    found = predict_rounds(human, rounds, known)[0]
    entropy = torch.special.entr(found.exp()).sum(-1)
    # A lapse has probability 1e-6 in place of none.
    assert torch.allclose(entropy[rounds.mask], rounds.action_entropy[rounds.mask], atol=1e-4)
    paper = simulated_people("round_table", "dark", "paper", 3, 5)
    assert paper.modelled() is None
    assert torch.equal(paper.consistency, people.consistency)


def test_the_tables_of_a_study(gone_through, monkeypatch, tmp_path):
    from mirror_ppl.commands import calibrate, evaluate

    monkeypatch.chdir(gone_through)
    args = ["--domain", WORLD, "--people", "2", "--seeds", "1", "--rounds", "1", "--jobs", "1"]
    some = [
        "--setting",
        "dark",
        "--models",
        "mirror",
        "base-rate",
        "--out",
        tmp_path / "prediction",
    ]
    assert command(evaluate, "prediction", *args, *some) == 0
    few = ["--domain", WORLD, "--people", "2", "--rounds", "2", "--draws", "20", "--jobs", "2"]
    assert command(calibrate, *few, "--out", tmp_path / "calibration") == 0


def world(**changes):
    """The round table with other methods or attributes."""
    return type("Changed", (type(load_world(WORLD)),), changes)


def start_of_numbers(self, batch, generator, scenario=None):
    return torch.zeros(batch)


def careless(self, batch, generator, scenario=None):
    state = type(self).__mro__[1].initial(self, batch, generator)
    return type(state)(torch.randint(1, 4, (batch,)), state.puddle, state.has_tea)


def forgetful(self, observation):
    state = type(self).__mro__[1].state_behind(self, observation)
    return type(state)(state.pot, 0 * state.puddle, state.has_tea)


def by_chance(self, state, action):
    after = type(self).__mro__[1].transition(self, state, action)
    return type(after)(after.pot, torch.randint(1, 4, after.puddle.shape), after.has_tea)


def in_place(self, state, action):
    state.puddle.add_(1)
    return state


def nowhere(self, state, action, following):
    return {
        "tea": torch.full(action.shape, torch.nan),
        "puddle": 0.0 * action,
        "step": 0.0 * action,
    }


def broken(self, state):
    raise RuntimeError("the lamp is out")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": ("wait",)}, "actions: expected at least 2, found 1"),
        ({"ego_features": ()}, "ego_features: expected at least one, found none"),
        (
            {"directions": ("left", "right")},
            "distance: there are 2 directions, of which the default",
        ),
        ({"over": lambda self, state: state.pot > 0}, "over: true at the start of a round"),
        ({"mishap": ("fire", "fires")}, "mishap: expected one of reward_terms, found 'fire'"),
        ({"reach_bins": (0.0, 2.0)}, "the last one has to be all the world, 3 places, found 2"),
        ({"lasting": "pot"}, "lasting: expected a tuple of items, found 'pot'"),
        ({"lasting": ("pott",)}, "lasting: 'pott' is no item; there are pot, puddle"),
        (
            {"reach_practice": (1.0, 2.0)},
            "reach_practice: expected a weight for each of the 4 reach_bins, at least 0 and not",
        ),
        ({"reach_practice": (1.0, 1.0, -1.0, 1.0)}, "at least 0 and not all 0, found (1.0, 1.0"),
        ({"reach_practice": (0.0,) * 4}, "at least 0 and not all 0, found (0.0, 0.0"),
        ({"told_practice": 1.5}, "told_practice: expected a probability, 0 to 1, found 1.5"),
        ({"told_practice": -0.1}, "told_practice: expected a probability, 0 to 1, found -0.1"),
        ({"counterparts": (None,)}, "counterparts: expected one for each of 2 visual items"),
        ({"counterparts": (0, None)}, "None or the index of one of 0 verbal items, found (0, None"),
        (
            {"scenarios": ("early", "late")},
            "initial: all 2 scenarios begin in the same states; use the argument scenario",
        ),
        (
            {"possible_rewards": lambda self, observation, action: torch.ones(*action.shape, 2)},
            "possible_rewards: expected 0 among them, found 1, 1",
        ),
        ({"initial": start_of_numbers}, "initial: expected a dataclass of tensors, found Tensor"),
        ({"initial": careless}, "draw with the one that is passed"),
        ({"transition": by_chance}, "transition: is not pure"),
        ({"transition": in_place}, "transition: changes the state that it is given"),
        ({"rewards": nowhere}, "rewards: tea has nan, expected finite numbers (step 0)"),
        ({"rewards": lambda *_: {}}, "rewards: expected the terms tea, puddle, step, found "),
        ({"observe": lambda *_: {}}, "observe: expected ego, visual, found "),
        ({"observe": broken}, "observe fails: RuntimeError: the lamp is out"),
        ({"state_behind": forgetful}, "state_behind: visual of the state is not what was observed"),
        ({"levels": {"offset": range(3)}}, "offset of visual has to be one of [0, 1, 2]"),
        ({"visibility": lambda *_: {}}, "visibility in light: expected masks of visual"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(changes, message):
    kind = world(**changes)
    (fault, *_) = faults_of(kind())
    assert message in fault
    with pytest.raises(DomainError, match="^Changed: "):
        add_domain(kind)


def test_a_sound_world_has_no_faults_and_shipped_names_are_taken():
    assert faults_of(load_world(WORLD)) == []
    for name in DOMAINS:
        with pytest.raises(DomainError, match=f"mirror_ppl has a world {name} itself"):
            add_domain(world(name=name))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("nowhere.py:World", "there is no such file"),
        (f"{FILE}:Table", "has no class Table derived from mirror_ppl.domains.World"),
        (str(FILE), "is not of the form path/to/file.py:Class"),
        (3, "a world is derived from mirror_ppl.World, not int"),
    ],
)
def test_what_is_no_world(given, message):
    with pytest.raises(DomainError, match=re.escape(message)):
        add_domain(given)


def test_what_only_the_author_knows_is_asked_for():
    with pytest.raises(DomainError, match="Empty needs modalities"):
        load_world(type("Empty", (World,), dict.fromkeys(World.__abstractmethods__, broken)))
    with pytest.raises(UnknownNameError, match='unknown domain "tea"'):
        get_domain("tea")


def test_a_bad_world_ends_a_command_with_one_line(tmp_path, capsys):
    from mirror_ppl.commands import check_domain
    from mirror_ppl.commands import simulate as simulate_command

    bad = tmp_path / "bad.py"
    bad.write_text(FILE.read_text().replace('"puddle": -2.0', '"puddel": -2.0'))
    spec = f"{bad}:RoundTable"
    assert command(simulate_command, "--domain", spec, "--out", tmp_path / "x.nc") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: RoundTable: rewards: expected the terms tea, puddle, step")
    assert command(check_domain, spec) == 1
    assert "1 thing wrong" in capsys.readouterr().out
    assert command(check_domain, WORLD) == 0
    assert "left out" in capsys.readouterr().out


def test_misspelt_members_are_remarked_on_and_wrong_ones_are_not_placed_in_the_package(
    tmp_path, capsys
):
    from mirror_ppl.commands import check_domain

    text, file = FILE.read_text(), tmp_path / "almost.py"
    file.write_text(text.replace("    horizon = 8\n", "    horizon = 8\n    lastingg = ()\n"))
    assert command(check_domain, f"{file}:RoundTable") == 0
    said = "warning: lastingg is no member of worlds; perhaps you meant lasting"
    assert said in capsys.readouterr().out.splitlines()
    for name in ("round_table.py:RoundTable", "unlocking.py:Unlocking", "delivery.py:Delivery"):
        assert misspelt(type(get_domain(f"{FILE.parent}/{name}"))) == {}
    file.write_text(text.replace("def transition(self, state,", "def transition(self,"))
    assert command(check_domain, f"{file}:RoundTable") == 1
    said = capsys.readouterr().out
    assert "transition fails: TypeError: " in said and ".py, line" not in said


def test_memory_keeps_what_has_not_changed_and_what_lasts():
    from mirror_ppl.domains.memory import LastSeen

    table = load_world(WORLD)
    seen = torch.tensor([True, False])
    for lasting, known in (((), [False, False]), (("pot",), [True, False])):
        memory = LastSeen.nothing(table.modalities)
        for pot, mask in ((1.0, seen), (1.0, ~seen & False), (2.0, ~seen & False)):
            now = {"visual": torch.tensor([[pot], [3.0]])}
            memory = memory.after(table.modalities, lasting, now, {"visual": mask})
            if pot == 1.0:
                assert memory.items(table.modalities)["visual"].tolist() == [True, False]
        assert memory.items(table.modalities)["visual"].tolist() == known


def test_the_memory_of_the_page_keeps_what_moves():
    names = {"__name__": "page"}
    exec(FILE.read_text(), names)
    (block,) = re.findall(r"```python\n(@dataclass.*?)```", PAGE, re.DOTALL)
    exec(block, names)
    counted = names["Counted"]()
    assert faults_of(counted) == []
    for table, known in ((names["RoundTable"](), False), (counted, True)):
        knowledge = table.nothing_known(1)
        for pot, seen in ((1.0, True), (2.0, False)):
            now = {"visual": torch.tensor([[[pot], [3.0]]])}
            masks = {"visual": torch.tensor([[seen, False]])}
            knowledge = table.learn(knowledge, now, masks, lambda _, masks=masks: masks)
        assert table.known(knowledge)["visual"].tolist() == [[known, False]]


def test_people_with_the_sight_of_a_setting_have_no_oracle(gone_through, monkeypatch, capsys):
    from mirror_ppl.commands import assist, fit
    from mirror_ppl.commands import simulate as simulate_command
    from mirror_ppl.evaluation.learners import Group
    from mirror_ppl.evaluation.study import assistance_cells

    monkeypatch.chdir(gone_through)
    few = ["--people", "1", "--rounds", "3", "--out", "paper.nc"]
    assert command(simulate_command, "--domain", WORLD, *few) == 0
    fitted = ["--demos", "paper.nc", "--draws", "20", "--out", "paper"]
    assert command(fit, "--domain", WORLD, *fitted) == 0
    small = ["--posterior", "paper/posterior.nc", "--rounds", "1", "--draws", "4", "--jobs", "1"]
    capsys.readouterr()
    assert command(assist, "--domain", WORLD, *small, "--communicator", "oracle") == 2
    assert "thresholds of sight of their own" in capsys.readouterr().err
    for population, there in (("paper", False), ("diverse", True)):
        group = Group("round_table", "dark", population, 1, 0)
        cells = assistance_cells(group, (), (1,), 1, 4)
        assert ("oracle" in {cell.model for cell in cells}) == there


def test_worlds_of_the_same_name_are_distinguished(tmp_path):
    source = FILE.read_text()
    specs = []
    for horizon in (5, 9):
        (tmp_path / f"table{horizon}.py").write_text(
            source.replace("horizon = 8", f"horizon = {horizon}")
        )
        specs.append(f"{tmp_path / f'table{horizon}.py'}:RoundTable")
    assert [get_domain(spec).horizon for spec in (*specs, *specs)] == [5, 9, 5, 9]


def test_derived_classes_recompute_derived_attributes():
    wide = Modality("visual", ("pot", "puddle", "cat"), ("offset",), ("places",), (5.0,), 0.01)
    base = load_world(WORLD)
    more = world(modalities=(wide,), levels={"offset": range(-5, 6)}, reward_terms=("purr",))
    made = load_world(more)
    assert made.name == "changed"
    assert made.reach_bins == (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
    assert made.symbol_sizes == {"ego": 1, "visual": 11}
    assert made.counterparts == (None, None, None)
    assert base.reach_bins == (0.0, 1.0, 2.0, 3.0)
    assert type("Named", (more,), {"name": "mine"})().name == "mine"


def test_sentences_are_read_as_sentences():
    spoken = Modality(
        "verbal", ("pot",), ("side",), ("",), (1.0,), 0.03, utterances=(("left!", "right!"),)
    )
    visual = load_world(WORLD).modalities[0]
    talking = world(modalities=(visual, spoken))()
    assert talking.symbol_sizes["verbal"] == 2
    said = {
        "ego": torch.zeros(1),
        "visual": torch.zeros(2, 1),
        "verbal": torch.tensor([[1.0]]),
    }
    assert talking.symbols(said)["verbal"].tolist() == [[0.0, 1.0]]
    assert talking.describe(said, "verbal", "pot") == "right!"
    assert talking.nearest(said | {"verbal": torch.tensor([[0.6]])})["verbal"].tolist() == [[1.0]]


def test_a_robot_of_another_version_of_the_file_is_warned_of(gone_through, monkeypatch, tmp_path):
    from mirror_ppl.errors import StaleSelfModel
    from mirror_ppl.models.weights import load_self_model

    monkeypatch.chdir(gone_through)
    weights = gone_through / "runs" / "round_table_self_model.safetensors"
    get_domain(WORLD)
    load_self_model(weights)
    other = tmp_path / "round_table.py"
    other.write_text(FILE.read_text().replace("5.0 * ", "-5.0 * "))
    get_domain(f"{other}:RoundTable")
    with pytest.warns(StaleSelfModel, match="has changed since this self-model was trained"):
        load_self_model(weights)


def test_other_processes_know_the_version_of_the_file(monkeypatch):
    world = get_domain(WORLD)
    monkeypatch.setattr("inspect.getfile", None)  # a class that was sent has no file
    assert code_of(world) == hashlib.sha256(FILE.read_bytes()).hexdigest()


def test_people_are_played_with_the_robot_that_they_are_like(gone_through, monkeypatch, capsys):
    from mirror_ppl.commands import assist, fit
    from mirror_ppl.models.weights import load_self_model, save_self_model

    monkeypatch.chdir(gone_through)
    get_domain(WORLD)
    robot, card = load_self_model(gone_through / "runs" / "round_table_self_model.safetensors")
    with torch.no_grad():
        next(robot.parameters()).add_(0.01)
    save_self_model(robot, gone_through / "runs" / "another.safetensors", card)
    given = ["--domain", WORLD, "--self-model", "runs/another.safetensors"]
    few = ["--train-rounds", "2", "--draws", "64", "--out", "runs/another"]
    assert command(fit, *given, "--demos", "runs/table.nc", *few) == 0
    assert command(assist, *given, "--posterior", "runs/another/posterior.nc", "--rounds", "1") == 2
    assert "people were simulated with another self-model" in capsys.readouterr().err


def test_a_world_with_an_impossible_record_is_refused_in_a_line(tmp_path, capsys):
    from mirror_ppl.commands import check_domain

    file = tmp_path / "power.py"
    line = "    horizon = 8\n    record = Record(likelihood_power=0.0)\n"
    world = FILE.read_text().replace("    horizon = 8\n", line)
    file.write_text(f"from mirror_ppl.domains import Record\n{world}")
    assert command(check_domain, f"{file}:RoundTable") == 2
    error = capsys.readouterr().err
    assert "likelihood_power must be from 0.001 to 1, not 0.0" in error
    assert error.count("\n") == 1
    own = file.read_text().replace("likelihood_power=0.0", "consistency=8, value_error=0.1")
    file.write_text(own)
    assert command(check_domain, f"{file}:RoundTable") == 0
    said = "record: consistency 8, value_error 0.1, likelihood_power 1, sight_scale None"
    assert said in capsys.readouterr().out


def test_settings_are_looked_over(tmp_path, capsys):
    from mirror_ppl.commands import check_domain

    for line, message in (
        ('record = Record(training={"phasez": 3})', "training has phasez, expected some of"),
        ('record = Record(training={"phases": 0})', "phases must be at least 1, not 0"),
        ('record = Record(planning={"horizn": 3})', "planning has horizn"),
        ('record = Record(networks={"coder": 3})', "networks: "),
        ('record = Record(people="nowhere:PEOPLE")', 'people: there is no "nowhere:PEOPLE"'),
        ('record = Record(pictures="math:PICTURES")', 'pictures: there is no "math:PICTURES"'),
    ):
        file = tmp_path / "settings.py"
        world = FILE.read_text().replace("    horizon = 8\n", f"    horizon = 8\n    {line}\n")
        file.write_text(f"from mirror_ppl.domains import Record\n{world}")
        assert command(check_domain, f"{file}:RoundTable") == 1
        assert message in capsys.readouterr().out
