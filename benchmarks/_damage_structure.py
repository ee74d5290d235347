"""Damage to the structure of netCDF files that no writer of datasets would do.

Each takes numpy's generator and a file's bytes, and returns other bytes and the names of the
variables and attributes that were touched. `OF_HDF5` is for netCDF-4, `OF_CLASSIC` for netCDF-3.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Mapping

import h5py
import numpy as np

from benchmarks._damage import Random

Damaged = tuple[bytes, frozenset[str]]
EVERYTHING = frozenset({"*"})
"""What is touched where anything may be."""
NUMBERS = (np.nan, np.inf, -np.inf, 1e30, -1.0, 0.0, 0.5, 1e300, 77.0, -1e-9)
SIZES = (10**5, 10**7, 10**9, 2**31, 2**40, 2**60)
LARGE = 10**7
"""Entries of a dataset that is still read."""
TEXTS = (b"\xff\xfe\xfa", b"", "\N{PARTY POPPER}", "x" * 5000, "a\nb", "[/]", "\\foo$", "driving")


class _Opened:
    """A file in memory, open for changes."""

    def __init__(self, content: bytes) -> None:
        self.buffer = io.BytesIO(content)
        self.file = h5py.File(self.buffer, "r+")

    def datasets(self) -> list[str]:
        """But for those that an earlier damage made too large to be read."""
        found: list[str] = []

        def add(name: str, part: object) -> None:
            if isinstance(part, h5py.Dataset) and (part.size or 0) <= LARGE:
                found.append(name)

        self.file.visititems(add)
        return found

    def one(self, random: Random) -> str:
        return str(random.choice(self.datasets()))

    def of_numbers(self, random: Random) -> str:
        """A dataset of numbers that has entries."""
        names = [
            name
            for name in self.datasets()
            if self.file[name].dtype.kind in "iuf" and self.file[name].size
        ]
        return str(random.choice(names))

    def holder(self, random: Random) -> h5py.Group | h5py.Dataset:
        """What has attributes: the file, a group or a dataset."""
        names = ["/", *self.datasets()]
        self.file.visititems(
            lambda name, part: names.append(name) if isinstance(part, h5py.Group) else None
        )
        return self.file[str(random.choice(names[:1] if random.random() < 0.4 else names))]

    def replace(self, name: str, **new: object) -> None:
        """Put another dataset in a dataset's place."""
        del self.file[name]
        self.file.create_dataset(name, **new)

    def close(self, *touched: str) -> Damaged:
        self.file.close()
        return self.buffer.getvalue(), frozenset(touched)


def odd_numbers(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    name = opened.of_numbers(random)
    old = opened.file[name]
    values, number = old[()], random.choice(NUMBERS)
    flat = np.atleast_1d(values).ravel().astype("f8")
    flat[random.integers(0, flat.size, int(random.choice([1, 3, flat.size])))] = number
    with np.errstate(all="ignore"):
        old[...] = flat.reshape(old.shape).astype(old.dtype)
    return opened.close(name)


def scaled_numbers(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    name = opened.of_numbers(random)
    old = opened.file[name]
    with np.errstate(all="ignore"):
        values = old[()] * random.choice([-1.0, 1.5, 0.0, 1e6]) + random.choice([0.0, 1.0])
        old[...] = values.astype(old.dtype)
    return opened.close(name)


def shuffled_numbers(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    name = opened.of_numbers(random)
    old = opened.file[name]
    old[...] = random.permutation(old[()].ravel()).reshape(old.shape)
    return opened.close(name)


def lost_dataset(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    name = opened.one(random)
    del opened.file[name]
    return opened.close(name)


def lost_group(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    groups = [name for name, part in opened.file.items() if isinstance(part, h5py.Group)]
    name = str(random.choice(groups or list(opened.file)))
    del opened.file[name]
    return opened.close(*EVERYTHING)


def into_a_group(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    names = list(opened.file)
    group = opened.file.create_group("inner")
    for name in names if random.random() < 0.5 else [str(random.choice(names))]:
        opened.file.move(name, f"{group.name}/{name}")
    return opened.close(*EVERYTHING)


def moved_dataset(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    name = opened.one(random)
    new = str(
        random.choice([f"{name}_x", name.upper(), f"told_{name}", "a/b/c", opened.one(random)])
    )
    opened.file.move(name, new)
    return opened.close(name, new)


def huge_dataset(random: Random, content: bytes) -> Damaged:
    """Declared far larger than the file: what is not written counts as filled."""
    opened = _Opened(content)
    name = opened.one(random)
    old = opened.file[name]
    shape = list(old.shape) or [1]
    axis = int(random.integers(len(shape)))
    shape[axis] = int(random.choice(SIZES))
    dtype = old.dtype if random.random() < 0.8 else np.dtype("f8")
    if dtype.kind == "O":
        dtype = np.dtype("f8")
    chunked = random.random() < 0.6
    new: dict[str, object] = {"shape": tuple(shape), "dtype": dtype}
    if chunked:
        new |= {"chunks": tuple(min(64, size) for size in shape), "compression": "gzip"}
    opened.replace(name, **new)
    return opened.close(name)


def huge_dimension(random: Random, content: bytes) -> Damaged:
    """A consistent file, all of whose variables are as large along one dimension as it says."""
    import h5netcdf

    opened = _Opened(content)
    if any(isinstance(part, h5py.Group) for part in opened.file.values()):
        return huge_dataset(random, content)
    sizes = {name: part.shape[0] for name, part in opened.file.items() if part.is_scale}
    long = str(random.choice(list(sizes)))
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as made:
        made.dimensions = sizes | {long: int(random.choice(SIZES))}
        for name, value in opened.file.attrs.items():
            if not name.startswith("_"):
                made.attrs[name] = value
        for name, part in opened.file.items():
            if part.is_scale:
                continue
            axes = tuple(axis[0].name.strip("/") for axis in part.dims)
            new = made.create_variable(name, axes, part.dtype, chunks=part.shape)
            if long not in axes:
                new[...] = part[()]
    return buffer.getvalue(), EVERYTHING


def other_shape(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    name = opened.one(random)
    value = np.asarray(opened.file[name][()])
    if value.dtype.kind == "O":
        value = value.astype("S")
    value = [value.ravel(), value[None], value.ravel()[:1].reshape(()), value[:0], value[:1]][
        int(random.integers(5))
    ]
    opened.replace(name, data=value)
    return opened.close(name)


def other_kind(random: Random, content: bytes) -> Damaged:
    """Numbers become something else that HDF5 can hold."""
    opened = _Opened(content)
    name = opened.one(random)
    shape = opened.file[name].shape
    kinds: list[dict[str, object]] = [
        {"shape": shape, "dtype": [("a", "f4"), ("b", "i2")]},
        {"shape": shape, "dtype": h5py.vlen_dtype(np.float64)},
        {"shape": shape, "dtype": h5py.enum_dtype({"stay": 0, "switch": 1}, "i1")},
        {"shape": shape, "dtype": h5py.ref_dtype},
        {"shape": shape, "dtype": "V4"},
        {"shape": shape, "dtype": h5py.string_dtype()},
        {"shape": shape, "dtype": "S3"},
        {"shape": shape, "dtype": "c8"},
        {"shape": shape, "dtype": "f2"},
        {"data": h5py.Empty("f4")},
    ]
    opened.replace(name, **kinds[int(random.integers(len(kinds)))])
    return opened.close(name)


def no_text(random: Random, content: bytes) -> Damaged:
    """Names that are not UTF-8."""
    opened = _Opened(content)
    texts = [name for name in opened.datasets() if opened.file[name].dtype.kind in "OS"]
    name = str(random.choice(texts))
    shape = opened.file[name].shape
    if random.random() < 0.5:
        opened.replace(name, data=np.full(shape, b"\xff\xfe\xfa", "S3"))
    else:
        kind = h5py.string_dtype("ascii" if random.random() < 0.5 else "utf-8")
        opened.replace(name, data=np.full(shape, b"\xff\xfe", dtype=object), dtype=kind)
    return opened.close(name)


def odd_attribute(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    holder = opened.holder(random)
    values: list[object] = [
        *map(np.bytes_, TEXTS[:1]),
        *TEXTS[1:],
        h5py.Empty("f4"),
        np.array([1.0, np.nan]),
        np.array([], "f8"),
        opened.file.ref,
        np.void(b"abc"),
        2**63,
        -1,
        np.nan,
        True,
    ]
    names = list(holder.attrs) + ["format", "domain", "setting", "_FillValue", "odd\N{SNOWMAN}"]
    name = str(random.choice(names))
    if name in holder.attrs:
        del holder.attrs[name]
    holder.attrs[name] = values[int(random.integers(len(values)))]
    return opened.close(f"@{name}", (holder.name or "/").strip("/"))


def lost_attribute(random: Random, content: bytes) -> Damaged:
    opened = _Opened(content)
    holder = opened.holder(random)
    if not list(holder.attrs):
        holder = opened.file
    name = str(random.choice(list(holder.attrs)))
    del holder.attrs[name]
    return opened.close(f"@{name}", (holder.name or "/").strip("/"))


def link(random: Random, content: bytes) -> Damaged:
    """A link to nothing, to another file, to a device, or to where it stands."""
    opened = _Opened(content)
    name = opened.one(random)
    kind = int(random.integers(5))
    if random.random() < 0.7:
        del opened.file[name]
    else:
        name = "further"
    opened.file[name] = [
        lambda: h5py.SoftLink("/nowhere"),
        lambda: h5py.SoftLink(f"/{name}"),
        lambda: h5py.ExternalLink("/dev/zero", "/action"),
        lambda: h5py.ExternalLink("/nowhere/at/all.nc", "/action"),
        lambda: opened.file["/"],
    ][kind]()
    return opened.close(name)


OF_HDF5: Mapping[str, Callable[[Random, bytes], Damaged]] = {
    made.__name__: made
    for made in (
        odd_numbers,
        scaled_numbers,
        shuffled_numbers,
        lost_dataset,
        lost_group,
        into_a_group,
        moved_dataset,
        huge_dataset,
        huge_dimension,
        other_shape,
        other_kind,
        no_text,
        odd_attribute,
        lost_attribute,
        link,
    )
}


# --- netCDF-3 -----------------------------------------------------------------------------------


def huge_classic_dimension(random: Random, content: bytes) -> Damaged:
    """The header says that a dimension is far longer than the file."""
    number = struct.unpack(">i", content[12:16])[0]
    position = 16
    chosen = int(random.integers(number))
    for place in range(number):
        length = struct.unpack(">i", content[position : position + 4])[0]
        position += 4 + (length + 3) // 4 * 4
        if place == chosen:
            size = int(random.choice([0, 1, 1000, 10**6, 10**8, 2**31 - 1]))
            if random.random() < 0.1:
                size = -1
            content = content[:position] + struct.pack(">i", size) + content[position + 4 :]
        position += 4
    return content, EVERYTHING


def wrong_records(random: Random, content: bytes) -> Damaged:
    """The number of records, of which there are none."""
    size = int(random.choice([1, 2**31 - 1, -1]))
    return content[:4] + struct.pack(">i", size) + content[8:], EVERYTHING


def other_version(random: Random, content: bytes) -> Damaged:
    """Another variant of netCDF-3."""
    return content[:3] + bytes([int(random.integers(7))]) + content[4:], EVERYTHING


OF_CLASSIC: Mapping[str, Callable[[Random, bytes], Damaged]] = {
    made.__name__: made for made in (huge_classic_dimension, wrong_records, other_version)
}
