"""Files of recordings: what comes back, what is refused, and what the documentation promises."""

import gc
import re
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import xarray as xr
from example_recordings import NAN, RAGGED, fields
from hypothesis import given, settings
from hypothesis import strategies as st
from paths import DOCS

import mirror_ppl.data
from mirror_ppl.data import (
    Demonstrations,
    asset_path,
    from_dataset,
    load_demonstrations,
    save_demonstrations,
    schema,
    to_dataset,
)
from mirror_ppl.data.files import _flags
from mirror_ppl.domains import get_domain
from mirror_ppl.errors import AssetError, DemonstrationsError, OutputError, UnknownNameError

DRIVING = get_domain("driving")
OPTIONAL = ("told", "rewards", "scenarios", "truth", "action_entropy", "provenance")


@pytest.fixture
def ragged():
    return Demonstrations(**fields(RAGGED))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "recordings.nc"


def test_a_file_gives_back_exactly_what_was_saved(ragged, path):
    assert save_demonstrations(path, ragged) == path
    loaded = load_demonstrations(path)
    assert loaded.equals(ragged)
    assert loaded.provenance == {"command": "test", "seed": 3, "temperature": 0.1}
    assert load_demonstrations(str(path), "driving", "fog").equals(ragged)
    first = path.read_bytes()
    save_demonstrations(path, loaded)
    assert path.read_bytes() == first


def test_a_file_without_optional_parts(path):
    required = {name: value for name, value in fields(RAGGED).items() if name not in OPTIONAL}
    made = Demonstrations(**required)
    save_demonstrations(path, made)
    assert load_demonstrations(path).equals(made)


@given(
    lengths=st.lists(st.lists(st.integers(1, 6), max_size=4), min_size=1, max_size=4),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=8)
def test_rounds_and_people_of_any_number_survive_a_file(tmp_path_factory, lengths, seed):
    made = Demonstrations(**fields(lengths, seed=seed))
    path = tmp_path_factory.mktemp("any") / "recordings.nc"
    save_demonstrations(path, made)
    loaded = load_demonstrations(path)
    assert loaded.equals(made)
    assert loaded.mask.sum((1, 2)).tolist() == [sum(rounds) for rounds in lengths]


def test_double_precision_survives_where_it_is_needed(path):
    given_fields = fields(RAGGED)
    torch.set_default_dtype(torch.float64)
    try:
        given_fields["ego"] = given_fields["ego"].double() + 1e-12
        made = Demonstrations(**given_fields)
        save_demonstrations(path, made)
        assert load_demonstrations(path).equals(made)
        dataset = to_dataset(made)
        assert (dataset.ego.dtype, dataset.visual.dtype) == (np.float64, np.float32)
    finally:
        torch.set_default_dtype(torch.float32)


def test_a_file_explains_itself(ragged, path):
    save_demonstrations(path, ragged)
    with xr.open_dataset(path, engine="h5netcdf") as dataset:
        assert dataset.action.dims == ("person", "round", "step")
        assert dataset.visual.dims == ("person", "round", "time", "visual_item", "visual_feature")
        assert dataset.person.values.tolist() == ["a", "b", "c"]
        assert tuple(dataset.verbal_item.values) == DRIVING.modalities[1].items
        assert tuple(dataset.verbal_feature.values) == DRIVING.modalities[1].features
        assert dataset.verbal.attrs["units"] == "cells, lanes, cells/step"
        assert dataset.action.attrs["flag_meanings"] == "stay switch"
        assert dataset.action.attrs["flag_values"].tolist() == [0, 1]
        scenario = dataset.scenario.attrs
        assert len(scenario["flag_meanings"].split()) == len(scenario["flag_values"]) == 8
        for name, variable in dataset.data_vars.items():
            assert variable.attrs["units"] and variable.attrs["long_name"], name
        for name in ("action", "length", "round_count", "scenario", "told_visual"):
            assert dataset[name].dtype == np.int8
        assert dataset.attrs == {
            "title": "Demonstrations: driving, fog",
            "format": "mirror_ppl demonstrations",
            "format_version": "1",
            "domain": "driving",
            "domain_version": "1",
            "setting": "fog",
            "command": "test",
            "seed": 3,
            "temperature": 0.1,
        }


def test_other_peoples_datasets_may_differ_in_form(ragged, path):
    dataset = to_dataset(ragged)
    shuffled = dataset.isel(visual_item=[2, 0, 3, 1], verbal_feature=[1, 2, 0])
    other = shuffled.transpose(..., "time", "step", "round", "person")
    other = other.assign(action=other.action.astype(float).where(other.action >= 0))  # nan padding
    other = other.assign(length=other.length.where(other.length > 0), gaze=("person", [1, 2, 3]))
    other.to_netcdf(path, engine="h5netcdf", encoding={"scenario": {"dtype": "int64"}})
    assert load_demonstrations(path).equals(ragged)
    plain = dataset.drop_vars(list(dataset.coords))
    assert from_dataset(plain).people == ("0", "1", "2")
    assert from_dataset(plain.assign_coords(person=["a", "b", "c"])).equals(ragged)
    with pytest.raises(
        DemonstrationsError, match="visual_item has 0, 1, 2, 3, expected front-left"
    ):
        from_dataset(plain.assign_coords(visual_item=range(4)))


def test_netcdf3_is_understood(ragged, path):
    to_dataset(ragged).to_netcdf(path, engine="scipy")
    assert path.read_bytes().startswith(b"CDF")
    assert load_demonstrations(path).equals(ragged)


def test_units_of_time_do_not_turn_numbers_into_dates(ragged, path):
    dataset = to_dataset(ragged)
    dataset.reward.attrs["units"] = "seconds"
    dataset.to_netcdf(path, engine="h5netcdf")
    assert load_demonstrations(path).equals(ragged)


def test_rounds_of_equal_length_need_neither_length_nor_count(path):
    made = Demonstrations(**fields([[3, 3], [3, 3]]))
    dataset = to_dataset(made)
    assert from_dataset(dataset.drop_vars(["length", "round_count"])).equals(made)
    assert from_dataset(dataset.drop_vars("round_count")).equals(made)
    fewer = Demonstrations(**fields([[3, 3], [3]]))
    assert from_dataset(to_dataset(fewer).drop_vars("length")).equals(fewer)


def test_domain_and_setting_may_come_from_the_command(ragged, path):
    dataset = to_dataset(ragged)
    del dataset.attrs["domain"], dataset.attrs["setting"]
    assert from_dataset(dataset, "driving", "fog").equals(ragged)
    with pytest.raises(DemonstrationsError, match="^attribute domain is missing$"):
        from_dataset(dataset)
    with pytest.raises(DemonstrationsError, match="^attribute setting is missing$"):
        from_dataset(dataset, "driving")
    save_demonstrations(path, ragged)
    with pytest.raises(DemonstrationsError, match="attribute setting is 'fog', expected 'clear'"):
        load_demonstrations(path, "driving", "clear")
    with pytest.raises(UnknownNameError, match='unknown domain "boats"'):
        load_demonstrations(path, "boats")
    with pytest.raises(UnknownNameError, match='unknown setting "rain"'):
        load_demonstrations(path, "driving", "rain")


def renamed(**attributes):
    return lambda dataset: dataset.assign_attrs(attributes)


def changed(name, index, value):
    def change(dataset):
        values = dataset[name].values.astype(float)
        values[index] = value
        return dataset.assign({name: (dataset[name].dims, values)})

    return change


BAD_DATASETS = {
    "another version": (
        renamed(format_version="2"),
        "attribute format_version is '2', expected '1'",
    ),
    "no format": (
        lambda dataset: dataset.drop_attrs(),
        "attribute format is missing, expected 'mirror_ppl demonstrations'",
    ),
    "unknown domain": (
        renamed(domain="boats"),
        'unknown domain "boats"; known: bomb_defusal, driving, highway, search_rescue; '
        "a world of your own is path/to/file.py:Class (--domain, mirror_ppl.add_domain)",
    ),
    "unknown setting": (
        renamed(setting="rain"),
        'unknown setting "rain" in driving; known: clear, fog',
    ),
    "no actions": (
        lambda dataset: dataset.drop_vars("action"),
        "the variable action is missing",
    ),
    "no modality": (
        lambda dataset: dataset.drop_vars("verbal"),
        "the variable verbal is missing",
    ),
    "wrong dimensions": (
        lambda dataset: dataset.assign(action=dataset.action.rename(step="moment")),
        "action has the dimensions person, round, moment, expected person, round, step",
    ),
    "no person": (
        lambda dataset: dataset.isel(person=0),
        "round_count has the dimensions none, expected person",
    ),
    "wrong shape": (
        lambda dataset: dataset.isel(time=slice(4)),
        "ego has shape (3, 3, 4, 1), expected (3, 3, 5, 1) "
        "(person 3, round 3, time 5, ego_feature 1), as there are 4 actions a round",
    ),
    "too few items": (
        lambda dataset: dataset.isel(visual_item=slice(3)),
        "visual_item has front-left, front-right, rear-left, "
        "expected front-left, front-right, rear-left, rear-right",
    ),
    "text": (
        lambda dataset: dataset.assign(action=dataset.action.astype(str)),
        "action has the dtype <U2, expected numbers",
    ),
    "told through an unknown modality": (
        lambda dataset: dataset.assign(told_visaul=dataset.told_visual),
        "unknown variable told_visaul, expected told_visual, told_verbal",
    ),
    "other order of actions": (
        lambda dataset: dataset.assign(
            action=dataset.action.assign_attrs(flag_meanings="switch stay")
        ),
        "flag_meanings of action are 'switch stay', expected 'stay switch'",
    ),
    "another version of the world": (
        renamed(domain_version="0"),
        "the recordings are of version 0 of driving, expected 1; rounds of another version may "
        "mean something else",
    ),
    "other units": (
        lambda dataset: dataset.assign(visual=dataset.visual.assign_attrs(units="m, lanes")),
        "units of visual are 'm, lanes', expected 'cells, lanes'",
    ),
    "steps backwards": (
        lambda dataset: dataset.assign_coords(step=[3, 2, 1, 0]),
        "the coordinate step does not increase",
    ),
    "nan inside a round": (
        changed("verbal", (0, 0, 3, 1, 2), NAN),
        "person 'a', round 0, time 3: verbal of front-right, relative_speed is nan, "
        "expected a finite number",
    ),
    "action out of range": (
        changed("action", (0, 1, 0), 2),
        "person 'a', round 1, step 0: action is 2, "
        "expected a whole number from 0 to 1 (stay, switch)",
    ),
    "action absent inside a round": (
        changed("action", (0, 1, 0), NAN),
        "person 'a', round 1, step 0: action is nan, "
        "expected a whole number from 0 to 1 (stay, switch); "
        "if the round is padding, round_count has to be the person's number of rounds",
    ),
    "round of length zero": (
        changed("length", (2, 2), 0),
        "person 'c', round 2: length is 0, expected at least 1 (padding begins at round_count)",
    ),
    "ids twice": (
        lambda dataset: dataset.assign_coords(person=["a", "b", "b"]),
        "two people have the id 'b', expected unique ids",
    ),
}


@pytest.mark.parametrize(("change", "message"), BAD_DATASETS.values(), ids=BAD_DATASETS.keys())
def test_bad_files_are_refused_in_one_line_that_names_them(ragged, path, change, message):
    change(to_dataset(ragged)).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(DemonstrationsError) as error:
        load_demonstrations(path)
    assert str(error.value) == f"{path}: {message}"


def test_files_from_before_versions_were_kept_are_read(ragged):
    dataset = to_dataset(ragged)
    del dataset.attrs["domain_version"]
    del dataset.visual.attrs["units"]
    assert from_dataset(dataset.assign_coords(step=[0, 2, 3, 7])).equals(ragged)


def test_many_actions_have_flags_of_their_own():
    found = _flags(tuple(f"action {number}" for number in range(200)))
    assert found["flag_values"].tolist() == list(range(200))


def test_a_posterior_is_not_recordings(path):
    xr.Dataset({"lapse": ("draw", [0.1])}).to_netcdf(path, group="posterior", engine="h5netcdf")
    with pytest.raises(DemonstrationsError, match=f"{path} is a posterior, not recordings"):
        load_demonstrations(path)


def test_files_that_cannot_be_read(ragged, path, tmp_path):
    with pytest.raises(DemonstrationsError, match="recordings.nc: there is no such file"):
        load_demonstrations(path)
    with pytest.raises(DemonstrationsError, match="is not a regular file"):
        load_demonstrations(tmp_path)
    for content in (b"", b"person,round\n"):
        path.write_bytes(content)
        with pytest.raises(DemonstrationsError, match="recordings.nc: is not a netCDF file$"):
            load_demonstrations(path)
    # A netCDF file of something else.
    xr.Dataset({"x": ("y", [1.0])}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(DemonstrationsError, match="attribute format is missing"):
        load_demonstrations(path)


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
@pytest.mark.parametrize("part", [0.01, 0.5, 0.9, 0.999])
def test_truncated_files_are_refused(ragged, path, engine, part):
    if engine == "scipy":
        to_dataset(ragged).to_netcdf(path, engine=engine)
    else:
        save_demonstrations(path, ragged)
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(
        DemonstrationsError, match="recordings.nc: is truncated or damaged"
    ) as error:
        load_demonstrations(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("damage", ["values", "header"])
def test_damage_is_noticed_and_reported_in_one_place(path, damage, capfd):
    save_demonstrations(path, Demonstrations(**fields([[30] * 30])))
    content = bytearray(path.read_bytes())
    if damage == "values":
        with h5py.File(path) as file:
            chunk = file["verbal"].id.get_chunk_info(0)
        content[chunk.byte_offset + chunk.size // 2] ^= 1
    else:
        content[content.index(b"OHDR") + 6] ^= 1  # the header of the root group
    path.write_bytes(content)
    with pytest.raises(DemonstrationsError, match="is truncated or damaged"):
        load_demonstrations(path)
    gc.collect()  # destructors, too, have nothing to say
    assert capfd.readouterr() == ("", "")


def test_a_file_is_written_whole_or_not_at_all(ragged, path, tmp_path, monkeypatch):
    save_demonstrations(path, ragged)
    before = path.read_bytes()

    def full(number):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OutputError, match="recordings.nc: No space left"):
        save_demonstrations(path, ragged.select_people([0]))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
    with pytest.raises(OutputError, match="new.nc"):
        save_demonstrations(tmp_path / "new.nc", ragged)
    assert list(tmp_path.iterdir()) == [path]


# --- the package and its documentation --------------------------------------------------------


def test_assets_are_found_or_listed(tmp_path, monkeypatch):
    (tmp_path / "assets" / "driving").mkdir(parents=True)
    (tmp_path / "assets" / "driving" / "people.nc").touch()
    monkeypatch.setattr(mirror_ppl.data.resources, "files", lambda package: tmp_path)
    assert asset_path("driving/people.nc") == tmp_path / "assets" / "driving" / "people.nc"
    with pytest.raises(AssetError, match='no file "x.nc" ships; there are: driving/people.nc$'):
        asset_path("x.nc")


def test_assets_lie_in_the_package():
    inside = Path(mirror_ppl.data.__file__)
    assert asset_path("../__init__.py").resolve() == inside.resolve()


def test_importing_the_type_does_not_wait_for_xarray():
    code = "import sys, mirror_ppl.data; assert 'xarray' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_the_documented_example_runs_and_is_a_valid_recording(tmp_path, monkeypatch, capsys):
    page = DOCS / "demonstrations.md"
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    assert len(blocks) == 4
    monkeypatch.chdir(tmp_path)
    exec("\n".join(blocks), {})
    assert (
        "Demonstrations(driving, fog: 2 people, 5 rounds each, 150 steps in all)"
        in capsys.readouterr().out
    )
    loaded = load_demonstrations("recordings.nc")
    assert loaded.people == ("anna", "ben")
    # What the example made up is what the domain would have shown: lanes follow actions.
    lane = loaded.ego[..., 0]
    assert torch.equal(lane[..., 1:] != lane[..., :-1], loaded.actions == 1)
    values = loaded.observation()
    _, distance = DRIVING.distance(values)
    assert torch.equal(values["visual"], values["verbal"][..., :2]) and distance.max() == 12
    ben = load_demonstrations("ben.nc")
    assert ben.people == ("ben",) and ben.shape == (1, 4, 15)


def test_the_documented_table_lists_every_variable_and_its_dimensions():
    page = (DOCS / "demonstrations.md").read_text()
    rows = re.findall(r"^\| (\S+) \| ([a-z_*, ]+) \|", page.split("## Variables")[1], re.MULTILINE)
    documented = {name.replace("`", "").replace("*", ""): dims for name, dims in rows}
    for name, dims in schema.variable_dimensions(DRIVING).items():
        general = name.replace("visual", "modality").replace("verbal", "modality")
        expected = ", ".join(dims).replace("visual", "modality").replace("verbal", "modality")
        assert documented[general].replace("*", "") == expected
