"""`siq.diagnose`: from Python, in all forms of recordings, and what the diagnosis says for people."""

from __future__ import annotations

import json
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sympy

import siq
from siq.diagnosis.diagnosis import tables_of, tables_of_failure
from siq.diagnosis.dictionary import standard_dictionary
from siq.diagnosis.study import _measurements_of, comparison_of
from siq.diagnosis.verdict import statement_of_failure
from siq.inference.budget import Budget
from siq.inference.measurements import with_expectations
from siq.inference.recalibration import most_varying, recalibrate
from siq.numerics.text import value_text
from siq.remarks import sentence
from siq.report.diagnosis_page import diagnosis_html, diagnosis_text
from siq.systems.dynamics import Dynamics, Parameter

n, r = sympy.symbols("n r", real=True)
GROWTH = Dynamics(
    ("n",), (r * n,), siq.Diffusion.identity(1),
    units=("kg",), time_unit="d", parameters=(Parameter("r", 1.0, "1/d"),),
)  # fmt: skip


def logistic() -> pd.DataFrame:
    """Populations that level off at 2 kg, exactly but for the sensor's noise."""
    t, noise = np.arange(0, 8, 0.4), np.random.default_rng(1)
    table = pd.concat(
        pd.DataFrame({"recording": f"r{k}", "t": t, "n": 2 / (1 + (2 / start - 1) * np.exp(-0.9 * t))})
        for k, start in enumerate([0.05, 0.2, 1.0, 5.0])
    )
    table["n"] += 0.005 * noise.normal(size=len(table))
    return table


@pytest.fixture(scope="module")
def diagnosis() -> siq.Diagnosis:
    return siq.diagnose(GROWTH, logistic())


def test_the_end_of_a_range_is_named_though_nothing_is_compared_in_its_place() -> None:
    t, noise = np.arange(0, 6, 0.2), np.random.default_rng(0)
    filling = Dynamics(("n",), (1 - r * n,), siq.Diffusion.identity(1), parameters=(Parameter("r", 1.0),))
    levels = {begin: 1.25 + (begin - 1.25) * np.exp(-0.8 * t) for begin in (0.0, 0.3, 2.0, 4.0)}
    table = pd.concat(
        pd.DataFrame({"recording": f"from {begin}", "t": t, "n": np.minimum(n, 1.1)})
        for begin, n in levels.items()
    )
    table["n"] += 0.01 * noise.normal(size=len(table))
    found = siq.diagnose(filling, table)
    assert [each.label for each in found.mechanisms] == ["clipping from above in n"]
    assert next(one.value for one in found.augmented.parameters if one.name == "r") == pytest.approx(
        0.8, rel=0.05
    )


def test_what_is_found_is_a_dynamics_with_the_true_parameters(diagnosis: siq.Diagnosis) -> None:
    assert diagnosis.verdict == "missing physics"
    (found,) = diagnosis.mechanisms
    for name, truth in (("c_1", 0.45), ("r", 0.9)):
        value = next(each.value for each in diagnosis.augmented.parameters if each.name == name)
        assert value == pytest.approx(truth, rel=0.01)
    assert found.parameters["c_1"].unit == "1/(kg*d)"
    # No domain was given: it is that of the recordings.
    low, high = diagnosis.augmented.domain[0]
    assert low == pytest.approx(0.05, abs=0.02) and high == pytest.approx(5, abs=0.02)


def test_the_report_says_all_of_it(diagnosis: siq.Diagnosis) -> None:
    text = diagnosis.report()
    (found,) = diagnosis.mechanisms
    size = found.parameters["c_1"]
    assert f"c_1 = {value_text(size.estimate, size.standard_error, unit=size.unit)} (" in text
    assert "1/(kg·d)" in text
    r = diagnosis.statement.recalibration["r"]
    assert f"r = {value_text(r.after, r.standard_error, unit='1/d')} (" in text and "(on the card: 1)" in text
    # It opens with the sentence that the page opens with.
    assert text.splitlines()[1].strip() == diagnosis.statement.sentence
    for heading in ("Verdict", "Mechanisms", "Location", "Error (normalised rms", "How sure it is"):
        assert f"[[{heading}" in text
    assert f"noise alone: {diagnosis.held_out.errors.noise_floor:.3g}" in text


def test_the_report_in_a_notebook_has_the_same_lines(diagnosis: siq.Diagnosis) -> None:
    lines: list[str] = []

    class Text(HTMLParser):
        def handle_data(self, data: str) -> None:
            lines.append(data)

    Text().feed(diagnosis._repr_html_())
    shown = [line.strip().removeprefix("[[").removesuffix("]]") for line in diagnosis.report().splitlines()]
    assert lines == shown


def test_the_card_is_read_back(diagnosis: siq.Diagnosis, tmp_path: Path) -> None:
    (tmp_path / "found.yaml").write_text(diagnosis.to_card(), encoding="utf-8")
    again = siq.load_system(tmp_path / "found.yaml")
    assert again.equations == diagnosis.augmented.equations
    np.testing.assert_array_equal(again.values, diagnosis.augmented.values)
    np.testing.assert_array_equal(again.box, diagnosis.augmented.box)


def test_table_file_and_recordings_are_the_same_to_it(tmp_path: Path) -> None:
    table = logistic()
    table.to_csv(tmp_path / "recordings.csv", index=False)
    forms = [table, tmp_path / "recordings.csv", siq.Recordings.from_frame(table.assign(more=1.0))]
    first, *others = (comparison_of(GROWTH, form) for form in forms)
    for other in others:
        np.testing.assert_allclose(other.learn.outputs, first.learn.outputs, rtol=1e-15)
        assert other.kept.labels == first.kept.labels


def test_what_a_computer_writes_is_no_clock_offset() -> None:
    """A smooth input that is held until the next sample comes half a step late on a straight line."""
    card = {
        "name": "motor",
        "states": {"w": {"unit": "rad/s"}},
        "inputs": {"u": {"unit": "V"}},
        "outputs": {"w": "w"},
        "parameters": {"K": {"value": 9.0}, "d": {"value": 3.0}},
        "equations": {"w": "K*u - d*w"},
    }
    t, generator, tables = 0.02 * np.arange(150), np.random.default_rng(5), []
    for number, (slow, quick) in enumerate(generator.uniform((1, 5), (2, 9), (4, 2))):
        u, w = np.sin(slow * t) + np.sin(quick * t), np.zeros(150)
        for k in range(149):
            w[k + 1] = w[k] * np.exp(-3.1 * 0.02) + 9.5 / 3.1 * (1 - np.exp(-3.1 * 0.02)) * u[k]
        w += 0.003 * generator.normal(size=150)
        tables.append(pd.DataFrame({"recording": f"r{number}", "t": t, "w": w, "u": u}))
    found = siq.diagnose(card, pd.concat(tables))
    assert not found.verdict.mismatch and not found.mechanisms
    (told,) = [one for one in found.statement.remarks if one.code == "diagnosis.held_inputs"]
    assert told.values["inputs"] == ["u"]
    assert "interpolation: zero_order" in found.to_card()


def test_what_is_missing_may_hide_that_inputs_are_held() -> None:
    """On lines between samples the sun of a room comes with a lag and a season that make up for the steps."""
    card = {
        "name": "room", "time_unit": "h", "states": {"T": {"unit": "degC"}},
        "inputs": {"o": {"unit": "degC"}, "s": {"unit": "kW/m^2"}}, "outputs": {"T": "T"},
        "parameters": {"a": {"value": 0.2, "unit": "1/h"}}, "equations": {"T": "a*(o - T)"},
    }  # fmt: skip
    t, generator, tables = 0.5 * np.arange(160), np.random.default_rng(3), []
    kept = np.exp(-0.15 * 0.5)  # from sample to sample
    for n in range(3):
        o = 8 + 4 * np.sin(0.26 * t + n) + 2 * np.sin(0.9 * t + 2 * n)
        s = np.clip(np.sin(0.26 * t + 0.5 * n), 0, None) * generator.uniform(0.4, 1)
        s, temperature = s + 0.2 * np.sin(1.3 * t) ** 2, np.full(160, 12.0)
        for k in range(159):
            temperature[k + 1] = temperature[k] * kept + (o[k] + 2.0 / 0.15 * s[k]) * (1 - kept)
        temperature += 0.02 * generator.normal(size=160)
        tables.append(pd.DataFrame({"recording": f"r{n}", "t": t, "T": temperature, "o": o, "s": s}))
    some = {"input gain", "input delay", "constant bias", "periodic forcing", "sensor lag"}
    without = [each.name for each in standard_dictionary() if each.name not in some]
    settings = siq.MismatchStudy(without=without, held_out=("r2",))
    found = siq.diagnose(card, pd.concat(tables), settings=settings)
    (gain,) = found.mechanisms
    assert gain.label == "input gain in T (T, s)"
    (size,) = gain.parameters.values()
    assert abs(size.estimate - 2.0) < 3 * size.standard_error < 0.02
    assert "diagnosis.held_inputs" in {one.code for one in found.statement.remarks}


def test_spikes_of_a_sensor_are_left_out_and_told() -> None:
    t, generator = 0.1 * np.arange(150), np.random.default_rng(2)
    spikes = generator.random((4, 150)) < 0.02
    tables = [
        pd.DataFrame({"recording": f"r{k}", "t": t, "n": 2 / (1 + (2 / start - 1) * np.exp(-0.9 * t))})
        for k, start in enumerate([0.05, 0.2, 1.0, 5.0])
    ]
    table = pd.concat(tables, ignore_index=True)
    table["n"] += 0.002 * generator.normal(size=600) + spikes.ravel() * generator.uniform(-2, 2, 600)
    some = {"self-limitation", "Gompertz growth", "harvest", "mortality", "constant bias", "clipping"}
    without = tuple(each.name for each in standard_dictionary() if each.name not in some)
    found = siq.diagnose(GROWTH, table, settings=siq.MismatchStudy(without=without))
    assert [one.label for one in found.mechanisms] == ["self-limitation in n"]
    (size,) = found.mechanisms[0].parameters.values()
    assert abs(size.estimate - 0.45) < 3 * size.standard_error < 0.002
    (told,) = [one for one in found.statement.remarks if one.code == "data.outliers"]
    assert 0.8 * spikes.sum() < told.values["samples"] <= spikes.sum()
    assert not comparison_of(GROWTH, table, siq.MismatchStudy(without_outliers=False)).remarks


def test_short_recordings_are_left_out_and_the_longer_part_is_learned_from() -> None:
    t = 0.1 * np.arange(90)
    tables = [
        pd.DataFrame({"recording": label, "t": t[:count], "n": 0.5 * np.exp(0.3 * t[:count])})
        for label, count in (("a", 90), ("b", 30), ("c", 5))
    ]
    case = comparison_of(GROWTH, pd.concat(tables))
    assert (case.learn.labels, case.kept.labels) == (("a",), ("b",))
    (told,) = case.remarks
    assert "c has fewer than 8 samples, and was left out" in sentence(told)
    alike = comparison_of(GROWTH, pd.concat([tables[0], tables[0].assign(recording="b")]))
    assert alike.kept.labels == ("a",) and not alike.remarks


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.rename(columns={"n": "m"}), "the column 'n' is missing"),
        (lambda table: table.rename(columns={"n": "n [g]"}), "unit"),
        (lambda table: table.iloc[:5], "fewer than 8 samples"),
    ],
)
def test_recordings_that_do_not_fit_are_refused(
    change: Callable[[pd.DataFrame], pd.DataFrame], message: str
) -> None:
    with pytest.raises(siq.InputError, match=message):
        siq.diagnose(GROWTH, change(logistic()))
    if "fewer" not in message:
        with pytest.raises(siq.InputError, match=message):
            siq.diagnose(GROWTH, siq.Recordings.from_frame(change(logistic())))


def test_what_cannot_be_fitted_has_a_verdict_and_tables_all_the_same(diagnosis: siq.Diagnosis) -> None:
    statement = statement_of_failure("the simulation runs away")
    data = json.loads(json.dumps(statement.as_data(), allow_nan=False))
    assert data["verdict"] == "unexplained" and data["remarks"] == ["The simulation runs away."]
    assert set(data) == set(diagnosis.statement.as_data())
    assert data["fit"]["augmented"] is None and data["location"] is None
    assert "The simulation runs away." in diagnosis_text(statement, GROWTH)
    assert "The simulation runs away." in diagnosis_html(statement, GROWTH)
    full, empty = tables_of(diagnosis), tables_of_failure(diagnosis.case)
    assert {name: list(table.columns)[:3] for name, table in full.items()} == {
        name: list(table.columns)[:3] for name, table in empty.items()
    }


def test_parameters_that_differ_from_recording_to_recording_are_no_missing_physics() -> None:
    rates, t, noise = [0.5, 0.7, 0.78, 0.9, 1.1], np.arange(0, 4, 0.1), np.random.default_rng(4)
    table = pd.concat(
        pd.DataFrame({"recording": f"r{k}", "t": t, "n": 0.2 * np.exp(rate * t)})
        for k, rate in enumerate(rates)
    )
    table["n"] += 0.01 * noise.normal(size=len(table))
    settings = siq.MismatchStudy(varies=("r",), held_out=("r2",))
    diagnosis = siq.diagnose(GROWTH, table, settings=settings)
    assert not diagnosis.verdict.mismatch
    (remark,) = [each for each in diagnosis.statement.remarks if each.code == "diagnosis.varies"]
    assert remark.values["labels"] == ["r0", "r1", "r3", "r4"] and remark.values["p"] < 1e-6
    for rate, (value, error) in zip([0.5, 0.7, 0.9, 1.1], remark.values["runs"], strict=True):
        assert abs(value - rate) < 4 * error < 0.05
    # The card of the result is one of the card's own names, with the mean.
    assert diagnosis.augmented.inputs == () and [each.name for each in diagnosis.augmented.parameters] == [
        "r"
    ]
    assert diagnosis.recalibrated.equations == GROWTH.equations
    assert diagnosis.recalibrated.values == pytest.approx([0.8], abs=0.05)
    assert "differs from recording to recording" in diagnosis.report()


@pytest.mark.slow
def test_a_parameter_that_differs_from_recording_to_recording_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    t = np.arange(0, 4, 0.4)
    table = pd.concat(
        pd.DataFrame({"recording": f"r{k}", "t": t, "n": 0.2 * np.exp(rate * t)})
        for k, rate in enumerate(np.linspace(0.5, 1.1, 7))
    )
    table["n"] += 0.01 * np.random.default_rng(4).normal(size=len(table))
    without = {each.name for each in standard_dictionary()} - {"self-limitation", "constant bias"}
    diagnosis = siq.diagnose(GROWTH, table, settings=siq.MismatchStudy(without=tuple(without)))
    assert diagnosis.verdict == "parameter shift" and not diagnosis.mechanisms
    assert "each with its own r" in diagnosis.statement.sentence
    assert "diagnosis.varies" in [each.code for each in diagnosis.statement.remarks]

    def fails(*_: object, **__: object) -> str:
        raise siq.NumericalFailure("the second look has no result")

    monkeypatch.setattr("siq.diagnosis.diagnosis.most_varying", fails)
    first = siq.diagnose(GROWTH, table, settings=siq.MismatchStudy(without=tuple(without)))
    assert first.verdict.mismatch  # the answer of the first look stands
    few = _measurements_of(table[table["recording"] < "r4"], GROWTH)
    fit, _ = recalibrate(with_expectations(GROWTH), few, budget=Budget())
    assert most_varying(GROWTH, few, fit, budget=Budget()) is None  # whose spread could not be known
