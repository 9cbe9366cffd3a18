from __future__ import annotations

import ast
import json
from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import sympy
import yaml
from scipy.integrate import solve_ivp

from benchmarks.proof.batches import FOREIGN, load_proofs, write_batch
from benchmarks.proof.cases import Design
from benchmarks.proof.concealment.cases import draw_cases as draw_others
from benchmarks.proof.foreign import cases as generator
from benchmarks.proof.foreign.cases import KINDS, draw_cases, make_case
from benchmarks.proof.foreign.effects import LAWS, draw_effect
from benchmarks.proof.foreign.formulas import evaluator
from benchmarks.proof.foreign.motion import Truth, move
from benchmarks.proof.foreign.sensors import Sensors, recorded
from benchmarks.proof.foreign.systems import FAMILIES, Experiment, draw_experiment
from benchmarks.proof.foreign_scores import scores
from benchmarks.proof.foreign_scores.integrator import Integrator
from benchmarks.proof.foreign_scores.oracle import TrueSimulation, true_simulation
from benchmarks.proof.foreign_scores.places import told_places
from benchmarks.proof.foreign_scores.scores import (
    COLUMNS,
    name_error,
    said,
    said_place,
    score_foreign_case,
    unreal_names,
)
from benchmarks.proof.keys import CaseKey, Truth as KeyTruth, read_key, read_truth
from benchmarks.proof.oracle import true_model
from benchmarks.proof.plots import plot_foreign_proof
from benchmarks.proof.scoring import Answer, score_table
from benchmarks.proof.targets import foreign_failures, foreign_targets
from siq.diagnosis.study import Comparison, _measurements_of, read_case
from siq.systems.cards import load_system
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics, Parameter, Signals, symbol

ROOT = Path(__file__).parents[3]
SHARES = {"null": 0.17, "shift": 0.17, "withheld": 0.66}


def design(**other: Any) -> Design:
    """By default two states, three short recordings, and a step in x2 that the equation of x2 lacks."""
    whole: dict[str, Any] = {
        "name": "case-0001", "kind": "withheld", "system": "polynomial", "mechanism": "step",
        "shifted": False, "strength": 0.7, "noise_db": 40.0, "without": (), "seed": 160,
    }  # fmt: skip
    return Design(**{**whole, **other})


def written(tmp: Path) -> tuple[Comparison, CaseKey, KeyTruth, np.ndarray]:
    make_case(design()).write(design().name, cases=tmp / "cases", keys=tmp / "keys")
    folder, keys = tmp / "cases/case-0001", tmp / "keys"
    case = read_case(folder / "system.yaml", folder / "recordings.parquet", folder / "study.yaml")
    truth = read_truth(keys / "case-0001.npz")
    assert truth is not None
    starts = np.load(keys / "case-0001.npz")["starts"]
    chosen = [int(label[1:]) - 1 for label in case.learn.labels]
    return case, read_key(keys / "case-0001.json"), truth, starts[chosen]


Written = tuple[Comparison, CaseKey, KeyTruth, np.ndarray]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("stepped")


@pytest.fixture(scope="module")
def stepped(folder: Path) -> Written:
    return written(folder)


@pytest.fixture(scope="module")
def oracle(stepped: Written) -> TrueSimulation:
    case, key, truth, starts = stepped
    return true_simulation(case, key, truth, starts)


# --- The generator


def test_the_generator_shares_what_a_case_is_with_the_first_and_nothing_with_the_library() -> None:
    files = sorted((ROOT / "benchmarks/proof/foreign").glob("*.py"))
    assert len(files) > 6
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            modules: list[str] = []
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                modules = [node.module or ""]
            assert not [m for m in modules if m.split(".")[0] == "siq"], file.name
            ours = [m for m in modules if m.startswith(("workflow", "benchmarks"))]
            own = ("benchmarks.proof.foreign.", "benchmarks.proof.cases")
            assert all(m.startswith(own) for m in ours), file.name


def test_scores_import_nothing_of_the_search_and_the_verdict_that_they_test() -> None:
    for file in sorted((ROOT / "benchmarks/proof/foreign_scores").glob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("siq.diagnosis"):
                assert node.module == "siq.diagnosis.study", file.name


def test_a_third_of_the_cases_conceal_nothing_and_all_kinds_take_turns() -> None:
    designs = draw_cases(count=60, seed=3, shares=SHARES)
    assert designs == draw_cases(count=60, seed=3, shares=SHARES)
    assert Counter(each.kind for each in designs) == {"null": 10, "shift": 10, "withheld": 40}
    concealed = [each for each in designs if each.kind == "withheld"]
    assert set(Counter(each.mechanism for each in concealed).values()) == {10} and len(LAWS) == 4
    assert {each.system for each in concealed} == set(FAMILIES)
    assert {each.noise_db for each in designs} == {20.0, 30.0, 40.0}
    assert len(draw_others(count=3, seed=3, shares={"null": 1.0})) == 3  # the first generator's is another


@pytest.mark.parametrize("shares", [{"mechanism": 1.0}, {"null": 0.4}])
def test_other_shares_are_refused(shares: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=", ".join(KINDS)):
        draw_cases(count=3, seed=1, shares=shares)


@pytest.mark.parametrize("law", LAWS)
def test_functions_are_what_their_formulas_say_and_finite_where_the_system_moves(law: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(5):
        text = LAWS[law]("x", (-2.0, 3.0), rng)
        x = np.linspace(-2, 3, 200)
        values = evaluator([text], ["x"])({"x": x})[0]
        assert np.isfinite(values).all() and np.ptp(values) > 0.05
        # With numpy's functions alone, and no parser of formulas:
        names = {"x": x, "exp": np.exp, "tanh": np.tanh, "sign": np.sign, "Abs": np.abs, "Max": np.maximum}
        assert np.allclose(values, eval(text, {}, names), rtol=1e-9, atol=1e-12)


def test_a_spline_passes_through_values_and_is_straight_at_its_ends() -> None:
    text = LAWS["spline"]("x", (0.0, 1.0), np.random.default_rng(1))
    x = np.array([-0.3, -0.2, -0.1, 1.1, 1.2, 1.3])
    values = evaluator([text], ["x"])({"x": x})[0]
    for three in (values[:3], values[3:]):
        assert abs(three[2] - 2 * three[1] + three[0]) < 1e-2 * np.ptp(values)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_library_reads_systems_and_effects_as_they_were_simulated(family: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    system = FAMILIES[family](rng)
    ranges = dict.fromkeys(system.states, (0.1, 2.0))
    effect = draw_effect("spline", ranges=ranges, acceptors=system.acceptors,
                         outputs=tuple(system.outputs), rng=rng)  # fmt: skip
    truth = Truth(system, system.parameters, replace(effect, in_sensor=False)).times(0.7)
    (tmp_path / "system.yaml").write_text(yaml.safe_dump(system.card(system.parameters), sort_keys=False))
    assert truth.effect is not None
    key = CaseKey.model_validate(
        {"kind": "withheld", "mechanism": "spline", "effect": truth.effect.formulas()}
    )
    model, _ = true_model(load_system(tmp_path / "system.yaml"), key)
    x, u = rng.uniform(0.1, 2.0, (len(system.states), 30)), rng.normal(size=30)
    empty = np.zeros((0, 30))
    signals = Signals(u[None] if system.driven else empty, empty, empty, np.zeros(30))
    assert np.allclose(
        model.functions.rates(x, signals, model.values), truth.rates(x, u), rtol=1e-8, atol=1e-9
    )
    assert len(system.free) >= 2 and 2 <= len(system.states) <= 6


def test_a_motion_is_accurate_and_so_is_what_lies_between_its_ticks() -> None:
    rng = np.random.default_rng(4)
    system = FAMILIES["mechanical"](rng)
    experiment = draw_experiment(system, rng)
    still = Experiment(np.array([60]), experiment.starts[:, :1], np.zeros((1, 60)))
    truth = Truth(system, system.parameters)
    motion = move(truth, still)
    t = np.sort(rng.uniform(0, 59 * system.interval, 50))
    exact = solve_ivp(
        lambda _, x: truth.rates(x[:, None], np.zeros(1))[:, 0], (0, t[-1]), still.starts[:, 0], "DOP853",
        t_eval=t, rtol=1e-11, atol=1e-12,
    ).y  # fmt: skip
    assert np.abs(motion.at(0, t) - exact).max() < 1e-5 * np.abs(exact).max()


@pytest.mark.parametrize("in_sensor", [False, True])
def test_an_effect_sits_where_its_key_says(in_sensor: bool) -> None:
    rng = np.random.default_rng(0)
    while True:
        effect = draw_effect(
            "bumps", ranges={"x": (0, 1), "v": (-1, 1)}, acceptors=("v",), outputs=("x",), rng=rng
        )
        if effect.in_sensor == in_sensor:
            break
    said = effect.formulas()
    assert ("outputs" in said) == in_sensor and ("terms" in said) != in_sensor
    assert effect.place == ("x" if in_sensor else "v") and said["parameters"] == {"amp": 1.0}


# --- Sensors


@cache
def recording_of(sensors: Sensors) -> tuple[dict[str, np.ndarray], Any]:
    rng = np.random.default_rng(8)
    system = FAMILIES["rational"](rng)
    while system.driven:
        system = FAMILIES["rational"](rng)
    experiment = Experiment(np.array([90, 60, 120]), rng.uniform(0.2, 2, (len(system.states), 3)),
                            np.zeros((3, 120)))  # fmt: skip
    truth = Truth(system, system.parameters)
    table = recorded(truth, move(truth, experiment), experiment, sensors, np.random.default_rng(1))
    return table.columns, table


def test_recordings_are_unequal_and_their_noise_is_as_stated() -> None:
    clean, _ = recording_of(Sensors(300.0, None, 0.0, 0.0))
    noisy, table = recording_of(Sensors(20.0, None, 0.0, 0.0))
    assert sorted(Counter(clean["recording"]).values()) == [60, 90, 120]
    name = next(iter(table.noise))
    assert np.std(noisy[name] - clean[name]) == pytest.approx(0.1 * np.std(clean[name]), rel=0.15)
    assert table.noise[name] == pytest.approx(0.1 * np.std(clean[name]), rel=1e-6)


def test_readings_lie_in_steps() -> None:
    columns, table = recording_of(Sensors(60.0, 7, 0.0, 0.0))
    for name, step in table.steps.items():
        assert np.allclose(columns[name] / step, np.round(columns[name] / step), atol=1e-6)
        assert 60 < np.ptp(columns[name]) / step <= 128


def test_samples_are_lost_as_rows() -> None:
    whole, _ = recording_of(Sensors(40.0, None, 0.0, 0.0))
    some, _ = recording_of(Sensors(40.0, None, 0.1, 0.0))
    assert 0.8 < len(some["t"]) / len(whole["t"]) < 0.95
    step = np.diff(whole["t"][:2])[0]
    within = np.diff(some["t"])[some["recording"][1:] == some["recording"][:-1]]
    assert np.allclose(within / step, np.round(within / step)) and within.max() > 1.5 * step


def test_jitter_is_of_the_times_that_are_not_recorded() -> None:
    exact, _ = recording_of(Sensors(300.0, None, 0.0, 0.0))
    jittering, _ = recording_of(Sensors(300.0, None, 0.0, 0.02))
    assert np.array_equal(exact["t"], jittering["t"])
    name = next(each for each in exact if each not in ("recording", "t"))
    rows = exact["recording"] == "r01"
    speed = np.gradient(exact[name][rows], exact["t"][rows])
    step = exact["t"][1] - exact["t"][0]
    moved = (jittering[name] - exact[name])[rows]
    early = moved[2:-2] / speed[2:-2] / step
    assert np.median(np.abs(early)) == pytest.approx(0.6745 * 0.02, rel=0.35)


# --- Files


def test_a_case_betrays_nothing_and_keys_follow_from_the_seed(
    folder: Path, stepped: Written, tmp_path: Path
) -> None:
    settings = {"cases": 3, "seed": 11, "shares": {"null": 1.0}, "batch": 2}
    found = write_batch(settings, 1, generator=generator, cases=tmp_path / "cases", keys=tmp_path / "keys")
    assert list(found) == ["case-0003"] and len(found["case-0003"]) == 64
    assert found == write_batch(settings, 1, generator=generator, cases=tmp_path / "c", keys=tmp_path / "k")
    names = {path.name for path in (folder / "cases/case-0001").iterdir()}
    assert names == {"system.yaml", "study.yaml", "recordings.parquet"} and stepped[1].kind == "withheld"
    key = json.loads((folder / "keys/case-0001.json").read_text())
    text = (folder / "cases/case-0001/system.yaml").read_text()
    assert "amp" not in text and key["mechanism"] not in text and len(key["salt"]) == 32


def test_the_sets_of_the_second_generator(tmp_path: Path) -> None:
    proofs = load_proofs(ROOT / "config/proof.yaml")
    assert proofs["proof_foreign"].cases >= 200 and set(FOREIGN) < set(proofs)
    for name in FOREIGN:
        assert proofs[name].shares["null"] + proofs[name].shares["shift"] == pytest.approx(1 / 3, abs=0.01)
    small = tmp_path / "proof.yaml"
    small.write_text(
        "".join(
            f"{name}: {{cases: 1, seed: 1, shares: {{shift: 1.0}}}}\n" for name in ("proof", "proof_full")
        )
    )
    assert set(load_proofs(small)) == {"proof", "proof_full"}


# --- The oracle


def test_the_oracle_finds_the_truth_and_runs_at_the_noise(stepped: Written, oracle: TrueSimulation) -> None:
    case, key, _, _ = stepped
    count = case.learn.outputs.size
    assert oracle.true.chi2 == pytest.approx(count, rel=6 * np.sqrt(2 / count))
    assert oracle.delta_chi2 > 100 and oracle.true_error < oracle.card_error and oracle.gain_error > 0
    amplitude = next(each.value for each in oracle.true.model.parameters[::-1])
    assert amplitude == pytest.approx(key.effect.parameters["amp"], rel=0.2)


def test_the_jacobian_is_that_of_the_residuals(oracle: TrueSimulation) -> None:
    fit = oracle.true
    columns, values = fit.jacobian(), fit.model.values
    base = fit.integrator.outputs(fit.integrator.run(values, fit.starts), values) / fit.noise
    free = list(fit.model.free)
    for place, parameter in enumerate(free):
        other = values.copy()
        step = 1e-5 * max(abs(other[parameter]), 1e-3)
        other[parameter] += step
        moved = fit.integrator.outputs(fit.integrator.run(other, fit.starts), other) / fit.noise
        change = ((moved - base) / step).ravel()
        assert np.allclose(columns[:, place], change, rtol=1e-2, atol=1e-3 * np.abs(change).max())


def test_the_integrator_crosses_gaps(oracle: TrueSimulation) -> None:
    fit, data = oracle.true, oracle.true.integrator.data
    whole = fit.integrator.run(fit.model.values, fit.starts)
    kept = np.ones(len(data.t), dtype=bool)
    kept[data.first[0] + 5 : data.first[0] + 10] = False
    first = np.concatenate([[0], np.cumsum([kept[a:b].sum() for a, b in pairwise(data.first)])])
    fewer = replace(data, first=first, t=data.t[kept], outputs=data.outputs[kept])
    states = Integrator(fit.model, fewer).run(fit.model.values, fit.starts)
    assert np.allclose(states, whole[kept], rtol=1e-4, atol=1e-5 * np.abs(whole).max())


def test_the_integrator_knows_the_time() -> None:
    x, c, time = symbol("x"), symbol("c"), symbol("t")
    model = Dynamics(
        ("x",), (sympy.cos(time),), Diffusion.identity(1),
        parameters=(Parameter("c", 0.3),), outputs=(("y", x + c * time),),
    )  # fmt: skip
    t = 5 + np.arange(0, 4, 0.1)
    table = pd.DataFrame({"recording": "r01", "t": t, "y": np.zeros(len(t))})
    integrator = Integrator(model, _measurements_of(table, model))
    states = integrator.run(model.values, np.sin(t[:1])[:, None])
    np.testing.assert_allclose(states[:, 0], np.sin(t), atol=1e-6)
    measured = integrator.outputs(states, model.values)[:, 0]
    np.testing.assert_allclose(measured, np.sin(t) + 0.3 * t, atol=1e-6)
    _, by_parameters = integrator.output_slopes(model.values, states)
    np.testing.assert_allclose(by_parameters[:, 0, 0], t, rtol=1e-5)


def test_a_place_is_told_by_less_than_the_effect_itself(stepped: Written, oracle: TrueSimulation) -> None:
    case, key, _, _ = stepped
    told = told_places(case, key, oracle.true)
    assert 0 < told.equation < told.effect and 0 < told.coordinate < told.effect
    elsewhere = key.model_copy(update={"equations": ("x1",) if key.equations != ("x1",) else ("x2",)})
    # The function itself is among those of the true place, as far as straight lines between knots go.
    assert told_places(case, elsewhere, oracle.true).equation < 0.2 * told.equation


# --- Rulers


def test_a_name_is_measured_by_its_function(
    stepped: Written,
) -> None:
    case, key, truth, _ = stepped
    true, _ = true_model(case.system, key)

    def with_amplitude(factor: float) -> Any:
        values = true.values.copy()
        values[-1] *= factor
        return true.with_values(values)

    assert name_error(case.system, true, key, truth) < 1e-6
    assert name_error(case.system, with_amplitude(1.07), key, truth) == pytest.approx(0.07, abs=0.005)
    assert name_error(case.system, case.system, key, truth) == pytest.approx(1.0, abs=0.01)
    # What free parameters can do is neither for a name nor against it.
    values = true.values.copy()
    values[case.system.free[0]] *= 1.001
    assert name_error(case.system, true.with_values(values), key, truth) < 1e-3


def mechanism(name: str, output: str, step: float) -> dict[str, Any]:
    return {"name": name, "terms": {output: "..."}, "parameters": {"q": {"estimate": step}}}


def test_that_a_sensor_rounds_is_right_where_it_does() -> None:
    key = CaseKey.model_validate({"kind": "null", "sensors": {"steps": {"x": 0.02}, "noise": {"x": 0.1}}})
    assert unreal_names([mechanism("quantisation", "x", 0.0201)], key) == []
    assert unreal_names([mechanism("quantisation", "x", 0.03)], key) == ["quantisation"]
    assert unreal_names([mechanism("quantisation", "y", 0.02)], key) == ["quantisation"]
    assert unreal_names([mechanism("clipping", "x", 0.02)], key) == ["clipping"]
    verdict = {"verdict": "missing physics", "mechanisms": [mechanism("quantisation", "x", 0.02)]}
    assert not said(key, Answer(verdict, ""))["false_alarm"]
    verdict["mechanisms"] = [mechanism("clipping", "x", 0.02)]
    assert said(key, Answer(verdict, ""))["false_alarm"]


def test_the_place_is_that_of_the_verdict() -> None:
    assert said_place({"location": {"equations": {"v": 0.9}, "coordinate": "x, v"}}) == ({"v"}, {"x", "v"})
    sensor = {"equations": {}, "outputs": ["x"], "coordinate": "measurement"}
    assert said_place({"location": sensor}) == ({"sensor x"}, {"x"})
    assert said_place({"location": None}) == (set(), set())


# --- Scores and targets


def test_a_case_is_scored_as_a_whole(
    folder: Path, stepped: Written, oracle: TrueSimulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, key, _, _ = stepped
    monkeypatch.setattr(scores, "true_simulation", lambda *_: oracle)  # which takes seconds
    true, _ = true_model(case.system, key)

    def scored(verdict: str, described: list[Any], location: Any, card: str) -> dict[str, Any]:
        said = {"verdict": verdict, "mechanisms": [], "described": described, "location": location}
        return score_foreign_case(
            "case-0001", folder / "cases/case-0001", folder / "keys", Answer(said, card, 3.0)
        )

    place = {"equations": dict.fromkeys(key.equations, 1.0), "coordinate": key.coordinates[0]}
    row = scored("unexplained", [{"label": "f"}], place, true.to_card())
    assert row["gain_asked"] and row["gain_had"] and row["share_of_gain"] == pytest.approx(1.0, abs=0.05)
    assert row["place_asked"] and row["place_right"] and row["note"] == "" and row["right"]
    row = scored("no mismatch", [], None, case.system.to_card())
    assert row["gain_asked"] and not row["gain_had"] and not row["place_right"] and not row["detected"]
    assert list(score_table([row], COLUMNS).columns) == list(COLUMNS)


def table() -> pd.DataFrame:
    rows: list[dict[str, Any]] = [
        {"case": f"n{k}", "kind": "null", "verdict": "no mismatch", "right": True} for k in range(99)
    ]
    rows += [{"case": "alarm", "kind": "shift", "verdict": "unexplained", "false_alarm": True}]
    rows += [
        {
            "case": f"w{k}", "kind": "withheld", "system": "rational, 3 states", "verdict": "unexplained",
            "noise_db": 30.0, "recordings": 1 + k % 2, "gain_asked": True, "gain_had": k != 0,
            "detected": True, "share_of_gain": 0.97, "place_asked": True, "place_right": k > 1,
            "told_effect": 1e3, "told_equation": 500.0, "wrong_name": k == 5,
        }
        for k in range(20)
    ]  # fmt: skip
    return score_table(rows, COLUMNS)


def test_targets_and_what_counts_against_them() -> None:
    targets = {each.name: each for each in foreign_targets(table())}
    alarms = targets["false alarms among nulls and shifts"]
    assert alarms.measured == 0.01 and alarms.met and alarms.limit == "≤ 1 %"
    place = targets["place right, where the oracle can tell it"]
    assert place.measured == 0.9 and place.met is False
    gain = targets["at least 90 % of the oracle's gain, where that exceeds twice its error"]
    assert gain.measured == 0.95 and gain.met
    assert targets["wrong names among concealed functions"].measured == 0.05
    assert targets["90 % of the gain, learned from one recording"].cases == 10
    counted = {
        text.split(":")[0].split(" that")[0].split(",")[0]: len(f) for text, f in foreign_failures(table())
    }
    assert counted["False alarms"] == 1 and counted["Places"] == 2 and counted["Names"] == 1
    assert counted["Less than 90 % of the oracle's gain."] == 1


def test_the_figure_shows_gains_and_places() -> None:
    figure = plot_foreign_proof(table())
    left, right = figure.axes
    assert left.get_title() == "20 cases" and "20 cases" in right.get_title()
    assert len(plot_foreign_proof(table().iloc[:0]).axes) <= 1
    assert plot_foreign_proof(table().iloc[:3]).axes
