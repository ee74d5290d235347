"""netCDF files that are damaged, large only in what they say, or no files at all."""

import io
import os
import signal
import threading
import time

import h5py
import numpy as np
import pytest
import xarray as xr

from mirror_ppl import netcdf
from mirror_ppl.data import asset_path, load_demonstrations, save_demonstrations
from mirror_ppl.data.demonstrations import Demonstrations
from mirror_ppl.errors import DemonstrationsError, PosteriorError
from mirror_ppl.netcdf import read_netcdf


class Forgetful(set):
    """A set that never holds anything."""

    def add(self, element):
        """Add nothing."""


@pytest.fixture(autouse=True)
def nothing_read(monkeypatch):
    """Forget what was read or made, so that another process reads each file first."""
    monkeypatch.setattr(netcdf, "_READ", set())
    monkeypatch.setattr(netcdf, "_MADE", Forgetful())


def refused(path):
    with pytest.raises(PosteriorError) as error:
        read_netcdf(path, PosteriorError)
    assert str(error.value).isprintable()
    return str(error.value)


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_groups_are_read(tmp_path, engine):
    path = tmp_path / "a.nc"
    data = xr.Dataset({"x": ("y", np.arange(3.0))}, attrs={"units": "seconds since"})
    data.to_netcdf(path, engine=engine)
    assert read_netcdf(path, PosteriorError)["/"].identical(data)
    assert read_netcdf(str(path), PosteriorError, ("other",)) == {}


def test_what_declares_more_than_can_be_in_it_is_refused_before_memory_is_taken(tmp_path):
    path = tmp_path / "a.nc"
    with h5py.File(path, "w") as file:
        file.create_dataset("action", (10, 10**6, 100), "f8", chunks=(1, 1000, 100))
    assert path.stat().st_size < 20_000
    began = time.monotonic()
    assert "it declares 8,000,000,000 bytes, but has" in refused(path)
    assert time.monotonic() - began < 10


def test_reading_that_does_not_end_or_crashes_is_noticed(tmp_path, monkeypatch):
    path = tmp_path / "a.nc"
    xr.Dataset({"x": ("y", np.arange(3.0))}).to_netcdf(path, engine="h5netcdf")
    # Whatever threads earlier tests have left.
    monkeypatch.setattr(netcdf.threading, "enumerate", list)
    parent = os.getpid()

    def endless(content, engine, groups, allow):
        assert os.getpid() != parent
        while True:
            pass

    def crash(content, engine, groups, allow):
        assert os.getpid() != parent
        os.abort()

    for fault in (endless, crash):
        with monkeypatch.context() as patch:
            patch.setattr(netcdf, "SECONDS", 0.3)
            patch.setattr(netcdf, "_read", fault)
            assert refused(path) == (
                f"{path}: is truncated or damaged (it cannot be read to its end)"
            )
    read_netcdf(path, PosteriorError)


def test_another_process_reads_each_content_and_its_groups_once(tmp_path, monkeypatch):
    path, tried, ends = tmp_path / "a.nc", [], netcdf._ends
    monkeypatch.setattr(
        netcdf, "_ends", lambda read, content: tried.append(content) or ends(read, content)
    )
    for value in (1.0, 2.0, 1.0):
        data = xr.Dataset({"x": value})
        data.to_netcdf(path, engine="h5netcdf")
        for _ in range(2):
            assert read_netcdf(path, PosteriorError)["/"].identical(data)
    assert len(tried) == 2
    read_netcdf(path, PosteriorError, ("other",))
    assert len(tried) == 3


def test_what_this_process_made_is_read_by_no_other(tmp_path, monkeypatch):
    monkeypatch.setattr(netcdf, "_MADE", set())
    save_demonstrations(tmp_path / "a.nc", simple())
    with monkeypatch.context() as patch:
        patch.setattr(netcdf, "_ends", lambda read, content: pytest.fail("read by another"))
        assert load_demonstrations(tmp_path / "a.nc").equals(simple())
    content = bytearray((tmp_path / "a.nc").read_bytes())
    content[-1] ^= 1
    (tmp_path / "a.nc").write_bytes(content)
    monkeypatch.setattr(netcdf, "_ends", lambda read, content: False)
    with pytest.raises(DemonstrationsError, match="cannot be read to its end"):
        load_demonstrations(tmp_path / "a.nc")


def assert_read_as_by_xarray(path, *groups):
    found = read_netcdf(path, PosteriorError, ("/", *groups))
    assert set(found) == {"/", *groups}
    for name, group in found.items():
        with xr.open_dataset(path, engine="h5netcdf", group=name, decode_times=False) as expected:
            assert group.identical(expected.load())
            assert list(group.coords) == list(expected.coords)
            for own, variable in group.variables.items():
                assert variable.dtype == expected.variables[own].dtype


@pytest.mark.parametrize("world", ["driving_fog", "search_rescue_smoke", "highway_clear"])
def test_recordings_are_read_as_xarray_reads_them(world):
    assert_read_as_by_xarray(asset_path(f"{world}_paper.nc"))


def test_groups_of_any_types_are_read_as_xarray_reads_them(tmp_path):
    data = xr.Dataset(
        {
            "packed": ("x", np.array([1.0, np.nan, 3.0])),
            "flag": ("x", np.array([True, False, True])),
            "word": ("x", np.array(["a", "", "çé"], dtype=object)),
            "fixed": ("x", np.array([b"a", b"bc", b""])),
            "nothing": ("y", np.zeros(0)),
            "scalar": 3,
        },
        coords={"x": ["k", "l", "m"], "beside": ("x", [4, 5, 6])},
        attrs={"title": "t", "many": [1, 2]},
    )
    packing = {"packed": {"dtype": "i2", "scale_factor": 0.5, "_FillValue": -1}}
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf", encoding=packing)
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf", mode="a", group="inner")
    assert_read_as_by_xarray(tmp_path / "a.nc", "inner")


def test_a_zeroed_heap_does_not_hang(tmp_path, monkeypatch):
    """The HDF5 library looks for the end of such a heap for ever."""
    monkeypatch.setattr(netcdf, "SECONDS", 0.3)
    path = tmp_path / "a.nc"
    save_demonstrations(path, simple())
    content = bytearray(path.read_bytes())
    begin = content.index(b"GCOL")
    refusals = 0
    for offset in range(8, 400, 112):
        damaged = bytearray(content)
        damaged[begin + offset : begin + offset + 64] = bytes(64)
        path.write_bytes(damaged)
        began = time.monotonic()
        try:
            load_demonstrations(path)
        except DemonstrationsError as error:
            refusals += 1
            assert str(error).isprintable()
        assert time.monotonic() - began < 60
    assert refusals


def simple():
    from example_recordings import fields

    return Demonstrations(**fields([[3, 2], [1]]))


def test_names_that_are_no_utf8(tmp_path):
    path = tmp_path / "a.nc"
    save_demonstrations(path, simple())
    with xr.open_dataset(path, engine="h5netcdf") as data:
        data = data.load()
    data["person"] = np.array([b"caf\xe9", b"ok"])
    content = io.BytesIO(data.drop_encoding().to_netcdf(engine="scipy"))
    path.write_bytes(content.getvalue())
    with pytest.raises(DemonstrationsError) as error:
        load_demonstrations(path)
    assert str(error.value).isprintable()


def test_files_are_read_where_there_are_threads(tmp_path):
    """A copy of such a process might wait for ever for what another thread holds."""
    path = tmp_path / "a.nc"
    save_demonstrations(path, simple())
    found = []
    work = lambda: found.append(load_demonstrations(path))  # noqa: E731
    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(100)
    assert len(found) == 2 and found[0].equals(found[1])


def test_files_are_read_where_children_are_reaped_by_others(tmp_path):
    path = tmp_path / "a.nc"
    save_demonstrations(path, simple())
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        load_demonstrations(path)
    finally:
        signal.signal(signal.SIGCHLD, before)
