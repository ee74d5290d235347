"""Command lines put together of good, bad and extreme values, from the commands' own options."""

from __future__ import annotations

import dataclasses
import importlib
import os
import shutil
import typing
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks._damage import BYTES, Random
from benchmarks._damage_datasets import STRANGE
from mirror_ppl.models.weights import shipped_weights

COMMANDS = ("fit", "assist", "calibrate", "compare", "evaluate", "train", "simulate", "")
"""The commands that are tried; the last is `python -m mirror_ppl` itself."""
QUICK_FIT = ("--demos", "driving.nc", "--train-rounds", "1", "--draws", "10", "--explore", "0")
SMALL: dict[str, tuple[tuple[str, ...], ...]] = {
    "fit": (
        (*QUICK_FIT, "--out", "out"),
        (*QUICK_FIT, "--out", "out", "--guide", "svi", "--steps", "2"),
        (*QUICK_FIT, "--out", "out", "--prior-from", "pooled.nc"),
        (*QUICK_FIT, "--out", "out", "--guide", "amortized"),
        ("--train-rounds", "1", "--draws", "2", "--explore", "0", "--out", "out"),
    ),
    "assist": (
        ("--posterior", "posterior.nc", "--rounds", "1", "--people", "1", "--draws", "2")
        + ("--communicator", "none", "--jobs", "1", "--json", "out/a.json"),
        ("--posterior", "posterior.nc", "--rounds", "1", "--people", "1", "--draws", "2")
        + ("--communicator", "none", "all", "--jobs", "1", "--log", "a.log"),
    ),
    "calibrate": (
        ("--people", "2", "--rounds", "1", "--draws", "5", "--jobs", "1", "--out", "out"),
    ),
    "compare": (
        ("posterior.nc", "pooled.nc", "--json", "out/c.json"),
        ("posterior.nc", "pooled.nc", "--figure", "c.png", "--by", "heldout"),
    ),
    "evaluate": (
        ("prediction", "--people", "1", "--seeds", "1", "--models", "logistic", "--rounds", "1")
        + ("--jobs", "1", "--out", "out"),
        ("assistance", "--people", "1", "--seeds", "1", "--models", "none", "--rounds", "1")
        + ("--jobs", "1", "--out", "out", "--played", "1", "--draws", "2"),
    ),
    "train": (
        ("--phases", "1", "--steps", "1", "--out", "out/w.safetensors"),
        ("--what", "guide", "--people", "10", "--out", "out/g.safetensors"),
        ("--card", "weights.safetensors"),
    ),
    "simulate": (
        ("--people", "1", "--rounds", "1", "--out", "out/people.nc"),
        ("--people", "2", "--rounds", "2", "--out", "people.nc", "--told", "0.1"),
    ),
    "": ((),),
}
"""Commands that end soon, or are cut; their options come before the odd ones."""
WHOLE = ("-1", "0", "1", "2", "3", "2147483648", "9223372036854775808", "1" + "0" * 30)
WHOLE += ("1.5", "nan", "", "abc", "\N{ARABIC-INDIC DIGIT THREE}", "1_0", "+2", "0x10")
REAL = ("-1", "0", "0.5", "1", "nan", "inf", "-inf", "1e308", "1e-308", "", "abc", "1,5")
JOBS = ("1", "2", "-1", "0", "-2", "x", "", "1.5")
"""Numbers of processes that this machine survives."""
FILES = (
    *("driving.nc", "posterior.nc", "pooled.nc", "weights.safetensors", "damaged.nc"),
    *("damaged-posterior.nc", "damaged.safetensors", "empty", "text.txt", "folder", "fifo"),
    *("/dev/zero", "/dev/null", "missing.nc", "missing/file.nc", "text.txt/inside", "loop"),
    *("", ".", "/", "~", "x" * 300, "new\nline", "$\\foo$", "[/]", "\N{PARTY POPPER}.nc", "locked"),
    *("/proc/self/mem", "out"),
)
OUTPUTS = (
    *("out", "out/a/b/c", "folder", "text.txt", "text.txt/inside", "/dev/full", "/dev/null"),
    *("/proc/nothing/x", "", ".", "/", "x" * 300, "driving.nc", "posterior.nc", "fifo", "loop"),
    *("a b", "new\nline", "[/]", "$\\foo$", "\N{PARTY POPPER}", "out.nc", "out.png", "out.svg"),
    *("out.xyz", "full/x.json", "locked/x.nc", "-", "weights.safetensors", "/dev/stdout"),
)
NAMES = {
    "domain": ("driving", "search_rescue", "bomb_defusal", "Driving", "drivin"),
    "setting": ("clear", "fog", "smoke", "labelled", "unlabelled", "foggy"),
    "population": ("paper", "diverse", "papers"),
    "guide": ("importance", "exact", "amortized", "svi", "nuts", "exakt"),
    "pooling": ("none", "partial", "full"),
    "device": ("cpu", "cuda", "cuda:0", "cuda:99", "gpu", "meta", "cpu:7", "mps"),
    "human_model": (
        *("one-radius", "per-item", "policy-only", "mirror", "model.py:Person", "model.py"),
        *("missing.py:Person", "wrong.py:Person", "raises.py:Person", "ends.py:Person", ":", "a:b"),
        *("folder:Person", "text.txt:Person", "model.py:1", "model.py:Missing"),
    ),
    "what": ("self-model", "guide", "everything"),
    "speech": ("words", "gpt2", "none"),
    "sizes": ("shipped", "paper", "large"),
    "kl_measure": ("kl", "squared", "l2"),
    "by": ("loo", "heldout", "waic"),
    "communicator": ("mirror", "none", "all", "random", "oracle", "mirror-kl", "everybody"),
    "models": ("logistic", "mirror", "bc", "none", "all", "oracle", "nobody", "model.py:Person"),
    "study": ("prediction", "assistance", "relevance", "everything"),
    "scheduler": ("tcp://127.0.0.1:9", "nonsense", "", " ", "tcp://"),
    "labels": ("a", "b", "a a", "[/]", ""),
}
IS_OUTPUT = ("out", "json", "log", "figure")
GARBAGE = (("--nonsense",), ("--help",), ("--",), ("stray",), ("--seed",), ("-h",), ("--out",))
OF_PROGRAM = ("fit", "--version", "--help", "-h", "", "nonsense", "\N{SNOWMAN}", "--", "[/]")


def line(random: Random) -> tuple[str, list[str]]:
    """A command, and its arguments."""
    command = str(random.choice(COMMANDS, p=[0.25, 0.15, 0.1, 0.13, 0.1, 0.12, 0.13, 0.02]))
    if not command:
        return command, [str(one) for one in random.choice(OF_PROGRAM, int(random.integers(3)))]
    small = SMALL[command][int(random.integers(len(SMALL[command])))]
    arguments, options = (
        list(small),
        importlib.import_module(f"mirror_ppl.commands.{command}").Options,
    )
    parts = {field.name: field for field in dataclasses.fields(options)}
    kinds = typing.get_type_hints(options)
    for name in random.choice(
        list(parts), int(random.choice([0, 1, 2, 3], p=[0.08, 0.5, 0.3, 0.12]))
    ):
        values = _values(random, str(name), str(kinds[str(name)]))
        positional = "Positional" in str(kinds[str(name)]) or name in ("posteriors", "study")
        arguments = _with(arguments, str(name), values, positional)
    if random.random() < 0.05:
        arguments += GARBAGE[int(random.integers(len(GARBAGE)))]
    return command, arguments


def _with(arguments: list[str], name: str, values: Sequence[str], positional: bool) -> list[str]:
    """Arguments with another value of an option."""
    if positional:
        named = next((at for at, word in enumerate(arguments) if word.startswith("--")), 0)
        return [*values, *arguments[named:]]
    flag = f"--{name.replace('_', '-')}"
    if flag in arguments:
        start = arguments.index(flag)
        end = start + 1
        while end < len(arguments) and not arguments[end].startswith("--"):
            end += 1
        arguments = arguments[:start] + arguments[end:]
    # One word with the value where that begins with a dash.
    if len(values) == 1 and values[0].startswith("-"):
        return [*arguments, f"{flag}={values[0]}"]
    return [*arguments, flag, *values]


def _values(random: Random, name: str, kind: str) -> list[str]:
    number = int(random.choice([0, 1, 2, 3])) if "tuple" in kind else 1
    return [_value(random, name, kind) for _ in range(number)]


def _value(random: Random, name: str, kind: str) -> str:
    if name == "jobs":
        return str(random.choice(JOBS))
    if "Path" in kind:
        return _pick(random, OUTPUTS if name in IS_OUTPUT else FILES)
    if "float" in kind:
        return str(random.choice(REAL))
    if "int" in kind and "str" not in kind:
        return str(random.choice(WHOLE))
    if random.random() < 0.2:
        return _pick(random, [text for text in STRANGE if "\0" not in text and text != "\ud800"])
    return _pick(random, NAMES.get(name, ("", "nonsense")))


def _pick(random: Random, values: Sequence[str]) -> str:
    # `random.choice` would make an array of them, which cuts what ends in NUL.
    return values[int(random.integers(len(values)))]


def prepare(folder: Path, sources: Path) -> None:
    """A folder with everything that command lines name."""
    random = np.random.default_rng(0)
    folder.mkdir(parents=True)
    shutil.copy(sources / "driving.nc", folder / "driving.nc")
    shutil.copy(sources / "driving" / "posterior.nc", folder / "posterior.nc")
    shutil.copy(sources / "pooled" / "posterior.nc", folder / "pooled.nc")
    shutil.copy(shipped_weights("driving"), folder / "weights.safetensors")
    for name, damaged in (
        ("driving.nc", "damaged.nc"),
        ("posterior.nc", "damaged-posterior.nc"),
        ("weights.safetensors", "damaged.safetensors"),
    ):
        content = (folder / name).read_bytes()
        (folder / damaged).write_bytes(BYTES["truncated"](random, content))
    (folder / "empty").touch()
    (folder / "text.txt").write_text("some text\n")
    (folder / "folder").mkdir()
    (folder / "folder" / "kept.txt").write_text("kept\n")
    (folder / "loop").symlink_to("loop")
    (folder / "full").symlink_to("/dev/full")
    locked = folder / "locked"
    locked.mkdir(mode=0o000)
    os.mkfifo(folder / "fifo")
    own = "from mirror_ppl.models.human import HumanModel\n\n\nclass Person(HumanModel):\n    "
    models = {
        "model.py": f"{own}pass\n",
        "wrong.py": f"{own}def act(self): return 1\n",
        "raises.py": "raise ValueError('two\\nlines')\n",
        "ends.py": "raise SystemExit(0)\n",
    }
    for name, text in models.items():
        (folder / name).write_text(text)
