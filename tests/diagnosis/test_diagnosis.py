"""Verdicts on recordings of a driven oscillator whose truth is known."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from siq.diagnosis import investigation, naming
from siq.diagnosis.diagnosis import Diagnosis, _judged, _withdrawn, solve_case
from siq.diagnosis.dictionary import standard_dictionary
from siq.diagnosis.evidence import FittedCandidate
from siq.diagnosis.investigation import HeldOutRuns, held_out_runs, investigate
from siq.diagnosis.mechanisms import MechanismCandidate
from siq.diagnosis.naming import Investigation
from siq.diagnosis.residual_structure import Remainder
from siq.diagnosis.search import FitContext, Search
from siq.diagnosis.study import Comparison, MismatchVerdict, read_case
from siq.diagnosis.unnamed_models import AugmentedModel
from siq.errors import InputError, NumericalFailure
from siq.inference.budget import Budget
from siq.inference.measurements import Measurements
from siq.inference.trajectories import scored_rows
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics, Signals
from tests.diagnosis.foreign_cases import falling_ball

CARD = {
    "name": "oscillator",
    "time_unit": "s",
    "states": {"x": {"unit": "m", "domain": [-2, 2]}, "v": {"unit": "m/s", "domain": [-4, 4]}},
    "inputs": {"u": {"unit": "N", "interpolation": "linear"}},
    "parameters": {
        "k": {"value": 4.0, "unit": "N/m"},
        "d": {"value": 0.3, "unit": "N*s/m"},
        "m": {"value": 1.0, "unit": "kg", "fixed": True},
    },
    "equations": {"x": "v", "v": "(-k*x - d*v + u)/m"},
    "outputs": {"x": "x"},
}
STEP, SAMPLES, FINE = 0.15, 120, 20
Force = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


def recordings_of(
    force: Force,
    *,
    count: int = 4,
    noise: float = 0.01,
    drive: float = 0.0,
    fading: bool = False,
    seed: int = 1,
) -> pd.DataFrame:
    """Driven oscillators of different strength, by Heun's rule; process noise may follow their motion."""
    generator = np.random.default_rng(seed)
    t = np.arange(SAMPLES) * STEP
    strength = np.geomspace(0.4, 2.0, count)[:, None]
    phase = generator.uniform(0, 2 * np.pi, size=(count, 4, 1))
    omega = generator.uniform(0.8, 3.0, size=(count, 4, 1))
    u = strength * np.cos(omega * t + phase).sum(axis=1)
    state = np.stack([generator.normal(size=count) * 0.3, np.zeros(count)])
    seen = np.empty((count, SAMPLES))
    h = STEP / FINE

    def rate(y: np.ndarray, now: float, at: float) -> np.ndarray:
        left = np.minimum(int(at), SAMPLES - 2)
        push = u[:, left] + (u[:, left + 1] - u[:, left]) * (at - left)
        return np.stack([y[1], -4.0 * y[0] - 0.3 * y[1] + push + force(y[0], y[1], now)])

    for sample in range(SAMPLES):
        seen[:, sample] = state[0]
        for part in range(FINE if sample + 1 < SAMPLES else 0):
            at = sample + part / FINE
            first = rate(state, at * STEP, at)
            second = rate(state + h * first, at * STEP + h, at + 1 / FINE)
            state = state + h / 2 * (first + second)
            kick = np.sqrt(drive * h) * generator.normal(size=count)
            state[1] += kick * np.hypot(*state) if fading else kick
    size = noise * seen.std()
    return pd.DataFrame(
        {
            "recording": np.repeat([f"r{index}" for index in range(count)], SAMPLES),
            "t": np.tile(t, count),
            "x": (seen + size * generator.normal(size=seen.shape)).ravel(),
            "u": u.ravel(),
        }
    )


def compared(
    folder: Path, table: pd.DataFrame, *, card: dict = CARD, study: dict | None = None
) -> Comparison:
    (folder / "system.yaml").write_text(yaml.safe_dump(card, sort_keys=False), encoding="utf-8")
    (folder / "study.yaml").write_text(yaml.safe_dump(study or {"held_out": ["r2"]}), encoding="utf-8")
    table.to_parquet(folder / "recordings.parquet")
    return read_case(folder / "system.yaml", folder / "recordings.parquet", folder / "study.yaml")


def solved(folder: Path, table: pd.DataFrame, **how: Any) -> Diagnosis:
    return solve_case(compared(folder, table, **how))


def nothing(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
    return np.zeros_like(x)


OF_OSCILLATORS = (
    "linear stiffness", "cubic stiffness", "quintic stiffness", "linear damping", "quadratic drag",
    "dry friction", "asymmetric friction", "backlash", "hysteresis", "constant bias",
    "sensor gain or offset", "sensor lag", "process noise", "parameter drift", "periodic forcing",
    "hidden capacity",
)  # fmt: skip
"""What a test asks for that is not about the dictionary as a whole; each further entry is fitted, too."""
FRICTIONS = (
    "linear damping", "quadratic drag", "dry friction", "asymmetric friction", "Stribeck friction",
    "hysteresis", "process noise",
)  # fmt: skip
"""For what is told from other friction."""
FEW = (
    "linear stiffness", "cubic stiffness", "linear damping", "quadratic drag", "constant bias",
    "process noise", "hidden capacity",
)  # fmt: skip
"""For what is about more than mechanisms: one of each kind that could take its place."""


def among(*kept: str, **study: Any) -> dict[str, Any]:
    """A study whose dictionary has these mechanisms and no others."""
    without = [each.name for each in standard_dictionary() if each.name not in kept]
    assert len(without) + len(kept) == len(standard_dictionary())
    return {"held_out": ["r2"], "without": without} | study


def said(diagnosis: Diagnosis) -> dict[str, Any]:
    return diagnosis.statement.as_data()


def names(diagnosis: Diagnosis) -> list[str]:
    return [each["name"] for each in said(diagnosis)["mechanisms"]]


@pytest.fixture(scope="module")
def cleared(tmp_path_factory: pytest.TempPathFactory) -> Diagnosis:
    """Of recordings of the card itself."""
    return solved(tmp_path_factory.mktemp("cleared"), recordings_of(nothing))


def test_nothing_is_missing_and_what_could_be_is_bounded(cleared: Diagnosis) -> None:
    assert said(cleared)["verdict"] == "no mismatch"
    bound = said(cleared)["excluded"]["cubic stiffness in v"]
    assert 0 < bound["upper_bound_95"] < 0.05 and bound["unit"] == "1/(m**2*s**2)"
    assert said(cleared)["fit"]["augmented"] == pytest.approx(said(cleared)["fit"]["noise_floor"], rel=0.3)


def test_a_noise_that_is_known_is_not_estimated(tmp_path: Path) -> None:
    table = recordings_of(nothing)
    # Of half the true size: then noise itself is more than the simulation explains.
    for factor, verdict in ((1.0, "no mismatch"), (0.5, "unexplained")):
        size = factor * 0.01 * table["x"].std()
        study = among("cubic stiffness", "quadratic drag", "process noise", noise={"x": float(size)})
        diagnosis = solved(tmp_path, table, study=study)
        assert diagnosis.investigation.search.fit.noise.measurement == pytest.approx([size**2])
        assert said(diagnosis)["verdict"] == verdict


def test_wrong_parameters_are_no_missing_physics(tmp_path: Path) -> None:
    card = {**CARD, "parameters": {**CARD["parameters"], "k": {"value": 3.4, "unit": "N/m"}}}
    diagnosis = solved(tmp_path, recordings_of(nothing), card=card)
    assert said(diagnosis)["verdict"] == "parameter shift"
    shift = said(diagnosis)["recalibration"]["k"]
    assert shift["before"] == 3.4
    assert abs(shift["after"] - 4.0) < 3 * shift["standard_error"]


def test_a_hardening_spring_is_named_measured_and_located(tmp_path: Path) -> None:
    diagnosis = solved(tmp_path, recordings_of(lambda x, v, t: -0.6 * x**3))
    verdict = said(diagnosis)
    assert verdict["verdict"] == "missing physics" and names(diagnosis) == ["cubic stiffness"]
    found = verdict["mechanisms"][0]
    assert found["terms"] == {"v": "-c_1*x**3"} and found["indistinguishable_from"] == []
    parameter = found["parameters"]["c_1"]
    assert abs(parameter["estimate"] - 0.6) < 3 * parameter["standard_error"] < 0.06
    assert list(verdict["location"]["equations"]) == ["v"] and verdict["location"]["coordinate"] == "x"
    fit = verdict["fit"]
    assert fit["augmented"] < 1.3 * fit["noise_floor"] < fit["recalibrated"] / 5
    path = tmp_path / "augmented.yaml"
    path.write_text(diagnosis.to_card(), encoding="utf-8")
    assert "x**3" in str(load_system(path).equations[1])
    json.dumps(verdict, allow_nan=False)


@pytest.mark.slow
def test_a_mechanism_that_is_not_certain_enough_is_described_but_not_named(tmp_path: Path) -> None:
    table = recordings_of(lambda x, v, t: -0.03 * x**3)
    study = among(*OF_OSCILLATORS, search={"wrong_names": 1e-200})
    diagnosis = solved(tmp_path, table, study=study)
    assert said(diagnosis)["outcome"] == "modelled" and names(diagnosis) == []
    assert (
        "in the equation of v, like its cube, as cubic stiffness would have. With it"
        in said(diagnosis)["sentence"]
    )
    assert said(diagnosis)["description"]["by"][0]["name"] == "cubic stiffness"
    assert "a name takes odds of" in said(diagnosis)["remarks"][-1]
    # It is in the new card all the same, since the card foresees more with it.
    (part,) = said(diagnosis)["described"]
    assert part["equations"] == ["v"] and part["coordinates"] == ["x"]
    assert said(diagnosis)["fit"]["augmented"] < 0.9 * said(diagnosis)["fit"]["recalibrated"]


def test_the_later_part_of_a_single_recording_is_not_called_independent(tmp_path: Path) -> None:
    table = recordings_of(lambda x, v, t: -0.5 * x**3)
    diagnosis = solved(tmp_path, table[table["recording"] == "r3"], study={"held_out": 0.3})
    assert names(diagnosis) == ["cubic stiffness"]
    assert "no independent recording" in said(diagnosis)["remarks"][-1]


@pytest.mark.parametrize(("rows", "learned"), [(120, 90), (14, 10), (8, 7)])
def test_what_is_held_out_of_a_single_recording_goes_on_from_what_was_learned(
    rows: int, learned: int, tmp_path: Path
) -> None:
    """Samples of the part that was learned tell its state, and none of those held out is lost for that."""
    table = recordings_of(nothing, count=1).head(rows)
    case = compared(tmp_path, table, study={"held_out": 0.25})
    assert len(case.learn.t) == learned
    np.testing.assert_array_equal(case.kept.t[scored_rows(case.kept)], table["t"].to_numpy()[learned:])


@pytest.mark.parametrize("drag", [0.005, pytest.param(0.5, marks=pytest.mark.slow)])
def test_drag_is_named_from_one_drop_of_45_heights(drag: float, tmp_path: Path) -> None:
    """Free fall is off by a tenth, or by nearly all; process noise could explain any 45 heights."""
    diagnosis = solve_case(falling_ball(drag).read(tmp_path))
    (found,) = said(diagnosis)["mechanisms"]
    assert found["name"] == "quadratic drag"
    (parameter,) = found["parameters"].values()
    assert abs(parameter["estimate"] - drag) < 3 * parameter["standard_error"]
    # Process noise explains more than free fall alone, and drag without any explains more than it does.
    said_of = {each["what"]: each["log_evidence"] for each in said(diagnosis)["explanations"]}
    assert said_of["quadratic drag in w"] == 0
    assert said_of["other parameters"] < said_of["other parameters and process noise"] < -10


def test_a_path_that_is_never_gone_back_shows_no_hysteresis_and_time_since_a_begin_is_no_clock(
    tmp_path: Path,
) -> None:
    falls = falling_ball(0.05).read(tmp_path)
    swings = compared(tmp_path, recordings_of(nothing, count=3), study={"held_out": ["r2"]})
    seen = [
        {each.name: each.weight for each in investigate(case, budget=Budget(work=1.0)).context.candidates}
        for case in (falls, swings, replace(swings, learn=swings.learn.select([0])))
    ]
    assert ["hysteresis" in each for each in seen] == [False, True, True]
    assert [each["periodic forcing"] for each in seen] == [
        1.0,
        0.2,
        1.0,
    ]  # the falls: one drop


@pytest.mark.slow
def test_dry_friction_is_told_from_other_friction(tmp_path: Path) -> None:
    diagnosis = solved(
        tmp_path, recordings_of(lambda x, v, t: -0.25 * np.tanh(v / 1e-3)), study=among(*FRICTIONS)
    )
    assert names(diagnosis) == ["dry friction"]
    assert said(diagnosis)["mechanisms"][0]["parameters"]["c_1"]["estimate"] == pytest.approx(0.25, rel=0.05)


def test_random_forces_are_no_mechanism_with_a_formula(tmp_path: Path) -> None:
    # They drive the velocity, and the augmented card says so, though D is singular then.
    diagnosis = solved(tmp_path, recordings_of(nothing, drive=0.05), study=among(*FEW))
    np.testing.assert_allclose(diagnosis.augmented.diffusion.matrix, np.diag([0, 0.05]), rtol=0.3)
    path = tmp_path / "augmented.yaml"
    path.write_text(diagnosis.to_card(), encoding="utf-8")
    np.testing.assert_array_equal(load_system(path).diffusion.matrix, diagnosis.augmented.diffusion.matrix)
    assert said(diagnosis)["verdict"] == "missing physics" and names(diagnosis) == ["process noise"]
    intensity = said(diagnosis)["mechanisms"][0]["parameters"]["intensity_v"]["estimate"]
    assert intensity == pytest.approx(0.05, rel=0.3)


def test_random_forces_are_no_noise_where_a_function_beside_them_is_likelier(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def models(search: Search, _: FitContext) -> tuple[AugmentedModel, ...]:
        # A function of a sensor that leaves process noise, and is likelier than noise alone.
        assert search.recalibrated.has_process_noise
        screened = [each.term.candidate for each in search.screened]
        candidate = next(each for each in screened if each.coordinate == "measurement")
        part = FittedCandidate(candidate, search.recalibrated, 50.0, 40.0, 0.0, 0.0)
        return (AugmentedModel((part,), search.recalibrated, 5.0),)

    monkeypatch.setattr(investigation, "fit_unnamed_models", models)
    monkeypatch.setattr(investigation, "predicts_better", lambda *_, **__: False)
    monkeypatch.setattr(investigation, "errors_left_out", lambda *_, **__: None)
    diagnosis = solved(tmp_path, recordings_of(nothing, drive=0.05), study=among(*OF_OSCILLATORS))
    assert said(diagnosis)["verdict"] == "unexplained" and names(diagnosis) == []
    # It is located where the likeliest function stands.
    place = said(diagnosis)["location"]
    assert place["outputs"] == ["x"] and place["coordinate"] == "measurement" and not place["equations"]


@pytest.mark.slow
def test_random_forces_that_follow_the_motion_are_not_those_of_surroundings(tmp_path: Path) -> None:
    diagnosis = solved(tmp_path, recordings_of(nothing, drive=0.03, fading=True), study=among(*FEW))
    assert said(diagnosis)["verdict"] == "unexplained"
    assert any("hidden state" in remark for remark in said(diagnosis)["remarks"])
    # No function foresees them: the card stays as it was, and this is said.
    assert said(diagnosis)["described"] == []
    assert "the simulation stays as it was" in said(diagnosis)["sentence"]


@pytest.mark.slow
def test_unequal_friction_is_found_though_its_first_fit_may_lead_nowhere(tmp_path: Path) -> None:
    def force(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        return -np.where(v > 0, 0.25, 0.1) * np.tanh(v / 1e-3)

    diagnosis = solved(tmp_path, recordings_of(force, noise=0.03), study=among(*FRICTIONS))
    assert names(diagnosis) == ["asymmetric friction"]
    assert diagnosis.investigation.search.fit.substeps > 12  # the jump was made sharp enough


@pytest.mark.slow
def test_random_forces_stand_for_no_jump_that_is_spread_too_far(tmp_path: Path) -> None:
    def force(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        return -(0.1 + 0.25 * np.exp(-((v / 0.6) ** 2))) * np.tanh(v / 1e-3)

    diagnosis = solved(tmp_path, recordings_of(force, noise=0.003), study=among(*FRICTIONS))
    assert names(diagnosis) == ["Stribeck friction"]
    assert not diagnosis.investigation.search.fit.has_process_noise


@pytest.mark.slow
def test_a_function_of_a_sensor_is_located_in_what_is_measured(tmp_path: Path) -> None:
    table = recordings_of(nothing)
    table["x"] += 0.15 * np.exp(-(((table["x"] - 0.3) / 0.2) ** 2))
    diagnosis = solved(tmp_path, table, study={"held_out": ["r2"]})
    place = said(diagnosis)["location"]
    assert said(diagnosis)["verdict"] == "unexplained"
    assert place["outputs"] == ["x"] and place["coordinate"] == "measurement" and not place["equations"]
    assert said(diagnosis)["described"][0]["outputs"] == ["x"]


@pytest.mark.slow
def test_what_the_dictionary_lacks_is_modelled_without_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = recordings_of(lambda x, v, t: 1.5 * np.exp(-(((x - 0.5) / 0.15) ** 2)), count=6)
    diagnosis = solved(tmp_path, table, study=among(*FEW, held_out=["r2", "r5"]))
    assert said(diagnosis)["verdict"] == "missing physics" and said(diagnosis)["mechanisms"] == []
    assert said(diagnosis)["outcome"] == "modelled"
    assert said(diagnosis)["location"]["coordinate"] == "x"
    # And gets a model: its function of x, which foresees recordings that had no part in it.
    part = said(diagnosis)["described"][0]
    assert part["kind"] == "curve" and part["equations"] == ["v"] and part["coordinates"] == ["x"]
    assert said(diagnosis)["fit"]["augmented"] < 0.5 * said(diagnosis)["fit"]["recalibrated"]
    assert part["shape"] == part["formula"] == ""  # a bump is none of the simple formulas
    assert said(diagnosis)["sentence"].startswith(
        "An effect of x is missing in the equation of v. With it, the error on recordings that it did not see"
        " falls from"
    )
    path = tmp_path / "augmented.yaml"
    path.write_text(diagnosis.to_card(), encoding="utf-8")
    again = load_system(path)
    at = np.linspace(-1.5, 1.5, 61)
    states = np.stack([at, np.zeros_like(at)])
    before = diagnosis.recalibrated
    signals = Signals(np.zeros((1, 61)), np.zeros((0, 61)), np.zeros((0, 61)), at)
    missing = again.functions.rates(states, signals, again.values)[1]
    missing = missing - before.functions.rates(states, signals, before.values)[1]
    assert abs(at[np.argmax(missing)] - 0.5) <= 0.1
    # Where the model that parts left out prefer fails on recordings held out, the next one is asked.
    found = diagnosis.investigation
    best = found.models[0]
    turned = best.fit.model.with_values(-best.fit.model.values)
    wild = replace(best, fit=replace(best.fit, model=turned), exact=None)
    monkeypatch.setattr(investigation, "errors_left_out", lambda *_, **__: np.full(16, 0.1))
    again = held_out_runs(replace(found, models=(wild, best)), diagnosis.case.kept)
    assert (
        again.described is best
        and not held_out_runs(replace(found, models=(wild,)), diagnosis.case.kept).described
    )


@pytest.mark.slow
def test_what_a_name_leaves_is_described_and_no_sample_of_a_test_chooses_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def the_first_alone(
        whole: Search, left: list[Remainder], context: FitContext, **_: object
    ) -> Investigation:
        first = replace(whole, found=whole.found[:1], fit=whole.found[0].best.fit)
        named = MismatchVerdict.MISSING_PHYSICS
        return Investigation(context, first, left[0], named, whole.recalibrated, log_odds=(9.0,))

    # Forecasts would name both.
    monkeypatch.setattr(investigation, "named_by_forecasts", lambda *_: (None, ()))
    monkeypatch.setattr("siq.diagnosis.naming._judge_mechanisms", the_first_alone)
    table = recordings_of(lambda x, v, t: -2.0 * x**3 - 0.1 * v * np.abs(v), count=4)
    parts = {"held_out": ["r2"], "tests": ["r2"], "search": {"mechanisms": 2}}
    study = among("cubic stiffness", "linear damping", "quadratic drag", "process noise", **parts)
    diagnosis = solved(tmp_path, table, study=study)
    verdict = said(diagnosis)
    assert verdict["verdict"] == "missing physics" and names(diagnosis) == ["cubic stiffness"]
    (part,) = verdict["described"]
    assert part["kind"] == "mechanism" and part["equations"] == ["v"] and "v" in part["coordinates"]
    assert part["beside"] == [verdict["mechanisms"][0]["label"]]
    # The card has both, and its error is shown beside that of the name alone.
    assert verdict["fit"]["augmented"] < verdict["fit"]["named"] < verdict["fit"]["recalibrated"]
    assert set(part["parameters"]) <= {entry.name for entry in diagnosis.augmented.parameters}
    effect = f"an effect of {part['coordinates'][0]} in the equation of v"
    assert f"What is left has no name; {effect} desc" in verdict["sentence"]
    # Whatever stands in the tests, the card is the same.
    case = diagnosis.case
    other = replace(case.kept, outputs=case.kept.outputs[::-1] + 0.3)
    again = held_out_runs(diagnosis.investigation, other)
    assert again.fit.model == diagnosis.held_out.fit.model
    assert again.errors.augmented != diagnosis.held_out.errors.augmented


def test_a_bias_and_an_offset_of_the_sensor_are_one_class(tmp_path: Path) -> None:
    diagnosis = solved(
        tmp_path, recordings_of(lambda x, v, t: np.full_like(x, 0.4)), study=among(*OF_OSCILLATORS)
    )
    first = said(diagnosis)["mechanisms"][0]
    assert {first["name"], *first["indistinguishable_from"]} == {"constant bias", "sensor gain or offset"}


def test_units_and_order_change_nothing_but_numbers(tmp_path: Path) -> None:
    table = recordings_of(lambda x, v, t: -0.5 * np.abs(v) * v)
    study = among("quadratic drag", "cubic damping", "cubic stiffness", "process noise")
    metres = solved(tmp_path, table, study=study)
    shuffled = pd.concat([part for _, part in list(table.groupby("recording"))[::-1]])
    shuffled["x"] *= 1000
    card = json.loads(json.dumps(CARD))
    card["states"] = {
        "x": {"unit": "mm", "domain": [-2e3, 2e3]},
        "v": {"unit": "mm/s", "domain": [-4e3, 4e3]},
    }
    card["equations"]["v"] = "(-k*x - d*v + 1000*u)/m"
    millimetres = solved(tmp_path, shuffled, card=card, study=study)
    assert names(metres) == names(millimetres) == ["quadratic drag"]
    ours, theirs = (said(each)["mechanisms"][0]["parameters"]["c_1"] for each in (metres, millimetres))
    assert theirs["estimate"] == pytest.approx(ours["estimate"] / 1000, rel=1e-3)
    assert (ours["unit"], theirs["unit"]) == ("1/m", "1/mm")


def test_domains_that_a_card_does_not_give_are_those_of_the_recordings(tmp_path: Path) -> None:
    table = recordings_of(nothing)
    known = {**CARD, "states": {"x": {"unit": "m", "domain": [-1, 1]}, "v": {"unit": "m/s"}}}
    diagnosis = solved(tmp_path, table, card=known)
    assert diagnosis.verdict == "no mismatch"
    learned = diagnosis.investigation.final.x
    np.testing.assert_array_equal(diagnosis.augmented.domain[0], [-1, 1])  # as declared
    np.testing.assert_array_equal(diagnosis.augmented.domain[1], [learned[:, 1].min(), learned[:, 1].max()])
    assert np.isnan(diagnosis.case.system.limits[1]).all()


@pytest.mark.parametrize(
    "equation",
    [
        "(-k*x + u)/m + 60*v",  # unstable: exp(60 · 0.15) from sample to sample, then beyond all numbers
        "(-k*x - d*v + u)/m + 1e-3*exp(400*x)",
        "(-k*x - d*v + u)/m + sqrt(x)",
    ],
)
def test_a_simulation_that_runs_away_is_told_as_such(equation: str, tmp_path: Path) -> None:
    card = {**CARD, "equations": {"x": "v", "v": equation}}
    with pytest.raises(NumericalFailure, match="cannot be fitted to the recordings: "):
        solved(tmp_path, recordings_of(nothing, count=3), card=card, study={"held_out": ["r2"]})


def test_a_mechanism_that_overflows_ends_itself_and_not_the_diagnosis(tmp_path: Path) -> None:
    further = [
        {
            "name": name,
            "sentence": "It grows beyond all numbers.",
            "forms": [
                {
                    "roles": {"x": "position", "v": "velocity"},
                    "terms": {"v": term},
                    "parameters": {"c": {}},
                    "coordinate": "x",
                }
            ],
        }
        for name, term in (("explosion", "c*exp(1000*x)"), ("chain", "c*exp(exp(30*x))"))
    ]
    study = among("cubic stiffness", "dry friction", mechanisms=further)
    diagnosis = solved(tmp_path, recordings_of(lambda x, v, t: -0.6 * x**3), study=study)
    assert names(diagnosis) == ["cubic stiffness"]
    assert "explosion" in {each.mechanism for each in diagnosis.statement.not_fitted}
    assert all(each.reason for each in diagnosis.statement.not_fitted)


@pytest.mark.parametrize(
    "error",
    [
        ValueError("array must not contain infs or NaNs"),
        *[
            pytest.param(one, marks=pytest.mark.slow)
            for one in (ZeroDivisionError(), FloatingPointError(), np.linalg.LinAlgError("SVD"))
        ],
    ],
)
def test_a_candidate_whose_fit_fails_unforeseen_is_recorded_with_the_reason(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = MechanismCandidate.begun

    def failing(candidate: MechanismCandidate, *further: Any) -> Dynamics:
        if candidate.name == "cubic stiffness":
            raise error
        return begun(candidate, *further)

    monkeypatch.setattr(MechanismCandidate, "begun", failing)
    # Nor what has no name, which would take the place of the failed one, and most of the time.
    for module in (investigation, naming):
        monkeypatch.setattr(module, "fit_unnamed_models", lambda *_: ())
    study = among("cubic stiffness", "quintic stiffness")
    diagnosis = solved(tmp_path, recordings_of(lambda x, v, t: -0.6 * x**3), study=study)
    (failed,) = (each for each in diagnosis.statement.not_fitted if each.mechanism == "cubic stiffness")
    assert type(error).__name__ in failed.reason and str(error) in failed.reason


@pytest.mark.parametrize(
    ("study", "message"),
    [
        ({"held_out": ["r9"]}, "no recording is called 'r9'"),
        ({"held_out": [f"r{index}" for index in range(4)]}, "one side of the split is empty"),
        ({"held_out": ["r2"], "tests": ["r3"]}, "the recording 'r3' is not held out"),
        ({"without": ["friction"]}, "no mechanism is called 'friction'"),
        ({"noise": {"v": 0.1}}, "'v' is no output"),
        ({"varies": ["m"]}, "'m' is no parameter of the card that is free"),
        (
            {"varies": ["d"], "held_out": ["r1", "r2", "r3"]},
            "there is one recording to learn from",
        ),
        ({"held_oud": 0.2}, "perhaps you meant 'held_out'"),
    ],
)
def test_a_study_that_cannot_be_used_is_refused_in_a_sentence(
    study: dict, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        solved(tmp_path, recordings_of(nothing), study=study)
    assert "study.yaml" in str(caught.value)


def test_a_missing_column_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="u"):
        solved(tmp_path, recordings_of(nothing).drop(columns="u"))


@pytest.mark.slow
def test_a_name_that_misleads_on_recordings_held_out_is_withdrawn(tmp_path: Path) -> None:
    def tilted(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        return np.where(np.arange(len(x)) == 2, 0.0, 0.4)  # r2 is level

    table = recordings_of(tilted, count=5)
    diagnosis = solved(tmp_path, table, study=among(*FEW, held_out=["r2"]))
    verdict = said(diagnosis)
    assert verdict["verdict"] == "unexplained" and names(diagnosis) == []
    assert verdict["description"]["misleading"] and verdict["description"]["by"][0]["name"] == "constant bias"
    assert "looks like a constant bias in the equation of v" in verdict["sentence"]
    assert "but recordings held out do not bear that out" in verdict["sentence"]
    assert any("stands in for something else" in line for line in verdict["words"]["left"])
    # Nothing that was found is put into the card that would make it worse.
    assert verdict["described"] == [] and verdict["fit"]["before"] < verdict["fit"]["augmented"]
    # Held out otherwise, the same recordings show the bias and nothing against it.
    level = table["recording"] == "r2"
    diagnosis = solved(tmp_path, table[~level], study=among(*FEW, held_out=["r1"]))
    assert said(diagnosis)["verdict"] == "missing physics"


def test_a_name_has_to_make_recordings_better_that_were_held_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = among("constant bias", "cubic stiffness")
    diagnosis = solved(tmp_path, recordings_of(lambda x, v, t: 0.4 + 0 * x), study=study)
    assert names(diagnosis) == ["constant bias"]
    monkeypatch.setattr("siq.diagnosis.diagnosis.investigate", lambda *_, **__: diagnosis.investigation)
    # One that lands elsewhere in the last third, and was right until then, is not refuted by that.
    off = np.repeat([1.0, 1e-4], [4, 8])
    for share, blocks, verdict in (
        (0.999, 0.999, "missing physics"), (1.001, 1.001, "unexplained"), (1.001, off, "missing physics"),
    ):  # fmt: skip

        def runs(
            found: Investigation, kept: Measurements, share: float = share, blocks: Any = blocks
        ) -> HeldOutRuns:
            shown = held_out_runs(found, kept)
            errors = shown.errors
            squares = dict(errors.squares) | {"augmented": tuple(blocks * np.ones(12) * 0.01)}
            squares[errors.better_without] = (0.01,) * 12
            augmented = share * (errors.error("without") or 1.0)
            return replace(shown, errors=replace(errors, augmented=augmented, squares=squares))

        monkeypatch.setattr("siq.diagnosis.diagnosis.held_out_runs", runs)
        found, *_ = _judged(diagnosis.case, diagnosis.investigation.context.budget)
        assert str(found.verdict) == verdict


def test_where_nothing_speaks_of_a_mismatch_but_a_refuted_name_there_is_none(cleared: Diagnosis) -> None:
    found = cleared.investigation
    assert said(cleared)["verdict"] == "no mismatch"
    refuted = replace(found, verdict=MismatchVerdict.MISSING_PHYSICS)
    again = _withdrawn(refuted)
    assert str(again.verdict) == "no mismatch" and not again.withdrawn and not again.search.found
    assert "diagnosis.refuted" in {one.code for one in again.remarks}
    # Process noise that is needed speaks of one by itself.
    fit = found.search.recalibrated
    forced = replace(fit, noise=replace(fit.noise, process=np.array([0.0, 1e-3])))
    search = replace(found.search, recalibrated=forced)
    forced_one = _withdrawn(replace(refuted, search=search))
    assert str(forced_one.verdict) == "unexplained" and forced_one.withdrawn
