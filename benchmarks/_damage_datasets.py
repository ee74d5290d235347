"""Damage to what a recording's dataset holds, before it is saved.

Each edit takes numpy's generator, so that a number reproduces it. It returns the changed dataset,
and what of the recording it may have changed: a file that is accepted has to be equal to the
original in everything else. Where it cannot be done it raises `KeyError`, `ValueError`, `TypeError`
or `IndexError`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr

from benchmarks._damage import Random

FIELDS = (
    "domain",
    "setting",
    "people",
    "ego",
    "observations",
    "actions",
    "told",
    "round_counts",
    "lengths",
)
"""What a fit uses of a recording."""
ALL, NOTHING = frozenset(FIELDS), frozenset[str]()
OF_VARIABLES = {
    "ego": "ego",
    "action": "actions",
    "length": "lengths",
    "round_count": "round_counts",
    "visual": "observations",
    "verbal": "observations",
    "told_visual": "told",
    "told_verbal": "told",
}
"""Which part of a recording each variable is."""
STRANGE = (
    "$\\foo$",
    "[/]",
    "[bold]anna[/bold]",
    "\N{PARTY POPPER}",
    "\N{HEBREW LETTER ALEF}\N{HEBREW LETTER BET}",
    "x" * 300,
    "two\nlines",
    "tab\tstop",
    "",
    " ",
    "nul\0l",
    "../up",
    "a/b",
    "nan",
    "%s{0}",
    "\u202eright to left",
    "\ud800",
)
"""Texts that programs stumble over."""
NUMBERS = (np.nan, np.inf, -np.inf, 1e30, 1e300, -1e300, -1.0, 0.5, 2.0**31, 2.0**63, 99.0, 1e-30)
DTYPES = ("i1", "u1", "i4", "i8", "u8", "f4", "f8", "f2", "?", "U8", "S8", "M8[ns]", "c16")


Edited = tuple[xr.Dataset, frozenset[str]]


def _changes(name: str) -> frozenset[str]:
    return frozenset({OF_VARIABLES[name]}) if name in OF_VARIABLES else NOTHING


def _one(random: Random, dataset: xr.Dataset) -> str:
    """A variable; every other time one that a fit uses."""
    names = [str(name) for name in dataset.data_vars]
    used = [name for name in names if name in OF_VARIABLES]
    return str(random.choice(used if used and random.random() < 0.7 else names))


def _with_values(dataset: xr.Dataset, name: str, values: np.ndarray) -> xr.Dataset:
    old = dataset[name]
    return dataset.assign({name: (old.dims, values, old.attrs)})


def drop_variable(random: Random, dataset: xr.Dataset) -> Edited:
    name = _one(random, dataset)
    return dataset.drop_vars(name), _changes(name)


def rename_variable(random: Random, dataset: xr.Dataset) -> Edited:
    name = _one(random, dataset)
    new = str(random.choice([name.upper(), f"{name}_", "told_" + name, "truth_" + name, "x"]))
    return dataset.rename({name: new}), _changes(name)


def swap_variables(random: Random, dataset: xr.Dataset) -> Edited:
    one, other = _one(random, dataset), _one(random, dataset)
    return dataset.rename({one: other, other: one}), _changes(one) | _changes(other)


def retype(random: Random, dataset: xr.Dataset) -> Edited:
    name = _one(random, dataset)
    with np.errstate(all="ignore"):
        values = dataset[name].values.astype(str(random.choice(DTYPES)))
    return _with_values(dataset, name, values), _changes(name)


def permute_dimensions(random: Random, dataset: xr.Dataset) -> Edited:
    name = _one(random, dataset)
    array = dataset[name]
    return dataset.assign({name: array.transpose(*random.permutation(list(array.dims)))}), NOTHING


def misname_dimensions(random: Random, dataset: xr.Dataset) -> Edited:
    name = _one(random, dataset)
    array = dataset[name]
    dims = list(random.permutation(list(array.dims)))
    if random.random() < 0.5:
        dims[0] = "elsewhere"
    return dataset.drop_vars(name).assign({name: (dims, array.values, array.attrs)}), _changes(name)


def cut(random: Random, dataset: xr.Dataset) -> Edited:
    dimension = str(random.choice(list(dataset.sizes)))
    size = dataset.sizes[dimension]
    start = int(random.integers(size))
    return dataset.isel({dimension: slice(start, int(random.integers(start, size + 1)))}), ALL


def repeat(random: Random, dataset: xr.Dataset) -> Edited:
    dimension = str(random.choice(list(dataset.sizes)))
    size = dataset.sizes[dimension]
    return dataset.isel({dimension: list(random.integers(0, size, size + 1))}), ALL


def empty(random: Random, dataset: xr.Dataset) -> Edited:
    dimension = str(random.choice(list(dataset.sizes)))
    return dataset.isel({dimension: slice(0)}), ALL


def odd_values(random: Random, dataset: xr.Dataset) -> Edited:
    name = _one(random, dataset)
    values = dataset[name].values.astype("f8")
    number = int(random.choice([1, 1, 5, values.size]))
    values.flat[random.integers(0, values.size, number)] = random.choice(NUMBERS)
    return _with_values(dataset, name, values), _changes(name)


def other_values(random: Random, dataset: xr.Dataset) -> Edited:
    """Values as they might be, at other places."""
    name = _one(random, dataset)
    values = dataset[name].values.copy()
    one, other = random.integers(0, values.size, (2, int(random.choice([1, 5]))))
    values.flat[one] = values.flat[other]
    return _with_values(dataset, name, values), _changes(name)


def off_by_little(random: Random, dataset: xr.Dataset) -> Edited:
    name = _one(random, dataset)
    values = dataset[name].values.astype("f8")
    values.flat[random.integers(values.size)] += random.choice([-1, 1, 1e-4, -1e-9])
    return _with_values(dataset, name, values), _changes(name)


def missing_actions(random: Random, dataset: xr.Dataset) -> Edited:
    values = dataset["action"].values.copy()
    person, number = (int(random.integers(size)) for size in values.shape[:2])
    values[person, number, 0] = -1
    return _with_values(dataset, "action", values), frozenset({"actions"})


def shift_actions(random: Random, dataset: xr.Dataset) -> Edited:
    by = int(random.choice([-1, 1]))
    return _with_values(dataset, "action", np.roll(dataset["action"].values, by, -1)), _changes(
        "action"
    )


def all_the_same(random: Random, dataset: xr.Dataset) -> Edited:
    name = _one(random, dataset)
    return _with_values(
        dataset, name, np.full_like(dataset[name].values, random.choice([0, 0, 1]))
    ), _changes(name)


def shuffled(random: Random, dataset: xr.Dataset) -> Edited:
    """Entries along one dimension of one variable in another order."""
    name = _one(random, dataset)
    axis = int(random.integers(dataset[name].ndim))
    return _with_values(dataset, name, random.permutation(dataset[name].values, axis)), _changes(
        name
    )


def reverse_time(random: Random, dataset: xr.Dataset) -> Edited:
    del random
    for name, axis in (("step", "step"), ("time", "time")):
        dataset = dataset.isel({name: slice(None, None, -1)}) if axis in dataset.sizes else dataset
    return dataset, frozenset({"ego", "observations", "actions", "told"})


def wrong_lengths(random: Random, dataset: xr.Dataset) -> Edited:
    name = str(random.choice(["length", "round_count"]))
    values = dataset[name].values.astype("f8")
    values.flat[random.integers(values.size)] += random.choice([-1, 1, 5, -5, 1e9, np.nan, 0.5])
    return _with_values(dataset, name, values), frozenset({"lengths", "round_counts"})


def filled(random: Random, dataset: xr.Dataset) -> Edited:
    """Attributes that change how values are decoded."""
    name = _one(random, dataset)
    change: dict[str, object] = {
        "_FillValue": random.choice([0, 1, -1]).astype(dataset[name].dtype),
        "scale_factor": float(random.choice([0.0, 2.0, -1.0, np.nan])),
        "add_offset": float(random.choice([1.0, np.inf])),
        "missing_value": random.choice([0, 1]).astype(dataset[name].dtype),
        "_Unsigned": "true",
        "units": "days since 2000-01-01",
        "valid_range": np.array([0, 1]),
    }
    key = str(random.choice(list(change)))
    array = dataset[name].copy()
    array.attrs = {**array.attrs, key: change[key]}
    array.encoding = {}
    return dataset.assign({name: array}), _changes(name)


def _odd_attribute(random: Random) -> object:
    odd = [
        *STRANGE[:-1],
        7,
        -1.5,
        np.nan,
        2**62,
        np.array([1, 2, 3]),
        np.array([], "f8"),
        ["a", "b"],
        "fog ",
        "Driving",
    ]
    return odd[int(random.integers(len(odd)))]


def odd_attribute(random: Random, dataset: xr.Dataset) -> Edited:
    names = ["format", "format_version", "domain", "setting", "seed", "population", "odd", "title"]
    name = str(random.choice(names))
    changed = frozenset({"setting", "domain"}) if name in ("setting", "domain") else NOTHING
    return dataset.assign_attrs({name: _odd_attribute(random)}), changed


def other_place(random: Random, dataset: xr.Dataset) -> Edited:
    """Another domain or setting, as a careless edit has it."""
    places = {
        "domain": ["driving", "search_rescue", "bomb_defusal"],
        "setting": ["clear", "fog", "smoke", "labelled", "unlabelled"],
    }
    name = str(random.choice(list(places)))
    return dataset.assign_attrs({name: str(random.choice(places[name]))}), frozenset({name})


def drop_attribute(random: Random, dataset: xr.Dataset) -> Edited:
    copy = dataset.copy()
    copy.attrs.pop(str(random.choice(list(copy.attrs))))
    return copy, NOTHING


def odd_attribute_of_a_variable(random: Random, dataset: xr.Dataset) -> Edited:
    name, array = (chosen := _one(random, dataset)), dataset[chosen].copy()
    key = str(random.choice(["flag_meanings", "units", "coordinates", "dtype", "long_name"]))
    array.attrs = {**array.attrs, key: _odd_attribute(random)}
    return dataset.assign({name: array}), NOTHING


def _labelled(random: Random, dataset: xr.Dataset) -> str:
    return str(random.choice([str(name) for name in dataset.coords if name != "person"]))


def mislabel(random: Random, dataset: xr.Dataset) -> Edited:
    """Names along a dimension in another order, while values stay."""
    name = _labelled(random, dataset)
    part = frozenset({"ego" if name == "ego_feature" else "observations", "told"})
    return dataset.assign_coords({name: random.permutation(dataset[name].values)}), part


def same_labels(random: Random, dataset: xr.Dataset) -> Edited:
    name = _labelled(random, dataset)
    values = dataset[name].values.copy()
    values[-1] = random.choice([values[0], STRANGE[int(random.integers(6))]])
    return dataset.assign_coords({name: values}), NOTHING


def reorder(random: Random, dataset: xr.Dataset) -> Edited:
    """Items or features in another order, with their names."""
    name = _labelled(random, dataset)
    return dataset.isel({name: random.permutation(dataset.sizes[name])}), NOTHING


def drop_labels(random: Random, dataset: xr.Dataset) -> Edited:
    name = str(random.choice(list(map(str, dataset.coords))))
    return dataset.drop_vars(name), frozenset({"people"}) if name == "person" else NOTHING


def strange_people(random: Random, dataset: xr.Dataset) -> Edited:
    size = dataset.sizes["person"]
    people: list[object] = list(random.choice(np.array(STRANGE[:-1], dtype=object), size))
    if random.random() < 0.3:
        people = list(random.choice([np.nan, 1.5, 1, np.inf, -0.0], size))
        return dataset.assign_coords(person=np.array(people, "f8")), frozenset({"people"})
    return dataset.assign_coords(person=np.array(people, dtype=object)), frozenset({"people"})


def further_variables(random: Random, dataset: xr.Dataset) -> Edited:
    name = str(random.choice(["notes", "told_smell", "truth_x", "reward_2", "a b", "\N{SNOWMAN}"]))
    kind = int(random.integers(4))
    value = [
        ((), np.array(1.0)),
        (("person",), np.zeros(dataset.sizes["person"])),
        (("elsewhere",), np.array(["a", "b"], dtype=object)),
        (("elsewhere",), np.array([np.nan, np.inf])),
    ][kind]
    return dataset.assign({name: value}), NOTHING


EDITS: Mapping[str, Callable[[Random, xr.Dataset], Edited]] = {
    made.__name__: made
    for made in (
        drop_variable,
        rename_variable,
        swap_variables,
        retype,
        permute_dimensions,
        misname_dimensions,
        cut,
        repeat,
        empty,
        odd_values,
        other_values,
        off_by_little,
        missing_actions,
        shift_actions,
        all_the_same,
        shuffled,
        reverse_time,
        wrong_lengths,
        filled,
        odd_attribute,
        other_place,
        drop_attribute,
        odd_attribute_of_a_variable,
        mislabel,
        same_labels,
        reorder,
        drop_labels,
        strange_people,
        further_variables,
    )
}
