"""What the commands share: start and end, progress, files, errors; and `python -m mirror_ppl`."""

import io
import pickle
import re
import signal
import subprocess
import sys
import textwrap
import warnings
from dataclasses import dataclass

import pytest
import torch

import mirror_ppl
from mirror_ppl import errors
from mirror_ppl.commands import COMMANDS
from mirror_ppl.console import guarded, run
from mirror_ppl.errors import MirrorError, UnknownNameError
from mirror_ppl.progress import Progress, Stages


def python(*args, **kwargs):
    return subprocess.run(
        [sys.executable, *args], capture_output=True, text=True, timeout=60, check=False, **kwargs
    )


# --- the package ------------------------------------------------------------------------------


def test_import_prints_nothing_and_loads_no_library():
    code = "import mirror_ppl, sys; assert not {'torch', 'pyro', 'rich', 'tyro'} & set(sys.modules)"
    done = python("-W", "error", "-c", code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("args", [(), ("--help",), ("-h",)])
def test_overview_lists_every_command(args):
    done = python("-m", "mirror_ppl", *args)
    assert (done.returncode, done.stderr) == (0, "")
    for name, purpose in COMMANDS.items():
        assert re.search(rf"python -m mirror_ppl\.{name} +{re.escape(purpose)}", done.stdout)


def test_version():
    done = python("-m", "mirror_ppl", "--version")
    assert (done.returncode, done.stdout) == (0, f"mirror_ppl {mirror_ppl.__version__}\n")


@pytest.mark.parametrize(
    ("args", "told"),
    [
        (("--nonsense",), "--nonsense"),
        (("fitt", "--out", "x"), 'perhaps you meant "fit"'),
        (("fit", "--nonsense"), "python -m mirror_ppl.fit --help"),
        (("--version", "more"), "more"),
    ],
)
def test_unknown_argument_is_one_line_and_status_2(args, told):
    done = python("-m", "mirror_ppl", *args)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert told in done.stderr


# --- errors -----------------------------------------------------------------------------------


def test_an_unknown_name_gives_the_known_ones_and_the_closest():
    error = UnknownNameError.of("domain", "Drivin", ["driving", "bomb"])
    expected = 'unknown domain "Drivin"; known: bomb, driving; perhaps you meant "driving"'
    assert str(error) == expected


def test_unknown_name_without_a_close_one():
    error = UnknownNameError.of("setting", "xyz", iter(["fog"]))
    assert str(error) == 'unknown setting "xyz"; known: fog'
    assert str(UnknownNameError.of("guide", "x", [])) == 'unknown guide "x"; known: none'


def test_every_error_is_a_mirror_error_that_survives_a_process_boundary():
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    kinds = [kind for kind in kinds if issubclass(kind, Exception)]
    kinds = [kind for kind in kinds if not issubclass(kind, Warning)]
    assert len(kinds) >= 7
    for kind in kinds:
        assert issubclass(kind, MirrorError)
        assert "aised" in kind.__doc__
    error = UnknownNameError.of("domain", "a", ["b"])
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (UnknownNameError, str(error))


# --- run --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Options:
    """Options of a command that only exists here."""

    steps: int = 3
    """How many steps."""
    domain: str = "driving"
    """Which domain."""

    def __post_init__(self):
        if self.steps < 0:
            raise ValueError(f"steps must be at least 0, not {self.steps}")
        if self.domain != "driving":
            raise UnknownNameError.of("domain", self.domain, ["driving"])


def start(main, *args):
    return run(Options, main, prog="toy", description="A toy.", args=args)


def test_warnings_of_the_package_are_lines_without_a_place():
    """Those of others are as ever; so are all after the command."""
    ours, others = (errors.MisspeltMember, "two\nlines \x1b"), (UserWarning, "theirs")
    usual = [warnings.formatwarning(text, kind, "a.py", 3) for kind, text in (ours, others)]

    def call():
        said = [warnings.formatwarning(text, kind, "a.py", 3) for kind, text in (ours, others)]
        assert said == ["warning: two lines \\x1b\n", usual[1]]
        return 0

    assert guarded(call) == 0
    assert warnings.formatwarning(ours[1], ours[0], "a.py", 3) == usual[0]


def test_run_passes_the_options_and_returns_the_status(capsys):
    seen = []
    assert start(seen.append, "--steps", "5") == 0
    assert seen == [Options(steps=5)]
    assert start(lambda options: 7) == 7
    assert capsys.readouterr().err == ""


def test_run_help(capsys):
    assert start(pytest.fail, "--help") == 0
    out = capsys.readouterr().out
    assert "A toy." in out
    assert "How many steps." in out


@pytest.mark.parametrize(
    ("args", "told"),
    [
        (("--stepz", "5"), "--steps"),
        (("--steps", "many"), "many"),
        (("--steps", "-1"), "steps must be at least 0, not -1"),
    ],
)
def test_run_argument_errors_end_with_status_2(args, told, capsys):
    assert start(pytest.fail, *args) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert told in captured.err


def test_run_mirror_error_is_one_line_and_status_2(capsys):
    def main(options):
        raise MirrorError("first [red]\nsecond")

    assert start(main) == 2
    assert capsys.readouterr().err == "error: first [red] second\n"


def test_run_mirror_error_of_the_options_is_one_line_too(capsys):
    assert start(pytest.fail, "--domain", "Driving") == 2
    expected = 'unknown domain "Driving"; known: driving; perhaps you meant "driving"'
    assert capsys.readouterr().err == f"error: {expected}\n"


def test_run_interrupted_is_one_line_and_status_130(capsys):
    def main(options):
        raise KeyboardInterrupt

    assert start(main) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_run_lets_mistakes_of_the_code_through():
    with pytest.raises(ZeroDivisionError):
        start(lambda options: 1 // 0)


@pytest.mark.parametrize(("environment", "expected"), [(None, 1), ("2", 2)])
def test_run_sets_the_threads_unless_the_environment_does(monkeypatch, environment, expected):
    if environment is None:
        monkeypatch.delenv("OMP_NUM_THREADS")
    else:
        monkeypatch.setenv("OMP_NUM_THREADS", environment)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        start(lambda options: None)
        assert torch.get_num_threads() == expected
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("lines", [1, 100_000], ids=["at the final flush", "while printing"])
def test_run_is_quiet_when_the_reader_goes_away(lines):
    code = f"""
        from dataclasses import dataclass
        from mirror_ppl.console import run

        @dataclass(frozen=True)
        class Options: pass

        def main(options):
            input()
            for _ in range({lines}): print("line")

        raise SystemExit(run(Options, main, prog="toy", description=""))
        """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    process.stdout.close()
    process.stdout = None
    _, stderr = process.communicate("\n", timeout=60)
    assert (process.returncode, stderr) == (128 + signal.SIGPIPE, "")


# --- progress ---------------------------------------------------------------------------------


@pytest.fixture
def clock(monkeypatch):
    """Time that passes only when it is told to: `clock[0] += 1`."""
    now = [1000.0]
    monkeypatch.setattr("mirror_ppl.progress.monotonic", lambda: now[0])
    return now


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_lines_are_plain_and_rare(clock):
    stream = io.StringIO()
    with Progress("fit", 300, interval=4, stream=stream) as progress:
        for step in range(1, 121):
            clock[0] += 8 / 120
            progress.update(step, f"loss {step / 10:.1f}")
    assert stream.getvalue().splitlines() == [
        "fit: 60/300 loss 6.0, 4 s, 16 s left",
        "fit: 120/300 loss 12.0, 8 s, 12 s left",
    ]


def test_progress_ends_with_the_last_state_once(clock):
    stream = io.StringIO()
    with Progress("fit", 2, stream=stream) as progress:
        progress.advance()
        progress.advance("loss 1.5")
        clock[0] += 125
    assert stream.getvalue() == "fit: 2/2 loss 1.5, 2 min 5 s\n"


def test_a_stage_that_is_resumed_says_so_and_reckons_by_what_this_run_did(clock, capsys):
    """The first of two stages is resumed."""
    with Stages() as stages:
        stages.report("infer", 4, 6, "people")
        clock[0] += 600
        stages.report("infer", 5, 6, "people")
        stages.report("describe", 0, 6, "people")
    assert capsys.readouterr().err.splitlines() == [
        "infer: 4/6 done before, 0 s",
        "infer: 5/6 people, 10 min 0 s, 10 min 0 s left",
        "describe: 0/6 people, 0 s",
    ]


def test_progress_of_resumed_work_reckons_by_what_this_run_did(clock):
    """One of six steps takes ten minutes, after four that were done before."""
    stream = io.StringIO()
    with Progress("evaluate", 6, stream=stream) as progress:
        clock[0] += 5
        progress.resume(4)
        assert progress.left is None
        clock[0] += 600
        progress.update(5, "mirror")
        clock[0] += 60
        assert progress.left == 540
        clock[0] += 1000
        assert progress.left == 0
        progress.update(6, "bc")
    assert stream.getvalue().splitlines() == [
        "evaluate: 4/6 done before, 0 s",
        "evaluate: 5/6 mirror, 10 min 0 s, 10 min 0 s left",
        "evaluate: 6/6 bc, 27 min 40 s",
    ]


def test_progress_on_a_terminal_shows_what_is_left_of_slow_steps(monkeypatch, clock):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    stream = Terminal()
    with Progress("evaluate", 3, stream=stream) as progress:
        clock[0] += 600
        progress.update(1)
    assert "20 min 0 s left" in stream.getvalue()


def test_progress_shows_how_far_failed_work_came(clock):
    stream = io.StringIO()
    with pytest.raises(ZeroDivisionError), Progress("fit", stream=stream, done=10) as progress:
        progress.advance("loss 3")
        raise ZeroDivisionError
    assert stream.getvalue() == "fit: 11 loss 3, 0 s\n"


def test_progress_without_a_step_or_when_quiet_shows_nothing():
    stream = io.StringIO()
    with Progress("fit", 3, stream=stream):
        pass
    with Progress("fit", 3, stream=stream, quiet=True) as progress:
        progress.update(3)
    assert stream.getvalue() == ""
    assert progress.done == 3


def test_progress_goes_to_stderr(capsys):
    with Progress("fit", 1) as progress:
        progress.advance()
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == "fit: 1/1, 0 s\n"


def test_progress_on_a_terminal_is_a_bar(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    stream = Terminal()
    with Progress("fit", 3, stream=stream) as progress:
        progress.update(3, "loss [1]")
        print("a result")
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue())
    assert "━" in shown
    assert "3/3" in shown
    assert "loss [1]" in shown
    # stdout is no terminal here: what is printed must not be mixed into the bar's stream.
    assert capsys.readouterr().out == "a result\n"


def test_progress_on_a_terminal_that_cannot_redraw_is_plain(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    stream = Terminal()
    with Progress("fit", 3, stream=stream) as progress:
        progress.update(3)
    assert stream.getvalue() == "fit: 3/3, 0 s\n"
