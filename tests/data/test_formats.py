"""NetCDF files and datasets in memory are recordings with their units."""

from __future__ import annotations

import gzip
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import netcdf_file

from siq.data.recordings import Recordings, read_recordings
from siq.errors import InputError

LENGTHS = (4, 3)


def recordings() -> Recordings:
    draw = np.random.default_rng(0)
    return Recordings.from_arrays(
        [0.1 * np.arange(n) for n in LENGTHS], [draw.normal(size=(n, 2)) for n in LENGTHS],
        names=["x", "y"], units=["mm", "µm/s"], time_unit="s",
    )  # fmt: skip


def padded() -> tuple[np.ndarray, np.ndarray]:
    """Times ``(4,)`` and x ``(2, 4)``, not a number where the second recording has ended."""
    made = recordings()
    x = np.full((2, 4), np.nan)
    x[0], x[1, :3] = made.values[:4, 0], made.values[4:, 0]
    return made.t[:4], x


def test_version_3_over_two_dimensions(tmp_path: Path) -> None:
    t, x = padded()
    with netcdf_file(tmp_path / "a.nc", "w") as file:
        for name, size in (("t", 4), ("recording", 2), ("letters", 5)):
            file.createDimension(name, size)
        time = file.createVariable("t", "d", ("t",))
        time[:], time.units = t, "seconds since 2020-01-01"
        labels = file.createVariable("recording", "S1", ("recording", "letters"))
        labels[:] = np.array(["first", "other"], dtype="S5").view("S1").reshape(2, 5)
        packed = file.createVariable("x", "i2", ("t", "recording"))  # transposed
        packed[:] = np.where(np.isnan(x.T), -99, np.round(x.T * 100)).astype("i2")
        packed.units, packed.scale_factor, packed._FillValue = b"mm", 0.01, np.int16(-99)
        note = file.createVariable("station", "S1", ("letters",))  # no column
        note[:] = np.array(list("north"), dtype="S1")
    found = read_recordings(tmp_path / "a.nc")
    assert (found.names, found.units, found.time_unit) == (("x",), ("mm",), "seconds")
    assert found.labels == ("first", "other")
    assert found.recording.tolist() == [0] * 4 + [1] * 3
    assert found.values[:, 0] == pytest.approx(recordings().values[:, 0], abs=0.005)


def test_version_4_is_hdf5_with_dimensions(tmp_path: Path) -> None:
    t, x = padded()
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["t"], file["x"], file["trajectory"] = t, x, np.zeros(2)
        file["x"].attrs["units"] = "mm"
        file["t"].make_scale()
        file["trajectory"].make_scale("This is a netCDF dimension but not a netCDF variable.         2")
        file["x"].dims[0].attach_scale(file["trajectory"])
        file["x"].dims[1].attach_scale(file["t"])
    found = read_recordings(tmp_path / "a.nc")
    assert (found.names, found.units, found.labels) == (("x",), ("mm",), ("0", "1"))
    assert np.array_equal(found.values[:, 0], recordings().values[:, 0])


def test_a_file_without_dimensions_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file.attrs["title"] = "nothing"
    with pytest.raises(InputError, match="no variable over a dimension"):
        read_recordings(tmp_path / "a.nc")


@pytest.mark.parametrize("version", ["memory", "NETCDF3_64BIT", "NETCDF4"])
def test_a_dataset_is_read_back(version: str, tmp_path: Path) -> None:
    pytest.importorskip("xarray")
    made = recordings()
    dataset = made.to_xarray()
    if version == "memory":
        found = Recordings.of(dataset)
    else:
        dataset.to_netcdf(tmp_path / "a.nc", format=version)
        found = Recordings.of(tmp_path / "a.nc")
    assert (found.names, found.units, found.labels) == (made.names, made.units, made.labels)
    assert found.time_unit == made.time_unit
    assert np.array_equal(found.values, made.values) and np.array_equal(found.t, made.t)


def test_lines_before_the_headings_are_no_headings(tmp_path: Path) -> None:
    rows = "".join(f"{0.1 * k:.1f}\t{k % 5}\t{k % 3}\n" for k in range(30))
    text = "Instrument: HF2, no. 3\nOperator: Ann\n\nTime (s)\tX (V)\tY (V)\n" + rows
    path = tmp_path / "lock-in.txt"
    path.write_text(text, encoding="utf-8")
    read = read_recordings(path)
    assert (read.names, read.units, read.time_unit, len(read.t)) == (("X", "Y"), ("V", "V"), "s", 30)


SETTINGS = ("Record Length,2.5e+03", "Sample Interval,0.1", "Trigger Point,0", ",", "Model Number,TDS2024B")
SCOPES = {
    "with headings": (
        "Model,MDO3024\nHorizontal Scale,0.0004,\nGating,0.0% to 100.0%,\nLabel,,\nTIME,CH1,\n"
        + "".join(f"{0.1 * k:.1f},{k % 5},\n" for k in range(30)),
        "CH1",
    ),
    "settings as wide as rows": (
        "Model,DPO4104\nHorizontal Scale,0.0004\nTIME,CH1\n"
        + "".join(f"{0.1 * k:.1f},{k % 5}\n" for k in range(30)),
        "CH1",
    ),
    "settings in columns": (
        "".join(f"{SETTINGS[k] if k < len(SETTINGS) else ','},,{0.1 * k:.1f},{k % 5},\n" for k in range(30)),
        "column_2",
    ),
    "x-axis": (
        "x-axis,1\nsecond,Volt\n" + "".join(f"{0.1 * k:+.3E},{k % 5:+.2E}\n" for k in range(30)),
        "x_1",
    ),
}


@pytest.mark.parametrize("kind", SCOPES)
def test_oscilloscopes_write_their_settings_above_or_to_the_left(kind: str, tmp_path: Path) -> None:
    text, name = SCOPES[kind]
    (tmp_path / "scope.csv").write_text(text, encoding="utf-8")
    read = read_recordings(tmp_path / "scope.csv")
    assert read.names == (name,) and read.values.ravel().tolist() == [k % 5 for k in range(30)]
    np.testing.assert_allclose(read.t, 0.1 * np.arange(30))


def test_rows_without_a_value_are_no_settings(tmp_path: Path) -> None:
    rows = "".join(f"{k},{k % 5 if k > 2 else ''}\n" for k in range(30))
    (tmp_path / "late.csv").write_text("t,x\n" + rows, encoding="utf-8")
    read = read_recordings(tmp_path / "late.csv")
    assert read.names == ("x",) and read.values.ravel().tolist() == [k % 5 for k in range(3, 30)]


def test_tables_below_each_other_repeat_their_headings(tmp_path: Path) -> None:
    path = tmp_path / "all.csv"
    path.write_text("t [s],x\n0,1\n1,2\nt [s],x\n0,3\n1,4\n", encoding="utf-8")
    read = read_recordings(path)
    assert read.values.ravel().tolist() == [1, 2, 3, 4] and read.recording.tolist() == [0, 0, 1, 1]


def test_packed_text_is_read(tmp_path: Path) -> None:
    packed = gzip.compress(b"t,x\n0,1\n1,3\n2,2\n")
    (tmp_path / "small.csv.gz").write_bytes(packed)
    assert read_recordings(tmp_path / "small.csv.gz").values.ravel().tolist() == [1, 3, 2]
    (tmp_path / "torn.csv.gz").write_bytes(packed[:20])
    with pytest.raises(InputError, match="cannot be unpacked"):
        read_recordings(tmp_path / "torn.csv.gz")
