"""Which run stands for all of them."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd

from siq.workflow.tables import Method, ModelFiles


def models(folder: Path, *methods: dict[str, object]) -> ModelFiles:
    paths = []
    for run, one in enumerate(methods):
        path = folder / f"{run}.json"
        path.write_text(json.dumps({"methods": one}))
        paths.append(str(path))
    return ModelFiles(tuple(paths))


def errors(*rows: tuple[int, str, float | None]) -> pd.DataFrame:
    return pd.DataFrame(list(rows), columns=["run", "method", "rrmse"])


FORMULA = {"V": {"formula": "x**2"}}
WELLS = {"V": None, "wells": [{"level": 1.0}]}


def test_of_refined_formulas_the_median_by_error(tmp_path: Path) -> None:
    found = models(tmp_path, *[{"regression": FORMULA, "refined": FORMULA}] * 3)
    table = errors((0, "refined", 3.0), (1, "refined", 1.0), (2, "refined", 2.0), (0, "regression", 0.1))
    assert found.representative(table) == (2, Method.REFINED)


def test_the_first_where_no_error_is_known(tmp_path: Path) -> None:
    found = models(tmp_path, {}, {"refined": FORMULA}, {"refined": FORMULA})
    assert found.representative(errors((1, "refined", None))) == (1, Method.REFINED)


def test_as_published_where_no_single_refined_formula_holds(tmp_path: Path) -> None:
    found = models(tmp_path, {"refined": WELLS}, {"regression": FORMULA, "refined": WELLS})
    assert found.representative(errors()) == (1, Method.REGRESSION)
    assert found.first_wells() == (0, Method.REFINED)


def test_none_where_no_run_has_a_formula(tmp_path: Path) -> None:
    found = models(tmp_path, {}, {})
    assert found.representative(errors())[0] is None
    assert found.first_wells()[0] is None
