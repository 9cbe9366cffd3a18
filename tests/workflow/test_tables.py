from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from siq.errors import InputError
from siq.workflow.tables import COLUMNS, as_table
from workflow.files import read_table, write_table
from workflow.rows import concatenate


def coefficients(seed: int = 0, count: int = 200) -> pd.DataFrame:
    draw = np.random.default_rng(seed)
    return as_table(
        "coefficients",
        [
            {"run": k, "method": "regression", "component": "U", "term": f"x**{k}",
             "estimate": draw.normal() * 10.0 ** draw.integers(-20, 20), "exact": np.nan}
            for k in range(count)
        ],
    )  # fmt: skip


@pytest.mark.parametrize("name", sorted(COLUMNS))
def test_every_table_has_its_columns_and_types_even_when_empty(name: str, tmp_path: Path) -> None:
    table = as_table(name, [])
    assert list(table.columns) == list(COLUMNS[name])
    assert {c: str(t) for c, t in table.dtypes.items()} == dict(COLUMNS[name])
    write_table(tmp_path / "t.parquet", table)
    assert list(read_table(tmp_path / "t.parquet").columns) == list(COLUMNS[name])


def test_numbers_come_back_equal_from_csv_and_parquet(tmp_path: Path) -> None:
    table = coefficients()
    write_table(tmp_path / "folder" / "t.parquet", table)
    pd.testing.assert_frame_equal(read_table(tmp_path / "folder" / "t.parquet"), table, check_exact=True)
    csv = pd.read_csv(tmp_path / "folder" / "t.csv", dtype=str)
    assert [float(text) for text in csv["estimate"]] == table["estimate"].tolist()
    assert csv["exact"].isna().all()
    assert csv["term"].tolist() == table["term"].tolist()


def test_missing_values_stay_missing(tmp_path: Path) -> None:
    table = as_table("rrmse", [{"run": 3, "method": "regression", "certified": False}])
    write_table(tmp_path / "t.parquet", table)
    row = read_table(tmp_path / "t.parquet").iloc[0]
    assert np.isnan(row["rrmse"])
    assert row["support_correct"] is pd.NA
    assert row["certified"] is np.False_ or row["certified"] is False


def test_columns_outside_the_contract_are_refused() -> None:
    with pytest.raises(ValueError, match=r"no columns \['colour'\]"):
        as_table("timings", [{"run": 1, "step": "train", "seconds": 1.0, "colour": "red"}])


def test_tables_are_put_below_each_other_in_order() -> None:
    one, other = coefficients(0, 3), coefficients(1, 2)
    both = concatenate("coefficients", [one, as_table("coefficients", []), other])
    assert both["estimate"].tolist() == one["estimate"].tolist() + other["estimate"].tolist()
    assert both.index.tolist() == list(range(5))
    assert concatenate("coefficients", []).empty


def test_a_writer_that_fails_leaves_the_old_tables_and_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "t.parquet"
    old = coefficients(0)
    write_table(path, old)

    def fail(self: pd.DataFrame, target: Path, **_: object) -> None:
        Path(target).write_bytes(b"PAR1 half")
        raise OSError("no space left on device")

    monkeypatch.setattr(pd.DataFrame, "to_parquet", fail)
    with pytest.raises(OSError, match="no space"):
        write_table(path, coefficients(1))
    pd.testing.assert_frame_equal(read_table(path), old)
    assert {entry.name for entry in tmp_path.iterdir()} == {"t.parquet", "t.csv"}


@pytest.mark.parametrize("content", [b"", b"PAR1", b"a,b\n1,2\n"])
def test_what_is_not_parquet_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "t.parquet"
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a Parquet table"):
        read_table(path)
    with pytest.raises(InputError, match="not a Parquet table"):
        read_table(tmp_path / "missing.parquet")
