"""Scores of the proof: verdicts that are made up, held against keys that are made up."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import matplotlib.text
import numpy as np
import pandas as pd
import pytest
import yaml

from benchmarks.proof.batches import check_digests, load_proofs
from benchmarks.proof.concealment.cases import Design, make_case
from benchmarks.proof.keys import CaseKey, Truth, read_key, read_truth
from benchmarks.proof.oracle import Oracle, pairing, true_model
from benchmarks.proof.plots import plot_proof
from benchmarks.proof.scoring import (
    Answer,
    covered,
    functional_error,
    held_out_scores,
    intensity_ratio,
    judgement,
    model_of,
    score_table,
)
from benchmarks.proof.targets import clopper_pearson, counted, failures_of, quantile, target_table, targets_of
from siq.errors import InputError
from siq.systems.dynamics import Dynamics, Signals
from workflow.versions import files_of_task

ROOT = Path(__file__).resolve().parents[3]
SPRING = {
    "name": "spring",
    "states": {"x": {"unit": "m", "domain": [-2, 2]}, "v": {"unit": "m/s", "domain": [-9, 9]}},
    "parameters": {"k": {"value": 4.0, "unit": "1/s**2"}, "d": {"value": 0.2, "unit": "1/s"}},
    "equations": {"x": "v", "v": "-k*x - d*v"},
}
CUBIC = {
    "kind": "mechanism",
    "mechanism": "cubic stiffness",
    "equations": ["v"],
    "coordinates": ["x"],
    "effect": {"terms": {"v": "-c*x**3"}, "parameters": {"c": 0.5}},
}


def spring(**changes: Any) -> Dynamics:
    card = {**SPRING, **changes}
    return model_of(yaml.safe_dump(card, sort_keys=False))


def key(**changes: Any) -> CaseKey:
    return CaseKey.model_validate({**CUBIC, **changes})


def mechanism(name: str, *others: str, **more: Any) -> dict[str, Any]:
    return {
        "name": name,
        "terms": {},
        "parameters": {},
        "evidence": {"delta_chi2": 200.0},
        "indistinguishable_from": list(others),
        **more,
    }


def said(
    verdict: str,
    *mechanisms: dict[str, Any],
    equations: tuple[str, ...] = ("v",),
    coordinate: str = "x",
) -> Answer:
    quiet = verdict in ("no mismatch", "parameter shift")
    place = None if quiet else {"equations": dict.fromkeys(equations, 1.0), "coordinate": coordinate}
    told = {"verdict": "missing physics" if verdict == "modelled" else verdict, "outcome": verdict}
    return Answer(told | {"mechanisms": list(mechanisms), "location": place, "fit": {}}, "", 3.0)


NULL = {"kind": "null", "mechanism": None, "equations": [], "coordinates": [], "effect": {}}
NOISE = {**NULL, "kind": "process noise", "mechanism": "process noise", "equations": ["v"]}
WITHHELD = {"kind": "withheld", "mechanism": "force bump"}


@pytest.mark.parametrize(
    ("conceals", "answer", "expected"),
    [
        (NULL, said("no mismatch"), {"right": True, "false_alarm": False, "detected": False}),
        (NULL, said("parameter shift"), {"right": False, "false_alarm": False}),
        (NULL, said("unexplained"), {"right": False, "false_alarm": True}),
        ({**NULL, "kind": "shift"}, said("parameter shift"), {"right": True, "false_alarm": False}),
        ({**NULL, "kind": "shift"}, said("no mismatch"), {"right": False, "false_alarm": False}),
        (
            {**NULL, "kind": "shift"},
            said("missing physics", mechanism("dry friction")),
            {"right": False, "false_alarm": True},
        ),
        (
            {},
            said("missing physics", mechanism("cubic stiffness")),
            {"right": True, "truth_in_class": True, "class_size": 1, "equation_right": True},
        ),
        (
            {},
            said("missing physics", mechanism("quintic stiffness", "cubic stiffness", "quintic stiffness")),
            {"truth_in_class": True, "class_size": 2, "reported_class": "quintic stiffness, cubic stiffness"},
        ),
        ({}, said("unexplained"), {"right": False, "truth_in_class": False, "class_size": 0}),
        ({}, said("no mismatch"), {"equation_right": False, "coordinate_right": False}),
        (
            {},
            said("missing physics", mechanism("dry friction"), equations=("x",), coordinate="v"),
            {"truth_in_class": False, "equation_right": False, "coordinate_right": False},
        ),
        (NOISE, said("missing physics", mechanism("process noise")), {"right": True}),
        (
            NOISE,
            said("missing physics", mechanism("dry friction")),
            {"right": False, "deterministic_under_noise": True},
        ),
        (NOISE, said("no mismatch"), {"right": False, "deterministic_under_noise": False}),
        (WITHHELD, said("unexplained"), {"right": True, "detected": True}),
        (WITHHELD, said("modelled"), {"right": True, "detected": True, "verdict": "modelled"}),
        (NULL, said("modelled"), {"right": False, "false_alarm": True}),
        (WITHHELD, said("missing physics", mechanism("dry friction")), {"right": False, "detected": True}),
        (WITHHELD, said("parameter shift"), {"right": False, "detected": False}),
        (
            NULL,
            Answer(None, "", failure="it broke"),
            {"verdict": "failed", "right": False, "detected": False},
        ),
    ],
)
def test_verdicts_are_judged(conceals: dict[str, Any], answer: Answer, expected: dict[str, Any]) -> None:
    found = judgement(key(**conceals), answer)
    assert {name: found[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("coordinates", "coordinate", "right"),
    [
        ([], "constant", True),
        (["x"], "x", True),
        (["x", "v"], "v", True),
        (["x1", "x2"], "x1 - x2", True),
        (["x", "z"], "x, y", False),
        (["amplitude"], "constant", False),
        (["t"], "t", True),
        (["y"], "measurement", True),
        (["w"], "measurement", False),
    ],
)
def test_a_coordinate_is_right_where_all_its_names_are(
    coordinates: list[str], coordinate: str, right: bool
) -> None:
    answer = said("missing physics", mechanism("some", terms={"y": "y + o"}), coordinate=coordinate)
    assert judgement(key(coordinates=coordinates), answer)["coordinate_right"] is right


def test_parameters_are_paired_by_what_the_formulas_say_whatever_their_names() -> None:
    base = spring()
    true, names = true_model(base, key(effect={"terms": {"v": "c*x**3"}, "parameters": {"c": -0.5}}))
    (own,) = names
    assert names[own] == "c" and true.parameters[-1].value == -0.5
    more = {**SPRING["parameters"], "c_7": {"value": 0.5}}
    cubic = spring(parameters=more, equations={"x": "v", "v": "-k*x - d*v - c_7*x**3"})
    assert pairing(cubic, true, base) == {"c_7": (own, -1)}
    quintic = spring(parameters=more, equations={"x": "v", "v": "-k*x - d*v - c_7*x**5"})
    assert pairing(quintic, true, base) is None
    assert pairing(base, true, base) is None


def test_a_functional_error_is_relative_to_the_effect() -> None:
    base = spring()
    rng = np.random.default_rng(1)
    states = rng.uniform(-1, 1, (50, 2))
    t, inputs = np.zeros(50), np.zeros((50, 0))
    none = np.zeros((0, 50))
    without = base.functions.rates(states.T, Signals(inputs.T, none, none, t), base.values).T
    effect = np.stack([np.zeros(50), -0.5 * states[:, 0] ** 3], axis=1)
    truth = Truth(t, states, inputs, without + effect, without)
    more = {**SPRING["parameters"], "c": {"value": 0.51}}
    augmented = spring(parameters=more, equations={"x": "v", "v": "-k*x - d*v - c*x**3"})
    error, note = functional_error(base, augmented, key(), truth)
    assert error == pytest.approx(0.02) and note == ""
    assert functional_error(base, augmented, key(), None)[1] == "the key has no arrays"


def test_a_sensor_is_scored_by_what_it_reads() -> None:
    base = spring(outputs={"x": "x"})
    sensor = key(
        mechanism="sensor gain or offset",
        equations=[],
        effect={"outputs": {"x": "(1 + g)*x + o"}, "parameters": {"g": 0.1, "o": 0.0}},
    )
    states = np.random.default_rng(2).uniform(-1, 1, (40, 2))
    truth = Truth(np.zeros(40), states, np.zeros((40, 0)), states, states)
    more = {**SPRING["parameters"], "g_1": {"value": 0.105}}
    augmented = spring(parameters=more, outputs={"x": "(1 + g_1)*x"})
    assert functional_error(base, augmented, sensor, truth)[0] == pytest.approx(0.05)


def test_intervals_that_hold_are_counted() -> None:
    entries = {
        "a": {"after": 1.0, "standard_error": 0.1},
        "b": {"after": 1.0, "standard_error": 0.1},
        "c": {"after": 1.0, "standard_error": None},
    }
    assert covered(entries, {"a": 1.19, "b": 1.2, "c": 1.0, "d": 0.0}, value="after") == (2, 1)


def test_process_noise_is_scored_by_its_intensity() -> None:
    noise = key(**{**NOISE, "effect": {"noise": {"v": "c"}, "parameters": {"c": 0.2}}})
    assert intensity_ratio(noise, {"intensity_v": {"estimate": 0.05}}) == pytest.approx(1.25)
    assert intensity_ratio(noise, {}) == 0


def test_held_out_errors_are_relative_to_the_oracle() -> None:
    answer = Answer({"fit": {"recalibrated": 0.3, "augmented": 0.11}}, "")
    found = held_out_scores(answer, Oracle(500.0, 0.1))
    assert found["error_ratio"] == pytest.approx(1.1) and found["oracle_delta_chi2"] == 500
    assert np.isnan(held_out_scores(answer, Oracle(0.0, np.nan))["error_ratio"])


@pytest.mark.parametrize(
    ("system", "effect"),
    [
        ("oscillator", "dry friction"),
        ("predator_prey", "saturation"),
        ("archetype3d", "constant bias"),
        ("resonator", "parameter drift"),
    ],
)
def test_the_true_simulation_has_the_derivatives_of_the_key(system: str, effect: str, tmp_path: Path) -> None:
    case = make_case(Design("case-0001", system, "mechanism", effect, True, 0.1, 40.0, (), 5))
    base = model_of(yaml.safe_dump(dict(case.card), sort_keys=False))
    true, _ = true_model(base, CaseKey.model_validate(dict(case.key)))
    truth = case.truth
    none = np.zeros((0, len(truth["t"])))
    signals = Signals(truth["inputs"].T, none, none, truth["t"])
    rates = true.functions.rates(truth["states"].T, signals, true.values).T
    # What rests is held by friction, which a sign cannot say.
    moving = np.abs(truth["states"]).min(axis=1) > 1e-9
    scale = np.abs(truth["derivative_true"]).max(axis=0)
    assert rates[moving] == pytest.approx(truth["derivative_true"][moving], abs=1e-6 * scale.max())


def test_bounds_are_those_of_clopper_and_pearson() -> None:
    assert clopper_pearson(0, 10) == (0.0, pytest.approx(0.3085, abs=1e-4))
    assert clopper_pearson(10, 10) == (pytest.approx(0.6915, abs=1e-4), 1.0)
    assert clopper_pearson(4, 20) == pytest.approx((0.0573, 0.4366), abs=1e-4)
    assert np.isnan(clopper_pearson(0, 0)[0])


def test_targets_say_whether_they_are_met() -> None:
    assert counted("some", 95, 100, least=0.9, most=0.98).met
    assert not counted("some", 99, 100, least=0.9, most=0.98).met
    none = counted("some", 0, 0, most=0.01)
    assert none.met is None and none.limit == "≤ 1 %"
    median = quantile("some", pd.Series([1.0, 2.0, 3.0, np.nan]), 0.5, most=2)
    assert (median.measured, median.cases, median.met) == (2.0, 3, True)
    assert median.low == -np.inf and median.high == np.inf  # three numbers bound no median


def scored() -> pd.DataFrame:
    rows = []
    answers = [
        (NULL, said("no mismatch")),
        (NULL, said("unexplained")),
        ({}, said("missing physics", mechanism("cubic stiffness"))),
        ({}, said("missing physics", mechanism("dry friction"), coordinate="v")),
        (NOISE, said("missing physics", mechanism("process noise"))),
        (WITHHELD, said("unexplained")),
    ]
    for number, (conceals, answer) in enumerate(answers):
        row = judgement(key(noise_db=40.0, **conceals), answer)
        strong = {"oracle_delta_chi2": 500.0} if row["kind"] == "mechanism" else {}
        rows.append(row | strong | {"case": f"case-{number}"})
    return score_table(rows)


def test_the_table_of_targets_counts_the_cases() -> None:
    table = target_table(targets_of(scored())).set_index("figure")
    assert table.loc["false alarms among nulls and shifts", "measured"] == 0.5
    assert not table.loc["false alarms among nulls and shifts", "met"]
    assert table.loc["truth within the reported class, Δχ² ≥ 100", "measured"] == 0.5
    assert table.loc["classes of one at 40 dB, Δχ² ≥ 100", "measured"] == 1
    assert table.loc["of these the right one at 40 dB", "measured"] == 0.5
    assert table.loc["withheld: without a name among those detected", "met"]
    assert table.loc["seconds a case, median", "measured"] == 3


def test_failures_are_listed_case_by_case() -> None:
    lists = {said: list(frame["case"]) for said, frame in failures_of(scored()) if len(frame)}
    assert lists == {
        "False alarms: “modelled” or “unexplained” where nothing is missing.": ["case-1"],
        "Mechanisms that are not in the reported class, Δχ² ≥ 100.": ["case-3"],
        "Right names whose formula is not the key's, Δχ² ≥ 100.": ["case-2"],
        "Wrong equation or coordinate, Δχ² ≥ 100.": ["case-3"],
    }


def test_the_figure_shows_every_kind_and_verdict() -> None:
    figure = plot_proof(scored())
    words = "\n".join(text.get_text() for text in figure.findobj(matplotlib.text.Text))
    for word in ("6 cases", "withheld", "process noise", "no mismatch", "40 dB (2 cases)"):
        assert word in words
    assert "no case" in plot_proof(scored().iloc[:0]).axes[0].texts[0].get_text()


def test_a_key_with_another_digest_is_refused_in_one_sentence() -> None:
    check_digests({"case-1": "ab"}, {"case-1": "ab", "case-2": "cd"}, file="digests.json")
    with pytest.raises(InputError, match="case-1: the key is not the one whose digest was published"):
        check_digests({"case-1": "ab"}, {"case-1": "ff"}, file="digests.json")


def test_a_key_that_cannot_be_used_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "case-1.json"
    path.write_text('{"kind": "mechanism",\n "mechanisms": "dry friction"}')
    with pytest.raises(InputError, match="line 2"):
        read_key(path)
    assert read_truth(tmp_path / "case-1.npz") is None
    np.savez(tmp_path / "case-1.npz", t=np.zeros(3))
    with pytest.raises(InputError, match="states"):
        read_truth(tmp_path / "case-1.npz")


def test_settings_of_the_proof_are_checked(tmp_path: Path) -> None:
    proofs = load_proofs(ROOT / "config/proof.yaml")
    assert proofs["proof"].cases >= 200 and proofs["proof_full"].cases == 1500
    assert proofs["proof_full"].shares["null"] + proofs["proof_full"].shares["shift"] == 0.5
    odd = proofs["proof"].model_copy(update={"cases": 23})
    assert odd.batch_names() == ["000", "001", "002"]
    path = tmp_path / "proof.yaml"
    path.write_text((ROOT / "config/proof.yaml").read_text().replace("shift: 0.15", "shift: 0.25"))
    with pytest.raises(InputError, match=r"shares sum to 1\.1"):
        load_proofs(path)


def imported_by(task: str) -> set[str]:
    return {file.relative_to(ROOT).as_posix() for file in files_of_task(task)}


def test_the_blind_diagnosis_imports_nothing_of_keys_and_concealment() -> None:
    files = imported_by("blind_diagnosis")
    assert "siq/diagnosis/investigation.py" in files
    packages = {"workflow/__init__.py", "benchmarks/__init__.py", "benchmarks/proof/__init__.py"}
    of_every_task = {"workflow/task.py", "workflow/files.py", "workflow/published.py"}
    ours = {file for file in files if file.startswith(("workflow/", "benchmarks/"))}
    assert ours <= packages | of_every_task
    for file in packages:
        assert not ast.parse((ROOT / file).read_text()).body[1:], "a docstring, and no import"


@pytest.mark.parametrize(
    "task", ["conceal", "open_keys", "score_batch", "score_case", "collect_scores", "score_proof"]
)
def test_the_proof_imports_nothing_of_the_search_and_the_verdict_that_it_tests(task: str) -> None:
    tested = {f"siq/diagnosis/{name}.py" for name in (
        "search", "screening", "evidence", "residual_structure", "investigation", "naming", "holdout",
        "unnamed_models", "verdict", "diagnosis")}  # fmt: skip
    assert all((ROOT / file).is_file() for file in tested)
    assert not imported_by(task) & tested


def test_the_true_simulation_has_the_true_parameters() -> None:
    base = spring()
    true, _ = true_model(base, key(shifts={"k": {"card": 4.0, "true": 3.5}}))
    assert true.values[0] == 3.5 and base.values[0] == 4.0
