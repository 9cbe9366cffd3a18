from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sympy

from siq.errors import InputError
from siq.inference.field_estimate import (
    DiffusionSource,
    FieldEstimate,
    NoiseDiagnosis,
    NoiseFormula,
    Verdict,
    read_field,
    write_field,
)
from siq.inference.library import IdentificationOptions, field_library
from siq.numerics.integration import FlowMap
from siq.remarks import Remark
from siq.systems.diffusion import Diffusion

OPTIONS = IdentificationOptions(degree=2, functions=("x/(1+y**2)", "sqrt(1+x**2)"))


def record() -> FieldEstimate:
    draw = np.random.default_rng(0)
    library = field_library(("x", "y"), OPTIONS)
    support = np.array([[0, 1], [0, 6], [1, 2], [1, 7]])
    coefficients = np.zeros((library.size, 2))
    coefficients[support[:, 1], support[:, 0]] = draw.normal(size=4) * [1e-17, 1, 1e9, 1 / 3]
    factor = draw.normal(size=(4, 4))
    places, one = np.zeros((1, 2), dtype=int), (sympy.Integer(1),)
    formula = NoiseFormula(library.symbols, places, one, np.array([0.2]), np.array([[1 / 7]]), 0.5)
    return FieldEstimate(
        library, coefficients, support, factor @ factor.T, np.diag([0.1, 1 / 3]), 1e-7 / 3,
        FlowMap(steps=3, euler=True), Diffusion(np.array([[2.0, 0.3], [0.3, 1 / 3]])),
        (draw.normal(size=coefficients.shape), draw.normal(size=(3, *coefficients.shape))),
        draw.uniform(size=4), formula,
        diagnosis=NoiseDiagnosis(
            "measurement", 0.1, np.eye(2), 1 / 3, -7.0, np.array([0.1, 0.0]), np.array([0.01, np.inf]),
            pairs=7, diffusion=DiffusionSource.UNIT, slow_sensor=(0.1, 1 / 3, 0.01), lag=3, lost_time=0.1,
            remarks=(Remark("inference.rounding", {"written": "so"}),),
        ),
        prediction=Verdict(np.inf, 0.01, False, "measurement noise"),
    )  # fmt: skip


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "field.json"
    write_field(path, record(), OPTIONS)
    return path


def test_a_field_comes_back_to_the_last_bit(written: Path) -> None:
    original, copy = record(), read_field(written)
    assert copy is not None
    for name in ("coefficients", "support", "covariance", "noise_rate", "values", "standard_errors"):
        np.testing.assert_array_equal(getattr(copy, name), getattr(original, name))
    np.testing.assert_array_equal(copy.diffusion.matrix, original.diffusion.matrix)
    assert copy.residual_ratio == original.residual_ratio
    assert copy.flow == original.flow
    assert copy.library.names == original.library.names
    assert copy.noise_free
    assert copy.prediction == original.prediction
    assert copy.diagnosis is not None and original.diagnosis is not None
    assert copy.diagnosis.as_data() == original.diagnosis.as_data()
    np.testing.assert_array_equal(copy.diagnosis.measurement_error, original.diagnosis.measurement_error)
    assert copy.noise is not None and original.noise is not None and copy.alternatives is not None
    assert original.alternatives is not None
    assert copy.noise.as_data() == original.noise.as_data()
    np.testing.assert_array_equal(copy.alternatives[1], original.alternatives[1])
    np.testing.assert_array_equal(copy.stability, original.stability)
    x = np.random.default_rng(1).normal(size=(5, 2))
    np.testing.assert_array_equal(copy.dynamics.drift(x), original.dynamics.drift(x))


def test_writing_again_gives_the_same_bytes(written: Path, tmp_path: Path) -> None:
    copy = read_field(written)
    assert copy is not None
    write_field(tmp_path / "again.json", copy, OPTIONS)
    assert (tmp_path / "again.json").read_bytes() == written.read_bytes()


def test_anybody_can_read_it(written: Path) -> None:
    data = json.loads(written.read_text())
    assert data["states"] == ["x", "y"]
    assert {row["term"] for row in data["terms"]} <= set(record().library.names)
    assert all(row["standard_error"] > 0 for row in data["terms"])


def test_an_empty_file_says_that_nothing_was_identified(tmp_path: Path) -> None:
    (tmp_path / "field.json").touch()
    assert read_field(tmp_path / "field.json") is None


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="it is no vector field"):
        read_field(tmp_path / "field.json")


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data.pop("terms"),
        lambda data: data.pop("flow"),
        lambda data: data.pop("diffusion"),
        lambda data: data.update(diffusion=[[1.0]]),
        lambda data: data.update(diffusion=[[1.0, 2.0], [2.0, 1.0]]),
        lambda data: data["flow"].update(steps_taken=3),
        lambda data: data["terms"][0].update(term="x**9"),
        lambda data: data["terms"][0].update(component="w"),
        lambda data: data["terms"][0].update(coefficient="many"),
        lambda data: data.update(degree=-1),
        lambda data: data.update(functions=["import os"]),
        lambda data: data.update(covariance=[[1.0, 2.0], [3.0]]),
        lambda data: data["covariance"].pop(),
        lambda data: data["terms"].pop(),
        lambda data: data.update(noise_rate=[[1.0]]),
        lambda data: data.update(residual_ratio=None),
    ],
)
def test_a_damaged_file_is_refused(written: Path, damage: object) -> None:
    data = json.loads(written.read_text())
    damage(data)  # type: ignore[operator]
    written.write_text(json.dumps(data))
    with pytest.raises(InputError, match="it is no vector field") as caught:
        read_field(written)
    assert caught.value.file == str(written)


@pytest.mark.parametrize("text", ["{", "[]", "null", "3", '"text"', "\x00\x01", "NaN"])
def test_what_is_no_record_is_refused(written: Path, text: str) -> None:
    written.write_text(text)
    with pytest.raises(InputError, match="it is no vector field"):
        read_field(written)


def test_half_a_file_is_refused(written: Path) -> None:
    text = written.read_bytes()
    written.write_bytes(text[: len(text) // 2])
    with pytest.raises(InputError, match="it is no vector field"):
        read_field(written)


def test_bytes_that_are_no_text_are_refused(written: Path) -> None:
    written.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match="it is no vector field"):
        read_field(written)


def test_a_number_that_is_not_finite_is_never_written(tmp_path: Path) -> None:
    original = record()
    broken = replace(original, residual_ratio=float("inf"))
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_field(tmp_path / "field.json", broken, OPTIONS)
    assert not (tmp_path / "field.json").exists()
