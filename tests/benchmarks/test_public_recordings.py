"""Files of public benchmarks, imitated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.publication.public_recordings import (
    BENCHMARKS,
    SILVERBOX_TRAINING,
    read_silverbox,
    read_tanks,
)
from siq.errors import InputError

REST = 0.006  # V that the generator gives while it is silent


def silverbox_file(path: Path, *, gaps: bool = True, rows: int = 127_500) -> Path:
    """A file like the benchmark's: every row is told from every other, and tests have another offset."""
    row = np.arange(rows)
    training = (row >= SILVERBOX_TRAINING[0]) & (row < SILVERBOX_TRAINING[1])
    silent = (row % 8000 < 90) & gaps
    # Its mean is off the value at rest.
    driven = REST + np.where(silent, 0.0, 0.05 * np.sign(np.cos(row)) + 0.01)
    u = np.where(training, driven, 7.0 + 1e-6 * row)
    pd.DataFrame({"V1": u, "V2": 2 * u, "": np.nan}).to_csv(path, index=False)
    return path


def test_silverbox_has_the_rows_of_the_official_loader(tmp_path):
    found = read_silverbox(silverbox_file(tmp_path / "box.csv"))
    lengths = dict(zip(found.labels, np.bincount(found.recording), strict=True))
    assert {name: lengths.pop(name) for name in BENCHMARKS["silverbox"].tests} == {
        "multisine": 127_400 - 105_712,
        "arrow": 40_575 - 100,
        "arrow without extrapolation": 32_000,
    }
    assert sum(lengths.values()) == 105_712 - 40_650
    assert set(lengths) == {f"multisine{place}" for place in range(1, 9)}
    first = {name: found.values[found.recording == place, 1][0] for place, name in enumerate(found.labels)}
    assert first["multisine"] - first["arrow"] == pytest.approx(1e-6 * (105_712 - 100), abs=1e-9)
    assert first["arrow"] == first["arrow without extrapolation"]
    assert np.diff(found.t[:3]) == pytest.approx(2**14 / 1e7)


def test_rest_of_the_silverbox_is_that_of_the_gaps_for_learning(tmp_path):
    found = read_silverbox(silverbox_file(tmp_path / "box.csv"))
    y, u = found.values.T
    assert u == pytest.approx(y / 2 - REST, abs=1e-9)
    with pytest.raises(InputError, match="no gaps"):
        read_silverbox(silverbox_file(tmp_path / "box.csv", gaps=False))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ('"V1","V2",\n1.0,2.0,\n', "1 rows of at least 127400"),
        ("a,b\n1,2\n", "no columns"),
        ('"V1","V2",\n1.0,,\n', "missing"),
    ],
    ids=["short", "no columns", "missing"],
)
def test_other_files_are_refused_in_a_sentence(write, text, part):
    with pytest.raises(InputError, match=part):
        read_silverbox(write(text, "box.csv"))


def test_tanks_have_two_recordings(write):
    text = '"uEst","uVal","yEst","yVal","Ts",\n1,2,3,4,4,\n5,6,7,8,,\n'
    found = read_tanks(write(text, "tanks.csv"))
    assert found.labels == ("est", "val")
    assert found.values.tolist() == [[3, 1], [7, 5], [4, 2], [8, 6]]
    assert found.t.tolist() == [0, 4, 0, 4]


def test_every_benchmark_says_what_to_get_and_whose_figures_are_quoted():
    for one in BENCHMARKS.values():
        assert one.what and one.tests
        for test in one.tests.values():
            assert test.window > 0
            assert all(each.method and each.scored and each.source for each in test.published)


def test_windows_of_official_tests_are_those_of_the_official_loader():
    windows = {name: {test.window for test in one.tests.values()} for name, one in BENCHMARKS.items()}
    assert windows == {"silverbox": {50}, "cascaded-tanks": {5}}
