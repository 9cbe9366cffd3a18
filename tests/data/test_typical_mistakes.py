"""Each file as somebody would bring it: it is read, and what was assumed is said; or one sentence helps."""

from __future__ import annotations

import dataclasses
import io
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from siq.data.correlation import decimals_of, noise_floors, resolution_step, rounding_error
from siq.data.inspection import inspect as inspect_recordings
from siq.data.layout import RESERVED, _is_error, is_unit, read_heading, usable_name
from siq.data.preparation import FEWEST_STRETCHES, _checked_for_learning, in_stretches, joined, read_pairs
from siq.data.recordings import Recordings, read_recordings, write_recordings
from siq.errors import InputError
from siq.remarks import sentence
from siq.systems.cards import check_name
from siq.systems.formulas import CONSTANTS, FUNCTIONS
from siq.workflow.pipeline import draw_run, identify_run, source_of
from siq.workflow.study import PipelineSettings
from siq.workflow.tables import Status


def put(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


GERMAN = "recording;t (s);bead x (µm)\na;0,0;1,5\na;0,5;1,25\n"
# One line each, or two: a table to be read down.
READ: dict[str, tuple[str, str | bytes, tuple[str, ...], list[list[float]], str]] = {
    # what: (name, content, names, values, what is said of it)
    "a German Excel": ("a.csv", GERMAN, ("bead_x",), [[1.5], [1.25]], "semicolons, and decimals by a comma"),
    "latin-1": ("a.csv", GERMAN.encode("latin-1"), ("bead_x",), [[1.5], [1.25]], "Windows-1252"),
    "a byte order mark": ("a.csv", b"\xef\xbb\xbft,x\r\n0,1\r\n1,2\r\n", ("x",), [[1], [2]], ""),
    "UTF-16": ("a.csv", "t\tx\n0\t1,5\n1\t2\n".encode("utf-16"), ("x",), [[1.5], [2]], "UTF-16"),
    "tabs": ("a.txt", "t\tx\n0\t1\n1\t2\n", ("x",), [[1], [2]], "separated by tabs"),
    "spaces": ("a.dat", "  t (s)   x (mm)\n 0   1.5\n 1  2\n", ("x",), [[1.5], [2]], "separated by spaces"),
    "a sampling rate": (
        "a.txt", "# Sampling Rate (Hz):= 50.00\n# Labels:= EEG\n" + "3\n1\n" * 8,
        ("EEG",), [[3], [1]] * 8, "the line 'Sampling Rate (Hz):= 50.00'",
    ),
    "days as numbers": (
        "a.csv", "date,x\n19580329,3\n19580405,1\n19580412,2\n", ("x",), [[3], [1], [2]],
        "days since the first, 1958-03-29",
    ),
    "a line sep=;": ("a.csv", "sep=;\nt;x\n0;1,5\n1;2\n", ("x",), [[1.5], [2]], "semicolons"),
    "comments above": ("a.csv", "# a logger, 7\n" * 3000 + "t,x\n0,1\n1,2\n", ("x",), [[1], [2]], ""),
    "numpy.savetxt": ("a.txt", "# t x y\n0 1 3\n1 2 4\n", ("x", "y"), [[1, 3], [2, 4]], "spaces"),
    "savetxt, units below": (
        "a.txt", "# t x\n# units: s V\n0 1\n1 2\n", ("x",), [[1], [2]], "separated by spaces",
    ),
    "no headings": (
        "a.csv", "".join(f"{k},{k * k}\n" for k in range(12)), ("column_2",), [[k * k] for k in range(12)],
        "called by their numbers; name them in a first line",
    ),
    "LabVIEW": (
        "a.lvm", "LabVIEW Measurement\nSeparator\tTab\n***End_of_Header***\t\n\nChannels\t1\nSamples\t2\n"
        "***End_of_Header***\t\t\nX_Value\tVoltage\tComment\n0\t1\n1\t2\n", ("Voltage",), [[1], [2]],
        "'X_Value' is the time",
    ),
    "a line of units": ("a.csv", "Time,X\n[s],[µm]\n0,1\n1,2\n", ("X",), [[1], [2]], "read as the units"),
    "other words": ("a.csv", "run,Time,x\nA,0,1\nA,1,2\n", ("x",), [[1], [2]], "'run' says which recording"),
    "the day of each week": (
        "a.csv", "week_start,cases\n2024-01-01,7\n2024-01-08,5\n2024-01-15,6\n", ("cases",), [[7], [5], [6]],
        "'week_start' is the time",
    ),
    "years": (
        "a.csv", "decimal_year,x\n2001.04,1\n2001.09,2\n2001.13,4\n", ("x",), [[1], [2], [4]],
        "'decimal_year' is the time",
    ),
    "a time in ms": ("a.csv", "time_ms,x\n0,1\n1,2\n", ("x",), [[1], [2]], "'time' is the time"),
    "x(t), lambda, exp": (
        "a.csv", "t,x(t),lambda,exp\n0,1,3,5\n1,2,4,6\n", ("x", "lambda_", "exp_"), [[1, 3, 5], [2, 4, 6]],
        "'lambda' is called lambda_ in formulas",
    ),
    "a pandas index": (
        "a.csv", ",t,x\n0,0,1\n1,1,2\n", ("x",), [[1], [2]], "counts the rows and was left out",
    ),
    "a second clock": (
        "a.csv", "t,Time (ms),x\n0,0,1\n1,1000,2\n", ("x",), [[1], [2]], "looks like a second",
    ),
    "a temperature T": ("a.csv", "t,x,T\n0,1,3\n1,2,4\n", ("x", "T"), [[1, 3], [2, 4]], ""),
    "missing values": (
        "a.csv", "t,x\n0,1\n1,\n2,3\n3,4\n4,\n5,5\n", ("x",), [[1], [3], [4], [5]],
        "2 rows in which a value is missing were left out",
    ),
    "missing ends": ("a.csv", "t,x\n0,\n1,1\n2,2\n3,nan\n", ("x",), [[1], [2]], "2 rows with missing values"),
    "empty rows": ("a.csv", "recording,t,x\na,0,1\na,1,2\n,,\n,,\n", ("x",), [[1], [2]], "2 empty rows"),
    "empty columns": ("a.csv", "t,x,\n0,1.5,\n1,2,\n", ("x",), [[1.5], [2]], ""),
    "dates": (
        "a.csv", "time,x\n2024-01-01 12:00:00,1\n2024-01-01 12:00:01,2\n", ("x",), [[1], [2]], "seconds",
    ),
    "German dates": (
        "a.csv", "Zeit;x\n31.12.2024 12:00:00;1\n31.12.2024 12:00:01;2\n", ("x",), [[1], [2]], "sec",
    ),
    "times of day": (
        "a.csv", "time,x\n12:00:00,1\n12:00:01,2\n", ("x",), [[1], [2]], "since the first, 12:00:00",
    ),
    "rows twice": ("a.csv", "t,x\n0,1\n0,1\n1,2\n", ("x",), [[1], [2]], "one row stood twice"),
}  # fmt: skip


@pytest.mark.parametrize("what", READ)
def test_what_is_meant_clearly_is_read_and_what_was_assumed_is_said(tmp_path: Path, what: str) -> None:
    name, content, names, values, said = READ[what]
    read = read_recordings(put(tmp_path, name, content))
    assert (read.names, read.values.tolist(), read.t[1] - read.t[0]) == (names, values, read.t[1] - read.t[0])
    assert said in "; ".join(read.notes)
    assert bool(said) == bool(read.notes)


REFUSED: dict[str, tuple[str, str | bytes, str, str]] = {
    # what: (name, content, fault, remedy)
    "two meanings of a comma": ("a.csv", "t,x\n0,5,1,25\n1,0,2,5\n", "rows have 4 cells", "decimal points"),
    "points between thousands": (
        "a.csv", "t;x\n0;1.234,5\n1;2,0\n", "a mark between thousands", "without marks",
    ),
    "thousands in quotation marks": (
        "a.csv", 't,x\n0,"1,234"\n1,"1,240"\n', "a mark between thousands", "decimal point",
    ),
    "two decimal marks": (
        "a.csv", "t;x\n0;1,5\n1;1.2\n", "with commas ('1,5') and with points", "the same way",
    ),
    "no headings": ("a.csv", "0,1\n1,2\n", "where the headings should stand", "such as t,x"),
    "mostly missing values": (
        "a.csv", "t,x\n0,1\n1,\n2,\n3,\n4,5\n", "missing (empty or NaN), as in 2 more", "remove",
    ),
    "no common row": ("a.csv", "t,x,y\n0,1,\n1,,2\n2,3,\n", "no row has a value in every", "interpolate"),
    "no headings, and no clock": (
        "a.csv", "3,1\n1,2\n" * 6, "the column 't' is missing", "the time of every sample",
    ),
    "a rate without a unit": (
        "a.txt", "# fs = 50\n" + "3\n1\n" * 8, "the column 't' is missing", "unit into the line 'fs = 50'",
    ),
    "no time": ("a.csv", "x,y\n1,2\n2,3\n", "the column 't' is missing", "the time of every sample"),
    "two clocks": (
        "a.csv", "time,Time (ms),x\n0,0,1\n1,9,2\n", "'time' and 'Time (ms)' all look", "call the right",
    ),
    "a date of two kinds": ("a.csv", "time,x\n1/2/2024,1\n2/2/2024,2\n", "read in two ways", "2024-12-31"),
    "a step back": (
        "a.csv", "t,x\n0,1\n1,2\n2,3\n1.5,2\n3,4\n", "unsorted (1.5 comes after 2.0)", "sort its rows",
    ),
    "the end of summer time": (
        "a.csv",
        "time,x\n2024-10-27 01:20,1\n2024-10-27 01:40,2\n2024-10-27 02:00,3\n2024-10-27 02:20,2\n"
        "2024-10-27 02:40,3\n2024-10-27 02:00,2\n2024-10-27 02:20,4\n",
        "as where clocks go back an hour", "write the offset from UTC",
    ),
    "other numbers": (
        "a.csv", "t,x,y\n0,1,1'234.5\n1,2,1'200.1\n", "'1'234.5' is no number", "name the states in",
    ),
    "Excel": ("a.xlsx", b"PK\x03\x04....", "it is a spreadsheet", "save the sheet as CSV"),
    "Excel, renamed": ("a.csv", b"PK\x03\x04....", "it is a spreadsheet", "save the sheet as CSV"),
    "a binary file": ("a.csv", b"t,x\n\0\0\0", "the file is no text", "as CSV in UTF-8"),
    "JSON": ("a.json", "{}", "the suffix '.json' is unknown", "use one of .parquet, .csv"),
    "an array without names": ("a.npy", b"", "the file is empty", "write the recordings again"),
    "two of a name": ("a.csv", "t,x,x\n0,1,2\n1,2,3\n", "the column stands twice", "rename or remove"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_can_be_meant_in_two_ways_is_refused_in_one_sentence(tmp_path: Path, what: str) -> None:
    name, content, fault, remedy = REFUSED[what]
    path = put(tmp_path, name, content)
    with pytest.raises(InputError) as caught:
        read_recordings(path)
    assert fault in caught.value.fault and remedy in caught.value.remedy
    assert str(caught.value).startswith(str(path)) and str(caught.value).count("\n") == 0


def swinging(seed: int = 0, *, count: int = 4, samples: int = 40) -> Recordings:
    generator = np.random.default_rng(seed)
    t = np.cumsum(generator.uniform(0.1, 0.2, (count, samples)), axis=1).round(6)
    values = generator.normal(size=(count, samples, 2)).round(6)
    made = Recordings.from_arrays(list(t), list(values), names=["x", "y"], units=["µm", None], time_unit="s")
    return dataclasses.replace(made, labels=tuple(f"r{index}" for index in range(count)))


def table(ours: Recordings) -> pd.DataFrame:
    columns = {"recording": np.array(ours.labels)[ours.recording], "t (s)": ours.t}
    return pd.DataFrame(columns | {"x (µm)": ours.values[:, 0], "y": ours.values[:, 1]})


def padded(frame: pd.DataFrame) -> pd.DataFrame:
    pieces = []
    for label, own in frame.groupby("recording", sort=False):
        lacking = {"recording": label, "t (s)": [-2.0, -1.0], "x (µm)": [np.nan] * 2, "y": [np.nan, 1.0]}
        pieces += [pd.DataFrame(lacking), own]
    return pd.concat(pieces)


def csv(frame: pd.DataFrame, **options: object) -> bytes:
    text = io.StringIO()
    frame.to_csv(text, **({"index": False} | options))  # type: ignore[call-overload]
    return text.getvalue().encode()


SPELLINGS: dict[str, Callable[[pd.DataFrame], bytes]] = {
    "plain": csv,
    "decimal commas": lambda frame: csv(frame, sep=";", decimal=","),
    "tabs": lambda frame: csv(frame, sep="\t"),
    "tabs and commas": lambda frame: csv(frame, sep="\t", decimal=","),
    "bars": lambda frame: csv(frame, sep="|"),
    "BOM and CRLF": lambda frame: b"\xef\xbb\xbf" + csv(frame, lineterminator="\r\n"),
    "latin-1": lambda frame: csv(frame).decode().encode("latin-1"),
    "all quoted": lambda frame: csv(frame, quoting=1),
    "an index": lambda frame: csv(frame, index=True),
    "a shuffle": lambda frame: csv(frame.sample(frac=1, random_state=1)),
    "a shuffled index": lambda frame: csv(frame.sample(frac=1, random_state=1), index=True),
    "padding": lambda frame: csv(padded(frame)),
    "other names": lambda frame: csv(frame.rename(columns={"recording": "Trial", "t (s)": "Time [s]"})),
    "numbers with units": lambda frame: csv(
        frame.assign(x=[f"{value:.6f} µm" for value in frame["x (µm)"]])[["recording", "t (s)", "x", "y"]]
    ),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("seed", range(3))
def test_a_file_in_any_spelling_gives_the_same_recordings(tmp_path: Path, spelling: str, seed: int) -> None:
    ours = swinging(seed)
    read = read_recordings(put(tmp_path, "a.csv", SPELLINGS[spelling](table(ours))))
    assert (read.names, read.units, read.time_unit) == (ours.names, ours.units, ours.time_unit)
    order = [read.labels.index(label) for label in ours.labels]
    for index, own in enumerate(order):
        np.testing.assert_array_equal(read.t[read.recording == own], ours.t[ours.recording == index])
        np.testing.assert_array_equal(
            read.values[read.recording == own], ours.values[ours.recording == index]
        )


def test_names_units_titles_and_notes_survive_a_file_of_ours(tmp_path: Path) -> None:
    read = read_recordings(put(tmp_path, "a.csv", GERMAN))
    assert (read.headings, read.titles, read.units) == (("bead x",), ("bead x",), ("µm",))
    write_recordings(tmp_path / "a.parquet", read)
    again = read_recordings(tmp_path / "a.parquet")
    for field in dataclasses.fields(Recordings):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(read, field.name))


def test_states_are_found_by_title_by_name_and_in_other_case(tmp_path: Path) -> None:
    path = put(tmp_path, "a.csv", "t,Bead X,other\n0,1,3\n1,2,4\n")
    for name in ("Bead_X", "bead_x"):
        assert read_recordings(path, columns=[name]).values.tolist() == [[1], [2]]
    with pytest.raises(InputError, match="perhaps you meant 'Bead X'"):
        read_recordings(path, columns=["Beed_X"])


def test_a_folder_holds_one_recording_in_each_file(tmp_path: Path) -> None:
    for name, values in (
        ("monday.csv", "0,1\n1,2\n"),
        ("tuesday.csv", "0,3\n1,4\n2,5\n"),
        (".hidden.csv", "x"),
    ):
        put(tmp_path, name, f"t [s],x [mm]\n{values}" if name[0] != "." else values)
    put(tmp_path, "README.txt", "When this was measured")
    read = read_recordings(tmp_path)
    assert (read.labels, read.recording.tolist()) == (("monday", "tuesday"), [0, 0, 1, 1, 1])
    assert (read.units, read.time_unit, read.values.ravel().tolist()) == (("mm",), "s", [1, 2, 3, 4, 5])
    put(tmp_path, "wednesday.csv", "t [s],x [mm],y\n0,1,2\n1,2,3\n")
    with pytest.raises(
        InputError, match=r"wednesday\.csv: its columns are x, y, and those of monday\.csv are x"
    ):
        read_recordings(tmp_path)
    assert read_recordings(tmp_path, columns=["x"]).labels == ("monday", "tuesday", "wednesday")
    put(tmp_path, "wednesday.csv", "t [ms],x [mm]\n0,1\n1,2\n")
    with pytest.raises(InputError, match=r"mixed units, s in the monday\.csv but ms"):
        read_recordings(tmp_path)


def test_a_wrong_path_says_where_it_was_looked_for_and_what_is_near(tmp_path: Path) -> None:
    put(tmp_path, "recordings.csv", "t,x\n0,1\n1,2\n")
    for wrong in ("recordigns.csv", "recordings.txt", "Recordings.csv"):
        with pytest.raises(InputError) as caught:
            read_recordings(tmp_path / wrong)
        assert str(tmp_path / wrong) in caught.value.fault
        assert f"perhaps you meant '{tmp_path / 'recordings.csv'}'" in caught.value.remedy
    with pytest.raises(InputError, match=f"there is no folder '{tmp_path / 'nowhere'}' either"):
        read_recordings(tmp_path / "nowhere" / "a.csv")


def test_a_column_of_words_or_numbers_that_tells_recordings_apart_is_their_label(tmp_path: Path) -> None:
    times = range(5)
    blocks = "month,lake,TP\n" + "".join(f"{t},{lake},{t**2}\n" for lake in ("Como", "Iseo") for t in times)
    read = read_recordings(put(tmp_path, "blocks.csv", blocks))
    assert (read.names, read.labels, read.recording.tolist()) == (
        ("TP",),
        ("Como", "Iseo"),
        [0] * 5 + [1] * 5,
    )
    mixed = "day,vole,x\n" + "".join(f"{t},{vole},{t + vole / 7}\n" for t in times for vole in (3, 8))
    read = read_recordings(put(tmp_path, "mixed.csv", mixed))
    assert (read.names, read.labels, read.t.tolist()) == (("x",), ("3", "8"), [*times, *times])


def test_columns_called_like_recordings_are_some_and_numbered_states_are_not(tmp_path: Path) -> None:
    rows = [(0.1 * k, np.sin(k), np.cos(k), k % 3) for k in range(6)]
    text = "".join(",".join(map(str, row)) + "\n" for row in rows)
    read = read_recordings(put(tmp_path, "wide.csv", "t,cell 1 (nm),cell 2 (nm),cell 3 (nm)\n" + text))
    assert (read.names, read.units, read.labels) == (("x",), ("nm",), ("cell 1", "cell 2", "cell 3"))
    assert read.t.tolist() == [row[0] for row in rows] * 3
    assert read.values[:, 0].tolist() == [row[place] for place in (1, 2, 3) for row in rows]
    named = read_recordings(tmp_path / "wide.csv", columns=["cell_1", "cell_3"])
    assert named.values.tolist() == [[row[1], row[3]] for row in rows]
    states = read_recordings(put(tmp_path, "states.csv", "t,x1,x2,x3\n" + text))
    assert states.names == ("x1", "x2", "x3")


@pytest.mark.parametrize(
    "names",
    ["Jan Feb Mar Apr May Jun Jul Aug Sep Oct Nov Dec", "JAN FEB MÄR APR MAI JUN JUL AUG SEP OKT NOV DEZ"],
)
def test_months_beside_each_other_are_one_quantity_in_time(names: str, tmp_path: Path) -> None:
    x = np.sin(np.arange(36.0))
    cells = [f"{value}" for value in x]
    cells[4], cells[34:] = "", ["-99.9"] * 2
    rows = [f"{1950 + k},{','.join(cells[12 * k : 12 * k + 12])},{k}.5" for k in range(3)]
    file = put(tmp_path, "index.csv", "\n".join([f"Year,{names.replace(' ', ',')},Mean", *rows]))
    read = read_recordings(file)
    assert (read.names, read.time_unit) == (("x",), "year")
    kept = np.delete(np.arange(36), [4, 34, 35])
    np.testing.assert_allclose(read.t, 1950 + (kept + 0.5) / 12)
    np.testing.assert_allclose(read.values[:, 0], x[kept])
    assert any("left out: Mean" in sentence(one) for one in read.remarks)
    assert read_recordings(file, columns=names.split()[:3]).names == tuple(names.split()[:3])


@pytest.mark.parametrize("mark", ["-9999", "999.9", "1e36"])
def test_a_number_that_stands_for_a_missing_value_is_none(tmp_path: Path, mark: str) -> None:
    x = ["1.5", "2.5", mark, "0.5", "1.0", mark, "2.0", "1.0"]
    text = "t,x\n" + "".join(f"{t},{value}\n" for t, value in enumerate(x))
    read = read_recordings(put(tmp_path, "marks.csv", text))
    assert (read.t.tolist(), float(read.values.max())) == ([0, 1, 3, 4, 6, 7], 2.5)
    # What lies among the others was measured, and so was a state that is always the same.
    for other in ("3.5", "0", "-50"):
        kept = read_recordings(put(tmp_path, "kept.csv", text.replace(mark, other)))
        assert len(kept.t) == len(x)


def test_dates_are_days_and_times_of_day_seconds(tmp_path: Path) -> None:
    days = read_recordings(put(tmp_path, "days.csv", "date,x\n2024-02-28,1\n2024-02-29,3\n2024-03-02,2\n"))
    assert (days.t.tolist(), days.time_unit) == ([0, 1, 3], "d")
    hours = read_recordings(put(tmp_path, "hours.csv", "time,x\n2024-02-28 11:00,1\n2024-02-28 12:00,3\n"))
    assert (hours.t.tolist(), hours.time_unit) == ([0, 3600], "s")


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("Date,Time,x\n27.10.2024,23:59:50,1\n28.10.2024,00:00:00,3\n", [0, 10]),
        ("date,x\n02/03/2024 11:59:50 PM,1\n02/13/2024 12:00:00 AM,3\n", [0, 777610]),
        ("date,x\n02/03/2024 10:00,1\n13/03/2024 10:30,3\n", [0, 952200]),
        ("time,x\n01:30.000,1\n01:30.500,3\n", [0, 0.5]),
        # A date in parts; hours from 1 to 24, which end then; half past one as 130; a minimum called min.
        ("year,month,day,hour,x\n2023,12,31,23,1\n2024,1,1,0,3\n2024,1,1,3,2\n", [0, 3600, 14400]),
        ("STN,YYYYMMDD,HH,x\n9,20240228,23,1\n9,20240228,24,3\n9,20240229,1,2\n", [0, 3600, 7200]),
        ("Year,DOY,HHMM,x\n2024,60,2330,1\n2024,61,0,3\n2024,61,130,2\n", [0, 1800, 7200]),
        ("date,time,x\n20240228,2330,1\n20240229,0,3\n20240229,130,2\n", [0, 1800, 7200]),
        ("Date,Hour,x\n13/02/2024,22,1\n13/02/2024,23,3\n14/02/2024,0,2\n", [0, 3600, 7200]),
        ("YYYY MM DD hh mm x\n2024 02 28 23 50 1\n2024 02 28 23 55 3\n2024 02 29 00 00 2\n", [0, 300, 600]),
        ("datetime,year,hour,x\n2024-02-28 11:00,2024,11,1\n2024-02-28 12:00,2024,12,3\n", [0, 3600]),
        ("time,x\n23:59:40,1\n23:59:50,2\n00:00:00,3\n00:00:10,2\n", [0, 10, 20, 30]),
        # The clock was set back, or begins again: nothing tells that a day has passed.
        ("time,x\n09:00:00,1\n09:00:10,2\n08:00:00,3\n08:00:10,2\n", [0, 10, -3600, -3590]),
    ],
)
def test_clocks_as_people_write_them(tmp_path: Path, text: str, seconds: list[float]) -> None:
    read = read_recordings(put(tmp_path, "clock.csv", text))
    assert (read.names, read.t.tolist(), read.time_unit) == (("x",), seconds, "s")


@pytest.mark.parametrize(
    ("text", "names", "times", "unit"),
    [
        ("year,month,day,min\n2024,2,28,1\n2024,2,29,2\n2024,3,1,0\n", ("min",), [0, 1, 2], "d"),
        ("year,month,x\n2023,11,1\n2023,12,3\n2024,1,2\n", ("x",), [0, 1 / 12, 1 / 6], "year"),
        ("t,year,month,x\n0,2023,11,1\n1,2023,12,3\n2,2024,1,2\n", ("x",), [0, 1, 2], None),
        # The day of the year on which cherries flower is no time: each year has one.
        ("year,doy\n812,92\n815,105\n831,96\n", ("doy",), [812, 815, 831], "year"),
        ("year,month,decimal date,x\n1958,3,1958.25,1\n1958,4,1958.5,3\n", ("x",), [1958.25, 1958.5], None),
    ],
)  # fmt: skip
def test_parts_of_a_date_are_one_time(
    tmp_path: Path, text: str, names: tuple[str, ...], times: list[float], unit: str | None
) -> None:
    read = read_recordings(put(tmp_path, "parts.csv", text))
    assert (read.names, read.time_unit) == (names, unit)
    assert read.t - read.t[0] == pytest.approx(np.subtract(times, times[0]))


LOGGER = '"TOA5","CR1000","123"\n"TIMESTAMP","RECORD","T_Avg","u"\n"TS","RN","V","m/s"\n"","","Avg","Smp"\n'


@pytest.mark.parametrize(
    ("name", "head", "row", "units"),
    [
        ("buoy.txt", "#YY MM DD hh mm H W\n#yr mo dy hr mn m m\n", "2024 02 28 {:02d} 50 {} {}", (None,) * 2),
        ("logger.dat", LOGGER, '"2024-02-28 {:02d}:00:00",7,{},{}', ("V", "m/s")),
        ("gauge.rdb", "# USGS\ndatetime\tx\ty\n20d\t14n\t14n\n", "2024-02-28 {:02d}:00\t{}\t{}", (None,) * 2),
    ],
)  # fmt: skip
def test_tables_of_buoys_loggers_and_gauges(
    tmp_path: Path, name: str, head: str, row: str, units: tuple[str | None, ...]
) -> None:
    rows = [row.format(k, 0.5 * (k % 3), k % 5) for k in range(20)]
    read = read_recordings(put(tmp_path, name, head + "\n".join(rows)))
    assert read.t.tolist() == [3600.0 * k for k in range(20)] and read.units == units
    assert read.values.tolist() == [[0.5 * (k % 3), k % 5] for k in range(20)]


def test_months_are_dates(tmp_path: Path) -> None:
    read = read_recordings(put(tmp_path, "months.csv", "date,x\n2023-12,1\n2024-01,3\n2024-02,2\n"))
    assert (read.t.tolist(), read.time_unit) == ([0, 31, 62], "d")


def test_dashes_are_missing_and_minus_signs_and_exponents_are_read_as_written(tmp_path: Path) -> None:
    read = read_recordings(put(tmp_path, "signs.csv", "t,x\n0,−1.5\n1,--\n2,2.5D-01\n3,1\n4,-\n5,2\n"))
    assert (read.t.tolist(), read.values[:, 0].tolist()) == ([0, 2, 3, 5], [-1.5, 0.25, 1, 2])


def test_a_label_with_a_d_is_no_exponent(tmp_path: Path) -> None:
    text = "recording,t,x\n7d-01,0,1\n7d-01,1,3\n7d-02,0,2\n7d-02,1,1\n"
    assert read_recordings(put(tmp_path, "days.csv", text)).labels == ("7d-01", "7d-02")


def test_words_that_are_no_label_are_left_out(tmp_path: Path) -> None:
    flags = ["ok", "ok", "bad", "ok", "ok", "ok", "bad", "ok"]
    text = "t,x,flag\n" + "".join(f"{t},{t % 3},{flag}\n" for t, flag in enumerate(flags))
    read = read_recordings(put(tmp_path, "flags.csv", text))
    assert (read.names, read.labels) == (("x",), ("0",))
    assert "data.words_left_out" in {one.code for one in read.remarks}


@pytest.mark.parametrize(
    ("heading", "unit"),
    [("age (yr b2k)", "yr"), ("Age [ka BP]", "ka"), ("age_ka_BP", "ka"), ("yr BP", "yr"), ("Age", None)],
)
def test_ages_fall_as_time_goes_on(tmp_path: Path, heading: str, unit: str | None) -> None:
    text = f"{heading},d18O\n" + "".join(f"{100 + 20 * row},{row}\n" for row in range(6))
    read = read_recordings(put(tmp_path, "core.csv", text))
    assert (read.names, read.time_unit) == (("d18O",), unit)
    assert read.values[:, 0].tolist() == [5, 4, 3, 2, 1, 0] and read.t.tolist() == sorted(read.t.tolist())


def test_where_the_time_starts_over_a_recording_begins_unless_labels_say_otherwise(tmp_path: Path) -> None:
    rows = "0,1\n1,2\n2,3\n0,4\n1,5\n2,6\n"
    read = read_recordings(put(tmp_path, "a.csv", f"t,x\n{rows}"))
    assert read.labels == ("0", "1") and read.recording.tolist() == [0, 0, 0, 1, 1, 1]
    labelled = "recording,t,x\n" + "".join(f"a,{row}\n" for row in rows.split())
    with pytest.raises(InputError, match="unsorted"):
        read_recordings(put(tmp_path, "a.csv", labelled))


def test_numpy_files_are_columns_and_never_unpickled(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=[0.0, 1.0], x=[1.0, 2.0])
    np.save(tmp_path / "a.npy", np.array([(0, 1), (1, 2)], dtype=[("t", float), ("x", float)]))
    for name in ("a.npz", "a.npy"):
        assert read_recordings(tmp_path / name).values.tolist() == [[1], [2]]
    np.save(tmp_path / "b.npy", np.eye(2))
    with pytest.raises(InputError, match="one array without names"):
        read_recordings(tmp_path / "b.npy")
    np.save(tmp_path / "c.npy", np.array([{"t": 0}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read as NumPy"):
        read_recordings(tmp_path / "c.npy")


def test_reserved_names_are_those_that_formulas_refuse() -> None:
    assert {*FUNCTIONS, *CONSTANTS, "recording", "t", "delay"} == RESERVED
    for title in (
        "x",
        "bead x",
        "lambda",
        "exp",
        "2nd",
        "dx/dt",
        "ẋ",
        "µ",
        "",
        "класс",
        "x (raw)",
        "a-b",
        "%",
    ):
        check_name(usable_name(title))


@pytest.mark.parametrize(
    ("heading", "title", "unit"),
    [
        ("x [mm]", "x", "mm"), ("x (mm)", "x", "mm"), ("x / mm", "x", "mm"), ("x in mm", "x", "mm"),
        ("x, mm", "x", "mm"), ("t_s", "t", "s"), ("Time (ms)", "Time", "ms"), ("x(t)", "x", None),
        ("x(t) [nm]", "x", "nm"), ("x (raw)", "x (raw)", None), ("dx/dt", "dx/dt", None), ("v", "v", None),
        ("P (kg m^-3)", "P", "kg m^-3"), ("F (pN/µm²)", "F", "pN/µm²"), ("n (1)", "n", "1"),
    ],
)  # fmt: skip
def test_a_unit_in_brackets_is_one_and_a_word_is_not(heading: str, title: str, unit: str | None) -> None:
    assert read_heading(heading)[:2] == (title, unit)


def test_units_are_told_from_words() -> None:
    assert all(map(is_unit, ["mm", "µm/s", "m/s²", "m s^-2", "kHz", "a.u.", "%", "°C", "1/s", "arb. units"]))
    assert not any(map(is_unit, ["raw", "left", "x", "bead", "t1", "in phase", ""]))


@pytest.mark.parametrize("decimals", [0, 1, 3, 6])
def test_rounding_is_recognised_and_what_was_not_rounded_is_not(decimals: int) -> None:
    values = np.random.default_rng(decimals).normal(size=3000) * 10.0 ** (1 - decimals) * 20
    step = resolution_step(values.round(decimals))
    assert step is not None and decimals_of(step) == decimals
    assert np.std(values.round(decimals) - values) == pytest.approx(rounding_error(step), rel=0.05)
    assert resolution_step(values) is None
    assert resolution_step(np.zeros(100)) is None


def test_the_step_of_a_digitiser_is_recognised() -> None:
    counts = np.random.default_rng(0).integers(-500, 500, 20_000)
    step = resolution_step(0.3 + counts * 0.0048828125 / 3)
    assert step == pytest.approx(0.0048828125 / 3, rel=1e-6)


def noisy(sensor: float, process: float, *, step: float = 0.01, samples: int = 20_000) -> Recordings:
    generator = np.random.default_rng(7)
    kicks = generator.normal(size=samples) * np.sqrt(process * step)
    x = np.zeros(samples)
    for k in range(1, samples):
        x[k] = x[k - 1] + step * (x[k - 1] - x[k - 1] ** 3) + kicks[k]
    x += sensor * generator.normal(size=samples)
    return Recordings.from_arrays(np.arange(samples) * step, x[:, None] + 1e-3, names=["x"])


@pytest.mark.parametrize(("sensor", "process"), [(0.0, 0.1), (0.02, 0.1), (0.02, 0.0), (0.005, 0.5)])
def test_both_noises_are_estimated_at_a_glance(sensor: float, process: float) -> None:
    floors = noise_floors(noisy(sensor, process))
    assert floors is not None
    found = floors[0]
    for estimate, error, truth in (
        (found.sensor, found.sensor_error, sensor), (found.process, found.process_error, process)
    ):  # fmt: skip
        assert abs(estimate - truth) <= 4 * max(error, 0.01 * truth)
        assert (estimate > 0) == (truth > 0) or truth < 3 * error


def test_a_motion_without_noise_is_not_taken_for_noise() -> None:
    for rate in (0.3, 3.0, 20.0):
        t = np.arange(400) * 0.01
        x = np.exp(-rate * t)[:, None] * [1.0, 0.5] + np.stack([np.sin(2 * t), np.cos(3 * t)], axis=1)
        floors = noise_floors(Recordings.from_arrays(t, x, names=["x", "y"]))
        assert floors is not None
        assert all(floor.process == floor.sensor == 0 for floor in floors)


@pytest.mark.parametrize(
    ("line", "unit", "step"),
    [("Sample rate: 2.5 kHz", "ms", 0.4), ("dt = 20 ms", "ms", 20.0), ("fs (Hz),250", "s", 0.004),
     ("Sample interval,4.0e-1,s", "s", 0.4), ("sampling frequency [MHz]: 2", "us", 0.5)],
)  # fmt: skip
def test_times_follow_from_a_stated_rate(tmp_path: Path, line: str, unit: str, step: float) -> None:
    read = read_recordings(put(tmp_path, "a.txt", f"# {line}\nx,y\n" + "3,1\n1,2\n2,2\n" * 8))
    assert read.time_unit == unit and read.names == ("x", "y")
    np.testing.assert_allclose(read.t, step * np.arange(24))
    timed = put(tmp_path, "b.csv", f"# {line}\nt [h],x\n0,3\n1,1\n2,2\n")
    assert read_recordings(timed).time_unit == "h"  # a column of times is what counts


def test_a_dash_is_a_label_among_labels_and_a_missing_value_elsewhere(tmp_path: Path) -> None:
    rows = [f"{strand},{k},{k % 3},-" for strand in "+-" for k in range(9)]
    read = read_recordings(put(tmp_path, "a.csv", "\n".join(["run,t,x,y", *rows])), columns=["x"])
    assert read.labels == ("+", "-") and len(read.t) == 18
    gap = put(tmp_path, "b.csv", "t,x\n" + "".join(f"{k},{'-' if k == 5 else k % 3}\n" for k in range(20)))
    assert len(read_recordings(gap).t) == 19


def test_an_error_of_a_column_is_no_state(tmp_path: Path) -> None:
    lines = [f"{k},{np.sin(k)},{0.1 + 0.01 * np.cos(3 * k)}" for k in range(40)]
    path = put(tmp_path, "stack.csv", "\n".join(["t,d18O (per mil),Standard error (per mil)", *lines]))
    read = read_recordings(path)
    assert (read.names, read.units) == (("d18O",), ("per mil",))
    assert "'Standard error' is the error of another one" in "; ".join(read.notes)
    alone = put(tmp_path, "alone.csv", "t,std\n0,1\n1,2\n2,1.5\n")
    assert read_recordings(alone).names == ("std",)  # which is what was measured
    titles = ["t", "x", "lnCa", "CO2", "a"]
    errors = ("x_err", "lnCaErr", "sigma mean CO2", "x ±", "+/- x", "x std", "x 2σ", "Uncertainty of x")
    assert all(_is_error(each, titles) for each in errors)
    assert not any(_is_error(each, titles) for each in ("error", "sigma", "Se", "asd", "y_err"))


def test_one_relaxation_has_a_page_without_f_and_one_hopping_record_is_cut(tmp_path: Path) -> None:
    t = np.arange(500) * 0.01
    text = csv(pd.DataFrame({"recording": "a", "t": t, "x": np.exp(-t)}))
    path = put(tmp_path, "settling.csv", text)
    settings = PipelineSettings()
    drawn = draw_run(settings, source_of(path, settings), number=0).result
    found = identify_run(settings, drawn, number=0)
    assert found.result is None and found.outcome.status is Status.FAILED
    assert re.search(
        r"there is one recording, and it shows no process noise.*many starting", found.outcome.reason
    )
    hopping = noisy(0.0, 0.1)
    write_recordings(tmp_path / "hopping.parquet", hopping)
    read, _ = read_pairs(tmp_path / "hopping.parquet", states=None, units=None, pair_step=None)
    cut = in_stretches(read)
    assert len(cut.labels) >= FEWEST_STRETCHES and f"cut into {len(cut.labels)} stretches" in cut.notes[-1]
    np.testing.assert_array_equal(cut.values, read.values)
    assert in_stretches(cut) is cut
    # Of few recordings whole ones would be held out, which may be all that was in a well; ten are enough.
    long = np.cumsum(np.random.default_rng(0).normal(size=(1500, 1)), axis=0)
    times = [0.1 * np.arange(1500), 0.1 * np.arange(500)]
    few = in_stretches(Recordings.from_arrays(times, [long, long[:500]], names=["x"]))
    assert len(few.labels) >= FEWEST_STRETCHES and "there are 2 recordings; they were cut" in few.notes[-1]
    lengths = np.bincount(few.recording)
    assert lengths.sum() == 2000 and np.ptp(lengths) < 0.2 * lengths.mean()
    assert len(joined(few).labels) == 2 and in_stretches(few) is few
    ten = Recordings.from_arrays([times[1]] * 10, [long[:500]] * 10, names=["x"])
    assert in_stretches(ten) is ten
    settling = read_recordings(path)
    assert in_stretches(settling) is settling


def test_a_count_of_rows_that_were_sorted_by_something_else_is_no_state(tmp_path: Path) -> None:
    rows = sorted((k * 7 % 30, k + 1) for k in range(30))  # in the order of time, counted in another one
    text = "time,rownames,x\n" + "".join(f"{t},{count},{np.sin(t)}\n" for t, count in rows)
    assert read_recordings(put(tmp_path, "counted.csv", text)).names == ("x",)


def test_a_column_that_never_changes_is_left_out_or_refused(tmp_path: Path) -> None:
    path = put(tmp_path, "a.csv", "recording,t,x,T (°C)\na,0,1,20\na,1,2,20\nb,0,3,20\nb,1,4,20\n")
    read, _ = read_pairs(path, states=None, units=None, pair_step=None)
    assert read.names == ("x",) and "'T' is 20 in every row and was left out" in read.notes[0]
    assert inspect_recordings(path).recordings.names == ("x",)  # as the landscape in memory begins, too
    with pytest.raises(InputError, match="column T: it is 20 in every row"):
        read_pairs(path, states=["x", "T"], units=None, pair_step=None)


def test_what_looks_odd_is_said() -> None:
    t = np.arange(200) * 0.1
    angle = np.mod(t * 2, 2 * np.pi)
    turning = Recordings.from_arrays([t, t[:1]], [angle[:, None], angle[:1, None]], names=["phi"])
    said = _checked_for_learning(turning, file="a.csv", chosen=False).notes
    assert any("'phi' jumps by 2π 6 times" in note for note in said)
    assert any("a single sample" in note for note in said)
    swinging_only = Recordings.from_arrays([t, t], np.stack([np.sin(t), np.cos(t)])[..., None], names=["phi"])
    assert _checked_for_learning(swinging_only, file="a.csv", chosen=False).notes == ()


def test_recordings_with_longer_steps_that_give_no_pairs_are_named(tmp_path: Path) -> None:
    fine, coarse = np.arange(50) * 0.1, np.arange(5) * 1.0
    generator = np.random.default_rng(0)
    values = [generator.normal(size=(len(t), 1)) for t in (fine, fine, coarse)]
    write_recordings(
        tmp_path / "a.parquet", Recordings.from_arrays([fine, fine, coarse], values, names=["x"])
    )
    read, _ = read_pairs(tmp_path / "a.parquet", states=None, units=None, pair_step=None)
    assert "1 of 3 recordings have longer steps than the others" in read.notes[-1]


def test_an_inspection_says_what_is_there(tmp_path: Path) -> None:
    ours = swinging()
    found = inspect_recordings(put(tmp_path, "a.csv", csv(table(ours).round(2), sep=";", decimal=",")))
    assert (found.samples.usual, found.pairs > 0, [state.quantum for state in found.states]) == (
        40,
        True,
        [0.01] * 2,
    )
    text = found.text()
    for words in (
        "4 recordings of 40 samples",
        "written to 2 decimals, an error of 0.003 µm",
        "Note: The columns",
    ):
        assert words in text
    hopping = noisy(0.02, 0.1)
    write_recordings(tmp_path / "b.parquet", hopping)
    found = inspect_recordings(tmp_path / "b.parquet")
    codes = [remark.code for remark in found.remarks()]
    assert codes[-3:] == ["data.noise_seen", "data.sensor_noise", "data.no_time_unit"]
    lines = found.lines()
    assert "Process noise is seen" in lines[-3] and "Measurement noise" in lines[-2]
    assert "unit the time is" in lines[-1]


@pytest.mark.parametrize("digits", [1, 2])
def test_times_rounded_to_more_than_a_step_are_those_of_an_even_clock(tmp_path: Path, digits: int) -> None:
    step = 0.37 * 10.0**-digits
    lines = [f"{5 + step * k:.{digits}f},{k // 3}" for k in range(400)]  # values repeat, too
    found = read_recordings(put(tmp_path, "a.csv", "t [h],x\n" + "\n".join(lines) + "\n"))
    np.testing.assert_allclose(found.t, found.t[0] + step * np.arange(400), atol=2 * step)
    np.testing.assert_array_equal(found.values[:, 0], np.arange(400) // 3)
    assert any("samples are taken as evenly spaced" in sentence(each) for each in found.remarks)


@pytest.mark.parametrize(
    "t",
    [np.repeat(np.arange(30), 3), np.append(np.arange(30), 29), np.minimum(np.arange(30), 9)],
    ids=["three of each", "one twice", "a clock that stops"],
)
def test_other_times_that_repeat_are_refused(tmp_path: Path, t: np.ndarray) -> None:
    lines = [f"{time},{number}" for number, time in enumerate(t)]
    with pytest.raises(InputError, match="is repeated") as fault:
        read_recordings(put(tmp_path, "a.csv", "t,x\n" + "\n".join(lines) + "\n"))
    assert "write times with more digits" in str(fault.value)
