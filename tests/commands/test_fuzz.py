"""Damaged recordings, results and command lines, by the hundred: all refused in one line, or right.

The damage is that of `python -m benchmarks.fuzz`, which tries far more of it.
"""

import importlib

import numpy as np
import pytest
import torch
from example_person import DOMAIN, human, self_model, varied_draws
from hypothesis import given, settings
from hypothesis import strategies as st
from running import command

from benchmarks import _recording_cases as recordings
from benchmarks._command_lines import COMMANDS, line
from benchmarks._damage import BYTES
from benchmarks._damage_structure import OF_HDF5
from benchmarks._damage_weights import OF_WEIGHTS
from benchmarks._judging import fault_of, measured
from mirror_ppl import __main__
from mirror_ppl.arviz import az
from mirror_ppl.console import guarded
from mirror_ppl.errors import AssetError
from mirror_ppl.inference.results.export import in_units, netcdf_content
from mirror_ppl.inference.results.posterior_file import load_posterior
from mirror_ppl.models import HumanModel
from mirror_ppl.models.weights import fingerprint, load_self_model, shipped_weights
from mirror_ppl.training.guide_file import load_guide, shipped_guide

DOMAINS = "driving", "search_rescue", "bomb_defusal"
CASES = st.integers(0, 2**32)


def complaint(verdict):
    """What a test that fails has to say."""
    return f"{verdict.kind} {verdict.signature}: {verdict.damage}\n{verdict.detail}"


@pytest.mark.parametrize("how, number", [(recordings.CLASSIC, 150), (recordings.CHECKED, 8)])
def test_damaged_recordings_are_refused_in_a_line_or_right(how, number):
    @given(case=CASES)
    @settings(max_examples=number)
    def judged(case):
        verdict = recordings.judge_case(recordings.make(0, case, [how], recordings.SIMULATED))
        assert verdict.good, complaint(verdict)

    judged()


def loaders():
    """Files of weights that ship, and what reads them."""
    found = [
        (shipped_weights(name), lambda path, name=name: load_self_model(path, name)[0])
        for name in DOMAINS
    ]
    human = HumanModel(load_self_model(shipped_weights("driving"))[0])
    return [*found, (shipped_guide("driving"), lambda path: load_guide(path, human)[0])]


def test_damaged_weights_are_refused_in_a_line_or_equal(tmp_path):
    sources = loaders()
    expected = [read(path).state_dict() for path, read in sources]
    damages = {name: damage for kinds in (BYTES, OF_WEIGHTS) for name, damage in kinds.items()}
    path = tmp_path / "weights.safetensors"

    @given(which=st.integers(0, len(sources) - 1), name=st.sampled_from(list(damages)), seed=CASES)
    @settings(max_examples=60)
    def judged(which, name, seed):
        original, read = sources[which]
        path.write_bytes(damages[name](np.random.default_rng(seed), original.read_bytes()))
        outcome = measured(lambda: read(path))
        fault = fault_of(outcome)
        assert fault is None, f"{name} of {original.name}: {fault}"
        if outcome.error is not None:
            assert isinstance(outcome.error, AssetError), repr(outcome.error)
            return
        found = outcome.value.state_dict()
        assert found.keys() == expected[which].keys()
        for part, value in found.items():
            assert value.equal(expected[which][part]), f"{name} of {original.name}: {part}"

    judged()


def test_damaged_posteriors_are_refused_in_a_line_or_finite(tmp_path, generator):
    draws = varied_draws(9, generator)
    values = {name: value.numpy()[None] for name, value in in_units(DOMAIN, draws).items()}
    own = {"domain": DOMAIN.name, "domain_version": DOMAIN.version, "human_model": "HumanModel"}
    data = az.from_dict(
        posterior=values, coords={"person": ["ana"]}, dims={name: ["person"] for name in values}
    )
    data["posterior"].attrs |= own | {"self_model": fingerprint(self_model())}
    content = bytes(netcdf_content(data))
    path = tmp_path / "damaged.nc"

    @given(name=st.sampled_from([*BYTES, *OF_HDF5]), seed=CASES)
    @settings(max_examples=10)
    def judged(name, seed):
        random = np.random.default_rng(seed)
        damaged = BYTES[name](random, content) if name in BYTES else OF_HDF5[name](random, content)
        path.write_bytes(damaged if isinstance(damaged, bytes) else damaged[0])
        outcome = measured(lambda: load_posterior(path).draws(human()))
        fault = fault_of(outcome)
        assert fault is None, f"{name}: {fault}"
        found = outcome.value or {}
        assert all(value.isfinite().all() for value in found.values()), name
        assert name not in BYTES or not found or all(map(torch.equal, *values_of(found, draws)))

    judged()


def values_of(one, other):
    """Values of two dictionaries by name."""
    assert one.keys() == other.keys()
    return list(one.values()), [other[name] for name in one]


def test_odd_options_are_refused_in_a_line(monkeypatch, capsys, tmp_path):
    """As far as options alone tell: nothing is computed."""
    monkeypatch.chdir(tmp_path)
    modules = {
        name: importlib.import_module(f"mirror_ppl.commands.{name}") for name in COMMANDS if name
    }
    for module in modules.values():
        monkeypatch.setattr(module, "main", lambda options: 0)

    @given(seed=CASES)
    @settings(max_examples=100)
    def judged(seed):
        name, arguments = line(np.random.default_rng(seed))
        if name:
            status = command(modules[name], *arguments)
        else:
            status = guarded(lambda: __main__.main(arguments))
        said = capsys.readouterr().err.splitlines()
        assert status in (0, 2), arguments
        assert (status == 0) == (not said), said
        # Values that are not even of an option's type are refused by tyro, in a frame.
        usage = any(mark in "".join(said) for mark in ("───", "----", "error: "))
        assert not said or usage, said

    judged()
    assert not list(tmp_path.iterdir())
