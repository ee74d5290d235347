"""The console script `mirror-ppl`, and what `--help` says."""

import functools
import importlib
import re
import shlex
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import pytest
import tyro
from paths import ROOT
from running import command
from tyro.conf import Positional

from mirror_ppl import __main__
from mirror_ppl.__main__ import script
from mirror_ppl.commands import COMMANDS, assist, calibrate, evaluate, fit, simulate, train
from mirror_ppl.console import run
from mirror_ppl.option_help import WORDS, texts_of

MODULES = {name: importlib.import_module(f"mirror_ppl.commands.{name}") for name in COMMANDS}
every_command = pytest.mark.parametrize("name", COMMANDS)


@pytest.fixture
def called(forks):
    """A function that runs the console script with arguments, in a process of its own."""
    return functools.partial(forks.run, "mirror_ppl.__main__:script")


def words_of(text):
    """A text's words, without the frame around options."""
    return " ".join(re.sub("[│╭╮╰╯─]", " ", text).split())


# --- the console script -----------------------------------------------------------------------


def test_the_console_script_is_the_packages():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert list(scripts) == ["mirror-ppl"]
    module, _, function = scripts["mirror-ppl"].partition(":")
    assert getattr(importlib.import_module(module), function) is script


def test_the_console_script_lists_its_commands(called):
    done = called()
    assert (done.returncode, done.stderr) == (0, "")
    for name, purpose in COMMANDS.items():
        assert re.search(rf"mirror-ppl {name.replace('_', '-')} +{purpose}", done.stdout)
    assert called("--version").stdout.startswith("mirror_ppl ")


@every_command
def test_each_command_of_the_script_explains_itself(called, name):
    spoken = f"mirror-ppl {name.replace('_', '-')}"
    done = called(*shlex.split(spoken)[1:], "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"usage: {spoken} [-h]")
    for example in MODULES[name].EXAMPLES.values():
        assert f"    {spoken} {example}\n" in done.stdout


def test_the_script_does_what_the_module_does(called, tmp_path):
    path = tmp_path / "people.nc"
    done = called("simulate", "--out", str(path), "--people", "1", "--rounds", "2")
    assert done.returncode == 0
    assert done.stdout.startswith(f"{path}: driving, fog, population paper\n")
    assert path.is_file()


def test_the_status_of_the_script_is_the_commands(called, tmp_path):
    (tmp_path / "world.py").write_text("class Mine: pass\n")
    done = called("check-domain", f"{tmp_path}/world.py:Mine")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    wrong = called("fit", "--step", "3")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert wrong.stderr.endswith("see mirror-ppl fit --help\n")
    known = ", ".join(sorted(name.replace("_", "-") for name in COMMANDS))
    assert called("fly").stderr == f'error: unknown command "fly"; known: {known}\n'


# --- help -------------------------------------------------------------------------------------


@every_command
def test_help_has_the_text_of_every_option_and_no_noise(name, capsys):
    module = MODULES[name]
    assert command(module, "--help") == 0
    out = words_of(capsys.readouterr().out)
    assert words_of(module.DESCRIPTION) in out
    texts = texts_of(module.Options)
    for field in fields(module.Options):
        assert texts[field.name] in out
        word = WORDS.get(field.name, "")
        if word.startswith("{"):
            assert all(one in texts[field.name] for one in word.strip("{}").split(","))
    assert "None" not in out
    assert "(default: )" not in out
    assert not re.search(r"\b(STR|INT|FLOAT)\b", out)


def test_options_show_their_word_text_and_default(capsys):
    def help_of(kind):
        assert run(kind, lambda options: 0, prog="x", description="What it does.", args=["-h"]) == 0
        return words_of(capsys.readouterr().out)

    @dataclass(frozen=True)
    class Options:
        """Some."""

        study: Positional[Literal["a", "b"]]
        """What to do."""
        setting: str | None = None
        """Which,
        in two lines."""
        out: Path = Path("runs/x")
        """Where to."""
        rounds: tuple[int, ...] = ()
        """How many."""
        seed: int = 0
        share: float | None = None

    shown = help_of(Options)
    for part in (
        "usage: x [-h] [OPTIONS] {a,b} What it does.",
        "{a,b} What to do. (required)",
        "--setting SETTING Which, in two lines. --out",
        "--out PATH Where to. (default: runs/x)",
        "--rounds INTEGER ... How many. --seed",
        "--seed INTEGER (default: 0)",
        "--share NUMBER",
    ):
        assert part in shown
    assert "examples" not in shown


@pytest.mark.parametrize("columns", [50, 80, 200])
def test_help_fits_the_terminal(columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    module = MODULES["compare"]
    assert command(module, "--help") == 0
    shown = capsys.readouterr().out.split("\n\n")[1]
    assert max(map(len, shown.splitlines())) <= min(columns, 100)
    assert words_of(module.DESCRIPTION) == words_of(shown)


@every_command
def test_examples_are_real(name):
    module = MODULES[name]
    assert 1 <= len(module.EXAMPLES) <= 2
    for example in module.EXAMPLES.values():
        args = shlex.split(example)
        assert tyro.cli(module.Options, args=args)
        for word in args:
            file = word.partition(":")[0]
            assert not file.startswith("docs/") or (ROOT / file).is_file()


@pytest.mark.parametrize("module", [assist, calibrate, evaluate, fit, train, simulate])
def test_help_explains_every_option(module, capsys):
    assert command(module, "--help") == 0
    out = " ".join(capsys.readouterr().out.split())
    for name in module.Options.__dataclass_fields__:
        if (module, name) != (evaluate, "study"):  # which is no option
            assert f"--{name.replace('_', '-')} " in out
    assert module.DESCRIPTION.split(".")[0].split("\n")[0].split(",")[0] in out
    assert f"python -m {module.__name__.replace('.commands', '')}" == module.PROGRAM


def test_overview_lists_every_command_there_is(capsys):
    assert __main__.main([]) == 0
    out = capsys.readouterr().out
    package = Path(fit.__file__).parent
    commands = {path.stem for path in package.glob("*.py")} - {"__init__"}
    assert set(__main__.COMMANDS) == commands
    assert all((package.parent / f"{name}.py").is_file() for name in commands)
    for name in __main__.COMMANDS:
        assert f"python -m mirror_ppl.{name}" in out
