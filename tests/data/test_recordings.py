from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet
from scipy.io import savemat

from siq.data.recordings import (
    Recordings,
    read_recordings,
    snapshot_pairs,
    write_recordings,
)
from siq.errors import InputError
from siq.remarks import sentence


def recordings(seed: int = 0, lengths: tuple[int, ...] = (3, 1, 5, 2)) -> Recordings:
    generator = np.random.default_rng(seed)
    count = sum(lengths)
    return Recordings(
        names=("x", "y"),
        units=("mm", None),
        labels=tuple(f"r{index:02d}" for index in range(len(lengths))),
        recording=np.repeat(np.arange(len(lengths)), lengths),
        t=np.concatenate([np.cumsum(generator.uniform(0.1, 0.2, length)) for length in lengths]),
        values=generator.normal(size=(count, 2)),
        time_unit="s",
    )


def assert_identical(left: Recordings, right: Recordings) -> None:
    for field in dataclasses.fields(Recordings):
        ours, theirs = getattr(left, field.name), getattr(right, field.name)
        if isinstance(ours, np.ndarray):
            assert ours.dtype == theirs.dtype and ours.shape == theirs.shape
            assert ours.tobytes() == theirs.tobytes(), field.name  # -0.0 and 0.0 are not the same
        else:
            assert ours == theirs


def frame(source: Recordings) -> pd.DataFrame:
    table = pd.DataFrame(source.values, columns=list(source.names))
    return table.assign(t=source.t, recording=np.array(source.labels)[source.recording])


def write_csv(folder: Path, text: str) -> Path:
    path = folder / "table.csv"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(path: Path, **options: object) -> InputError:
    with pytest.raises(InputError) as caught:
        read_recordings(path, **options)  # type: ignore[arg-type]
    assert str(caught.value).startswith(str(path))
    assert caught.value.remedy and str(caught.value).endswith(f"; {caught.value.remedy}.")
    return caught.value


@pytest.mark.parametrize("seed", range(5))
def test_a_round_trip_is_exact_and_deterministic(tmp_path: Path, seed: int) -> None:
    bits = np.random.default_rng(seed).integers(0, 2**64, size=(11, 2), dtype=np.uint64)
    values = np.where(np.abs(bits.view(float)) < 1e100, bits.view(float), -0.0)
    values[0] = [-0.0, 5e-324]
    ours = dataclasses.replace(recordings(seed), values=values, labels=("07", "α", "r [mm]", "3.0"))
    write_recordings(tmp_path / "a.parquet", ours)
    write_recordings(tmp_path / "b.parquet", ours)
    assert_identical(read_recordings(tmp_path / "a.parquet"), ours)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.parquet", "b.parquet"]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_the_disk(table: pa.Table, file: Path, **options: object) -> None:
        file.write_bytes(b"PAR1")
        raise OSError("no space left")

    path = tmp_path / "a.parquet"
    write_recordings(path, recordings())
    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space"):
        patch.setattr(parquet, "write_table", fill_the_disk)
        write_recordings(path, recordings(seed=1))
    assert_identical(read_recordings(path), recordings())
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ValueError, match=r"as \.parquet"):
        write_recordings(tmp_path / "a.csv", recordings())


def _write_matlab_7_3(path: Path, columns: dict[str, np.ndarray]) -> None:
    with h5py.File(path, "w", userblock_size=512, track_order=True) as file:
        file.create_group("#refs#")
        for name, values in columns.items():
            if values.dtype.kind == "U":  # MATLAB stores characters × rows, as UTF-16
                width = values.dtype.itemsize // 4
                codes = values.view(np.uint32).reshape(-1, width).T.astype(np.uint16)
                file[name] = codes
                file[name].attrs["MATLAB_class"] = np.bytes_(b"char")
            else:
                file[name] = values[None, :]
                file[name].attrs["MATLAB_class"] = np.bytes_(b"double")


def _write(path: Path, source: Recordings, kind: str) -> None:
    table = frame(source)
    columns = {name: table[name].to_numpy() for name in table}
    columns["recording"] = np.array(source.labels)[source.recording]
    match kind:
        case "parquet":
            table.to_parquet(path)
        case "categorical parquet":
            table.astype({"recording": "category"}).to_parquet(path, row_group_size=4)
        case "csv":
            table.to_csv(path, index=False)
        case "h5 columns":
            with h5py.File(path, "w", track_order=True) as file:
                for name, values in columns.items():
                    file[name] = values.astype(object) if values.dtype.kind == "U" else values[:, None]
        case "h5 compound":
            columns["recording"] = columns["recording"].astype("S")
            with h5py.File(path, "w") as file:
                file["table"] = np.rec.fromarrays(list(columns.values()), names=list(columns))
        case "mat":
            savemat(path, columns, oned_as="column")
        case "mat 7.3":
            _write_matlab_7_3(path, columns)


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [
        ("parquet", ".parquet"),
        ("categorical parquet", ".parquet"),
        ("csv", ".CSV"),
        ("h5 columns", ".h5"),
        ("h5 compound", ".hdf5"),
        ("mat", ".mat"),
        ("mat 7.3", ".mat"),
    ],
)
def test_every_format_gives_the_same_recordings(tmp_path: Path, kind: str, suffix: str) -> None:
    ours = dataclasses.replace(recordings(), units=(None, None), time_unit=None)
    _write(tmp_path / f"a{suffix}", ours, kind)
    assert_identical(read_recordings(tmp_path / f"a{suffix}"), ours)


def test_rows_of_one_recording_need_not_stand_together(tmp_path: Path) -> None:
    ours = dataclasses.replace(recordings(), units=(None, None), time_unit=None)
    table = frame(ours)
    order = np.argsort(ours.t, kind="stable")
    table.iloc[order].to_parquet(tmp_path / "a.parquet", index=False)
    mixed = read_recordings(tmp_path / "a.parquet")
    assert mixed.labels == tuple(dict.fromkeys(table["recording"].iloc[order]))
    back = mixed.select([mixed.labels.index(label) for label in ours.labels])
    assert_identical(back, ours)


@pytest.mark.parametrize("labels", [[7, 7, 3], [7.0, 7.0, 3.0], ["7", " 7", "3 "]])
def test_labels_become_text(tmp_path: Path, labels: list[object]) -> None:
    table = pd.DataFrame({"recording": labels, "t": [0, 1, 0], "x": [True, False, True]})
    table.to_parquet(tmp_path / "a.parquet")
    table.to_csv(tmp_path / "a.csv", index=False)
    read = read_recordings(tmp_path / "a.parquet")
    assert read.labels == ("7", "3") and read.recording.tolist() == [0, 0, 1]
    assert read.values.tolist() == [[1.0], [0.0], [1.0]]


def test_many_categories_with_small_codes(tmp_path: Path) -> None:
    labels = [f"{index:03d}" for index in range(128)]
    table = pd.DataFrame({"recording": np.repeat(labels, 2), "t": np.tile([0.0, 1.0], 128), "x": 0.0})
    table.astype({"recording": "category"}).to_parquet(tmp_path / "a.parquet")
    assert read_recordings(tmp_path / "a.parquet").labels == tuple(labels)


def test_columns_are_chosen_and_ordered_by_the_caller(tmp_path: Path) -> None:
    path = write_csv(tmp_path, "note,y,t,x,recording\nstart,2,0,1,a\nend,4,1,3,a\n")
    read = read_recordings(path, columns=["x", "y"])
    assert read.names == ("x", "y") and read.values.tolist() == [[1, 2], [3, 4]]
    error = refusal(path)
    assert error.place == "row 1, column note" and "'start' is no number" in error.fault
    with pytest.raises(ValueError, match="distinct"):
        read_recordings(path, columns=["x", "x"])


def test_units_come_from_names_metadata_and_cells(tmp_path: Path) -> None:
    csv = write_csv(tmp_path, "recording,t [s],x [µm],y,z\na,0,1,1.5 mm,1\na,1,2,2e-1mm,2\n")
    hdf5 = tmp_path / "table.h5"
    with h5py.File(hdf5, "w") as file:
        file["recording"], file["t"], file["x [µm]"], file["y"] = [1, 1], [0.0, 1.0], [1.0, 2.0], [1.5, 0.2]
        file["y"].attrs["unit"], file["t"].attrs["units"] = "mm", b"s"
    write_recordings(tmp_path / "table.parquet", read_recordings(csv))
    for path in (csv, hdf5, tmp_path / "table.parquet"):
        read = read_recordings(path, columns=["x", "y"], units={"t": "s", "x": "μm", "y": "mm"})
        assert (read.units, read.time_unit) == (("µm", "mm"), "s")
        assert read.values.tolist() == [[1, 1.5], [2, 0.2]]
    assert read_recordings(csv, units={"z": "m"}).units == ("µm", "mm", None)
    assert "card has ms" in refusal(csv, units={"t": "ms"}).fault


@pytest.mark.parametrize(
    ("heading", "unit"),
    [("year", "year"), ("day", "day"), ("Hours", "Hours"), ("frame", None), ("no. of frame", None)],
)
def test_a_clock_is_known_by_its_unit_or_by_its_even_steps(
    tmp_path: Path, heading: str, unit: str | None
) -> None:
    rows = [(10.0 * k + 30 * (k > 7), np.sin(k)) for k in range(400)]  # with a gap
    path = tmp_path / "clock.csv"
    path.write_text(f"x,{heading}\n" + "".join(f"{x},{t}\n" for t, x in rows), encoding="utf-8")
    read = read_recordings(path)
    assert read.names == ("x",) and read.t[:2].tolist() == [0, 10]
    assert (read.time_unit is None) == (unit is None)
    assert "data.time_column" in {one.code for one in read.remarks}


@pytest.mark.parametrize(
    ("text", "place", "fault", "remedy"),
    [
        ("recording,q,x\na,0,1\na,1,2\n", "", "'t' is missing", "add the time of every sample"),
        ("recording,t,x,\na,0,1,4\na,1,2,7.5\n", "column 4", "has no name", "name it"),
        ("recording,t\na,0\na,1\n", "", "no measured column", "add one"),
        ("recording,t,x,x [m]\na,0,1,2\n", "column x", "stands twice", "rename"),
        ("recording,t,x\n", "", "has no rows", "at least two samples"),
        ("recording,t,x\na,0,1\na,1\n", "row 2", "2 cells while the header has 3", "one cell per column"),
        ("recording,t,x\na,0,1\na,NaN,2\n", "row 2, column t", "missing", "remove the row"),
        ("recording,t,x\na,inf,1\na,1,2\n", "row 1, column t", "infinite", "finite"),
        ("recording,t,x\na,0,1\na,1,-1e999\n", "row 2, column x", "infinite", "finite"),
        ("t,x\n0,1\n1,-1e7\n2,1e150\n3,\n", "row 3, column x", "beyond 10¹⁰⁰", "simulation ran away"),
        ("recording,t,x\na,0,1\n,1,2\n", "row 2, column recording", "label is missing", "label"),
        (
            'recording,t,x\na,0,1\na,1,"2,5"\n',
            "row 2",
            "'2,5' has a mark between thousands, or a decimal comma",
            "decimal point",
        ),
        ("recording,t,x\na,0,1\na,noon,2\na,2,n/a!\n", "row 2, column t", "'noon' is no number", "number"),
        ("recording,t,x,y\na,0,1,\na,1,z,2\n", "row 2, column x", "'z' is no number", "remove the row"),
        ("recording,t,x\na,0,1 mm\na,1,2 cm\na,2,\n", "row 2, column x", "mixed units, cm", "one unit"),
        ("recording,t,x\na,0,1 mm\na,1,2\n", "row 2, column x", "no unit after rows in mm", "one unit"),
        ("recording,t,x [m]\na,0,1 mm\na,1,2 mm\n", "column x", "m in the name but mm in the cells", "one"),
        ("recording,t,x\na,0,1\nb,0,1\na,0,2\n", "row 3, column t", "is repeated (row 1 has it", "keep one"),
        ("recording,t,x\na,2,1\nb,0,1\na,1,2\nb,0,1\n", "row 3, column t", "1.0 comes after 2.0", "sort"),
        ("recording,t,x\na,0,1\nb,1,1\n", "", "no recording has two samples", "the same label"),
    ],
)
def test_tables_are_refused_by_row_and_column(
    tmp_path: Path, text: str, place: str, fault: str, remedy: str
) -> None:
    error = refusal(write_csv(tmp_path, text))
    assert error.place == place
    assert fault in error.fault and remedy in error.remedy


def test_missing_columns_and_other_units_are_refused_by_name(tmp_path: Path) -> None:
    path = write_csv(tmp_path, "recording,t,position [cm],speed\na,0,1,1\na,1,2,2\n")
    error = refusal(path, columns=["positon"])
    assert "'positon' is missing" in error.fault and error.remedy == "perhaps you meant 'position'"
    assert refusal(path, columns=["q"]).remedy == "the measured columns are position, speed"
    error = refusal(path, units={"position": "mm"})
    assert error.place == "column position" and "cm where the system card has mm" in error.fault
    assert "convert the column to mm" in error.remedy


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".h5", ".hdf5", ".mat"])
def test_unreadable_files_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    assert "No such file" in refusal(path).fault
    path.touch()
    assert refusal(path).fault == "the file is empty"
    path.write_bytes(bytes(range(256)) * 8)
    assert refusal(path).fault
    path.unlink()
    path.mkdir()
    assert "the folder holds no recordings" in refusal(path).fault


@pytest.mark.parametrize("kind", ["parquet", "h5 columns", "mat"])
def test_truncated_files_are_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a.{kind.split()[0]}"
    _write(path, recordings(), kind)
    path.write_bytes(path.read_bytes()[:-100])
    assert "cannot be read as" in refusal(path).fault


def test_an_unknown_suffix_is_refused(tmp_path: Path) -> None:
    error = refusal(tmp_path / "a.pkl")
    assert "'.pkl' is unknown" in error.fault and ".parquet" in error.remedy


def test_columns_that_are_no_vectors_are_refused(tmp_path: Path) -> None:
    good = {"recording": [1.0, 1.0], "t": [0.0, 1.0], "x": [1.0, 2.0]}
    path = tmp_path / "a.mat"
    for bad, words in [
        ({"gain": 1.0}, "a MATLAB struct"),
        (np.array([1.0, "b"], dtype=object), "a MATLAB cell"),
        (np.array([1j, 2.0]), "complex"),
        (np.eye(2), "shape 2 × 2"),
        ([1.0, 2.0, 3.0], "3 rows while column recording has 2"),
    ]:
        savemat(path, {**good, "y": bad})
        error = refusal(path)
        assert error.place == "column y" and words in error.fault
        assert read_recordings(path, columns=["x"]).names == ("x",)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.update(good)
        file.create_group("y")
    error = refusal(tmp_path / "a.h5")
    assert error.place == "column y" and "a group" in error.fault


def test_columns_of_other_types_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    whole = {"recording": "a", "t": [0, 1], "x": [1, 2]}
    for name, cells, words in [
        ("x", pd.to_datetime([0, 1]), "timestamp"),
        ("t", np.array([2**53, 2**53 + 1]), "too large"),
    ]:
        pd.DataFrame(whole | {name: cells}).to_parquet(path)
        error = refusal(path)
        assert error.place == f"column {name}" and words in error.fault
    table = pa.table({"recording": [[1], [2]], "t": [0, 1], "x": [1, 2]})
    parquet.write_table(table, path)
    assert refusal(path).place == "column recording"


def test_pairs_are_consecutive_samples_of_one_recording() -> None:
    ours = recordings()
    pairs = snapshot_pairs(ours, pair_step=np.inf)
    assert pairs.recording.tolist() == [0, 0, 2, 2, 2, 2, 3]
    rows = [0, 1, 4, 5, 6, 7, 9]
    np.testing.assert_array_equal(pairs.x0, ours.values[rows])
    np.testing.assert_array_equal(pairs.xh, ours.values[np.add(rows, 1)])
    np.testing.assert_array_equal(pairs.h, ours.t[np.add(rows, 1)] - ours.t[rows])


def test_pairs_do_not_depend_on_the_order_of_recordings() -> None:
    ours = recordings()
    expected = snapshot_pairs(ours, pair_step=0.17)

    def rows(pairs: object) -> set[bytes]:
        return {np.r_[x0, xh, h].tobytes() for x0, xh, h in zip(pairs.x0, pairs.xh, pairs.h, strict=True)}  # type: ignore[attr-defined]

    for order in itertools.islice(itertools.permutations(range(4)), 1, None, 5):
        pairs = snapshot_pairs(ours.select(order), pair_step=0.17)
        assert rows(pairs) == rows(expected) and len(pairs.h) == len(expected.h)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_pair_step_forgives_rounding_only(start: float) -> None:
    t = start + np.array([0, 1, 2, 3, 5, 6]) * 0.1
    ours = dataclasses.replace(
        recordings(lengths=(6,)), t=t, values=np.arange(12.0).reshape(6, 2), recording=np.zeros(6, int)
    )
    assert snapshot_pairs(ours, pair_step=0.1).x0[:, 0].tolist() == [0, 2, 4, 8]
    with pytest.raises(ValueError, match=r"at most pair_step = 0\.099 apart"):
        snapshot_pairs(ours, pair_step=0.099)
    with pytest.raises(ValueError, match="must be positive"):
        snapshot_pairs(ours, pair_step=0.0)


def test_resampling_draws_whole_recordings() -> None:
    ours = recordings(lengths=(3, 1, 5, 2, 4, 2, 6, 3))
    drawn = ours.resampled(generator=np.random.default_rng(3))
    assert_identical(drawn, ours.resampled(generator=np.random.default_rng(3)))
    assert len(drawn.labels) == len(set(drawn.labels)) == 8
    assert any("#2" in label for label in drawn.labels)
    for index, label in enumerate(drawn.labels):
        mine, theirs = drawn.recording == index, ours.recording == ours.labels.index(label.split("#")[0])
        np.testing.assert_array_equal(drawn.values[mine], ours.values[theirs])
        np.testing.assert_array_equal(drawn.t[mine], ours.t[theirs])


def test_copies_never_take_a_label_that_exists() -> None:
    ours = dataclasses.replace(recordings(lengths=(2, 2)), labels=("a", "a#2"))
    assert ours.select([0, 0, 1, 0, 1]).labels == ("a", "a#3", "a#2", "a#4", "a#2#2")


@pytest.mark.parametrize("indices", [[], [4], [-1], [True, False, True, True], [0.0]])
def test_a_selection_is_of_existing_recordings(indices: list[float]) -> None:
    with pytest.raises(ValueError, match="select"):
        recordings().select(indices)  # type: ignore[arg-type]


def test_a_table_in_memory_is_read_as_the_same_file_is(tmp_path: Path) -> None:
    original = recordings()
    path = tmp_path / "table.parquet"
    write_recordings(path, original)
    table = frame(original).rename(columns={"x": "x [mm]"})
    table.attrs["units"] = {"t": "s"}
    assert_identical(Recordings.from_frame(table), read_recordings(path))
    indexed = table.set_index(["recording", "t"])
    assert_identical(Recordings.from_frame(indexed), read_recordings(path))
    assert Recordings.from_frame(table, units={"y": "m"}).units == ("mm", "m")
    chosen = Recordings.from_frame(table, columns=["y"])
    assert_identical(chosen, read_recordings(path, columns=["y"]))


def test_a_table_in_memory_is_refused_for_what_a_file_is() -> None:
    table = frame(recordings()).drop(columns="recording").iloc[:3]
    assert Recordings.from_frame(table).labels == ("0",)
    with pytest.raises(InputError, match="the table: no row has a value in every column"):
        Recordings.from_frame(table.assign(x=[1.0, np.nan, np.nan], y=[np.nan, 1.0, 1.0]))
    with pytest.raises(InputError, match="the table: the column 't' is missing"):
        Recordings.from_frame(table.drop(columns="t"))
    with pytest.raises(InputError, match="the unit is mm"):
        Recordings.from_frame(table.rename(columns={"x": "x [mm]"}), units={"x": "m"})
    with pytest.raises(InputError, match="column x"):
        Recordings.from_frame(table.assign(x=[1.0, "a", [2.0]]))


def test_arrays_become_recordings_of_one_or_of_different_lengths() -> None:
    original = recordings(lengths=(3, 4, 5))
    bounds = [0, 3, 7, 12]
    t = [original.t[a:b] for a, b in itertools.pairwise(bounds)]
    values = [original.values[a:b] for a, b in itertools.pairwise(bounds)]
    ours = Recordings.from_arrays(t, values, names=["x", "y"], units=["mm", None], time_unit="s")
    assert_identical(ours, dataclasses.replace(original, labels=("0", "1", "2")))
    stacked = np.stack([part[:3] for part in values])
    assert len(Recordings.from_arrays(t[0], stacked, names=["x", "y"]).t) == 9
    assert Recordings.from_arrays(t[0], values[0], names=["x", "y"]).labels == ("0",)


def test_arrays_that_do_not_fit_are_refused() -> None:
    t, x = np.arange(4.0), np.zeros((2, 4, 1))
    with pytest.raises(ValueError, match="recording 0 has values of shape"):
        Recordings.from_arrays(t, x, names=["x", "y"])
    with pytest.raises(ValueError, match="times of 1 recordings and values of 2"):
        Recordings.from_arrays([t], x, names=["x"])
    with pytest.raises(ValueError, match="recording 1 holds numbers that are not finite"):
        Recordings.from_arrays(t, np.stack([x[0], x[0] + np.inf]), names=["x"])
    with pytest.raises(ValueError, match="not distinct"):
        Recordings.from_arrays(t, x, names=["t"])
    with pytest.raises(ValueError, match="2 units for 1 states"):
        Recordings.from_arrays(t, x, names=["x"], units=["m", "s"])
    with pytest.raises(InputError, match="the times of recording '1' are unsorted"):
        Recordings.from_arrays([t, t[::-1]], x, names=["x"])


def test_by_default_a_gap_is_no_pair_and_jitter_no_gap() -> None:
    t = np.array([0.0, 0.1, 0.21, 0.3, 0.5, 0.6, 3.0, 3.1])  # one sample is missing, and then a break
    values, recording = np.arange(16.0).reshape(8, 2), np.zeros(8, int)
    ours = dataclasses.replace(recordings(lengths=(8,)), t=t, values=values, recording=recording)
    np.testing.assert_array_equal(snapshot_pairs(ours).h.round(2), [0.1, 0.11, 0.09, 0.1, 0.1])


def test_long_steps_of_uneven_samples_are_pairs() -> None:
    """Of images that clouds hide half of, and of samples taken as they came; not the breaks of bursts."""
    generator = np.random.default_rng(0)
    clouds = np.flatnonzero(generator.random(4000) < 0.5).astype(float)
    uneven = np.cumsum(generator.exponential(1.0, 2000))
    bursts = (20.0 * np.arange(300)[:, None] + np.arange(3)).ravel()
    for t, share in ((clouds, 0.88), (uneven, 0.95), (bursts, 2 / 3)):
        recordings = Recordings.from_arrays(t, np.zeros((len(t), 1)), names=["x"])
        assert len(snapshot_pairs(recordings)) == pytest.approx(share * len(t), rel=0.05)


def test_other_clocks_and_labels_are_no_states() -> None:
    t, x = np.arange(60.0), np.random.default_rng(0).standard_normal(60)
    table = pd.DataFrame({"t": t, "x": x, "age": 1000 - 10 * t, "state": (x > 0).astype(float)})
    found = Recordings.of(table)
    assert found.names == ("x",)
    assert any("'age' runs along with the time" in note for note in found.notes)
    assert any("'state' has only 2 different values" in note for note in found.notes)
    assert Recordings.of(table[["t", "state"]]).names == ("state",)
    # The depth of a core and the days of its samples never turn back; nor does a cooling beside a swing.
    core = table[["t", "x"]].assign(depth=50 - t + 0.3 * np.sin(t), day=t // 4)
    assert Recordings.of(core).names == ("x",)
    assert Recordings.of(core.assign(x=np.cos(t / 5))).names == ("x", "depth", "day")


def test_copies_of_a_column_and_columns_that_are_mostly_empty_are_no_states() -> None:
    x = np.cumsum(np.random.default_rng(0).standard_normal(40))
    seldom = np.where(np.arange(40) % 5 == 2, 2 * x, np.nan)
    table = pd.DataFrame({"t": np.arange(40.0), "x": x, "before": np.roll(x, 3), "again": x, "grab": seldom})
    table = table.iloc[3:]
    read = read_recordings(table)
    assert read.names == ("x",) and len(read.t) == 37
    told = " ".join(sentence(one) for one in read.remarks)
    assert "'before' copies 'x'" in told and "'again' copies 'x'" in told and "given of grab" in told
    assert read_recordings(table, columns=["x", "before"]).names == ("x", "before")
    with pytest.raises(InputError, match="as in 23 more rows"):
        read_recordings(table, columns=["x", "grab"])


def test_of_several_clocks_the_one_that_tells_rows_apart_is_the_time() -> None:
    month = np.arange(36)
    years, x = 1950 + month // 12, np.random.default_rng(0).standard_normal(36)
    table = pd.DataFrame({"year": years, "dec year": 1950 + month / 12, "x": x})
    assert Recordings.of(table).names == ("x",)  # the year stands still for twelve months
    table = pd.DataFrame({"Date": 100 * years + month % 12 + 1, "Year": 1950 + month / 12, "x": x})
    np.testing.assert_allclose(Recordings.of(table).t, 1950 + month / 12)  # the other one leaps at New Year
    hours = pd.date_range("2013-01-01", periods=36, freq="h").strftime("%Y-%m-%dT%H:%M:%SZ")
    assert Recordings.of(pd.DataFrame({"time_hour": hours, "x": x})).time_unit == "s"
