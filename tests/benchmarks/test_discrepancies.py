"""A spring that stiffens, and a card that does not know: every method finds where, and predicts better."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.integrate
import sympy

import siq
from benchmarks.discrepancies import gaussian, methods, ours, sindy, summary, universal
from benchmarks.discrepancies.added import Kernel, Network, Polynomial, Process
from benchmarks.discrepancies.answers import Answer, Term, read_answer, write_answer
from benchmarks.discrepancies.cases import CaseFiles, read_sets
from benchmarks.discrepancies.regression import Equation, chosen_terms, powers
from benchmarks.discrepancies.scores import COLUMNS, judged, place_right, write_scores
from benchmarks.discrepancies.segments import segments_of
from benchmarks.discrepancies.simulation import Simulation
from benchmarks.discrepancies.truth import TrueCase, effect_terms
from benchmarks.proof.foreign_scores.integrator import Integrator
from benchmarks.proof.keys import CaseKey, KeyEffect, KeySensors, Truth
from siq.diagnosis.study import Comparison, MismatchStudy, comparison_of
from siq.systems.dynamics import Parameter

STIFFENING, STIFF, DAMPED = 25.0, 20.0, 0.4
STEP, SAMPLES, NOISE = 0.06, 120, 0.01
CUBE = frozenset({("v", (3, 0))})


def spring(stiff: float) -> siq.Dynamics:
    x, v, k, d = sympy.symbols("x v k d", real=True)
    return siq.Dynamics(
        ("x", "v"), (v, -k * x - d * v), siq.Diffusion.identity(2),
        parameters=(Parameter("k", stiff), Parameter("d", DAMPED)),
    )  # fmt: skip


def recorded(stiffening: float) -> tuple[Comparison, Truth]:
    """Eight decays from amplitudes of 0.3 to 1, both states measured at 40 dB; two are held out."""
    noise = np.random.default_rng(1)
    t, tables, states = STEP * np.arange(SAMPLES), [], []
    for number, start in enumerate(np.linspace(0.3, 1.0, 8)):

        def rates(_: float, z: np.ndarray) -> list[float]:
            return [z[1], -STIFF * z[0] - DAMPED * z[1] - stiffening * z[0] ** 3]

        x, v = scipy.integrate.solve_ivp(rates, (0, t[-1]), [start, 0.0], t_eval=t, rtol=1e-9, atol=1e-9).y
        states.append(np.stack([x, v], axis=1))
        tables.append(pd.DataFrame({"recording": f"r{number}", "t": t, "x": x, "v": v}))
    table, whole = pd.concat(tables), np.concatenate(states)
    for name in ("x", "v"):
        table[name] += NOISE * table[name].std() * noise.normal(size=len(table))
    case = comparison_of(spring(1.1 * STIFF), table, MismatchStudy(held_out=("r2", "r6")))
    x, v = whole.T
    without = np.stack([v, -STIFF * x - DAMPED * v], axis=1)
    true = without - np.stack([0 * x, stiffening * x**3], axis=1)
    return case, Truth(np.tile(t, 8), whole, np.zeros((len(whole), 0)), true, without)


def key_of(stiffening: float) -> CaseKey:
    if not stiffening:
        return CaseKey(kind="shift", sensors=KeySensors(noise={"x": 0.004, "v": 0.02}))
    effect = KeyEffect(terms={"v": "-c*x**3"}, parameters={"c": stiffening})
    return CaseKey(
        kind="mechanism", mechanism="cubic stiffness", equations=("v",), coordinates=("x",), effect=effect,
        noise_db=40.0, sensors=KeySensors(noise={"x": 0.004, "v": 0.02}),
    )  # fmt: skip


@pytest.fixture(scope="module")
def stiffening() -> tuple[Comparison, TrueCase]:
    case, truth = recorded(STIFFENING)
    key = key_of(STIFFENING)
    return case, TrueCase(
        key, truth, np.array([0.004, 0.02]), spring(STIFF), 1e4, effect_terms(case.system, key)
    )


@pytest.fixture(scope="module")
def nothing() -> Comparison:
    return recorded(0.0)[0]


def ended_with(case: Comparison, answer: Answer) -> tuple[siq.Dynamics, object]:
    values = np.array([answer.values[each.name] for each in case.system.parameters])
    return case.system.with_values(values), answer.added


@pytest.fixture(scope="module", params=[sindy.plain, sindy.weak, gaussian.gaussian_process])
def answered(request: pytest.FixtureRequest, stiffening: tuple[Comparison, TrueCase]) -> Answer:
    answer: Answer = request.param(stiffening[0], 60.0, lambda partial: None)
    return answer


def test_others_find_the_equation_and_predict_better(
    answered: Answer, stiffening: tuple[Comparison, TrueCase]
) -> None:
    case, true = stiffening
    assert answered.detected
    assert place_right(true.key, answered) == (True, True)
    alone = true.error(case, case.system.with_values(np.array([STIFF, DAMPED])))
    model, added = ended_with(case, answered)
    assert true.error(case, model, added) < alone / 5


def test_a_cube_is_named_where_there_are_terms(
    answered: Answer, stiffening: tuple[Comparison, TrueCase]
) -> None:
    case, true = stiffening
    said = judged("other", "concealment", case, true, answered)
    assert said["name_right"] == bool(answered.terms)
    assert [term.coefficient for term in answered.terms] == pytest.approx(
        [-STIFFENING] * len(answered.terms), rel=0.05
    )


@pytest.mark.slow
def test_siq_names_it_and_sees_nothing_where_nothing_is(
    stiffening: tuple[Comparison, TrueCase], nothing: Comparison
) -> None:
    case, true = stiffening
    answer = ours.diagnosed(case, 60.0)
    said = judged("siq", "concealment", case, true, answer)
    assert said["name_right"]
    assert said["place_right"]
    assert not ours.diagnosed(nothing, 60.0).detected


@pytest.mark.parametrize("method", [sindy.plain, gaussian.gaussian_process])
def test_others_see_nothing_where_nothing_is(method: Callable[..., Answer], nothing: Comparison) -> None:
    answer = method(nothing, 60.0, lambda partial: None)
    assert answer.answered
    assert not answer.detected


@pytest.mark.slow
def test_a_universal_differential_equation_learns_it(stiffening: tuple[Comparison, TrueCase]) -> None:
    case, true = stiffening
    answer = universal.universal(case, 40.0, lambda partial: None)
    assert answer.detected
    assert place_right(true.key, answer) == (True, True)
    model, added = ended_with(case, answer)
    alone = true.error(case, case.system.with_values(np.array([STIFF, DAMPED])))
    assert true.error(case, model, added) < alone / 5


def test_a_state_that_is_not_measured_keeps_regression_out() -> None:
    x, y = sympy.symbols("x y", real=True)
    hidden = siq.Dynamics(
        ("x", "y"), (-x + y**2, -y), siq.Diffusion.identity(2), outputs=(("x", x),)
    )  # fmt: skip
    t = np.arange(40) * 0.1
    table = pd.concat(pd.DataFrame({"recording": name, "t": t, "x": np.exp(-t)}) for name in "abcd")
    answer = sindy.plain(comparison_of(hidden, table), 60.0, lambda partial: None)
    assert not answer.applied
    assert not answer.answered


def test_simulations_agree_with_those_of_the_proof(stiffening: tuple[Comparison, TrueCase]) -> None:
    case, _ = stiffening
    cube = Polynomial(exponents=[[3, 0]], coefficients=[[0.0], [-STIFFENING]])
    x, v = sympy.symbols("x v", real=True)
    same = siq.Dynamics(
        ("x", "v"), (v, -STIFF * x - DAMPED * v - STIFFENING * x**3), siq.Diffusion.identity(2)
    )
    starts = np.tile([0.5, 0.0], (len(case.learn.labels), 1))
    model = case.system.with_values(np.array([STIFF, DAMPED]))
    ours_run = Simulation(model, case.learn, cube).run(model.values, starts)
    np.testing.assert_allclose(ours_run, Integrator(same, case.learn).run(same.values, starts), atol=1e-9)


def test_what_is_added_survives_its_file(tmp_path: Path) -> None:
    network = Network(
        weights=[[[0.5, 0.1]], [[2.0], [0.0]]], biases=[[0.1], [0.3, 0.0]],
        middle=[0.0, 1.0], width=[1.0, 2.0], size=[1.0, 0.5],
    )  # fmt: skip
    process = Process(
        kernels=[Kernel(equation=1, points=[[0.0, 0.0]], weights=[2.0], lengths=[1.0, 2.0])],
        middle=[0.0, 0.0], width=[1.0, 1.0],
    )  # fmt: skip
    x, u = np.array([[0.2, -1.0], [0.4, 3.0]]), np.zeros((0, 2))
    z = np.array([0.2, -0.3])
    assert network(x, u)[0, 0] == pytest.approx(2 * np.tanh(0.5 * z[0] + 0.1 * z[1] + 0.1) + 0.3)
    assert process(x, u)[1, 0] == pytest.approx(2 * np.exp(-(0.2**2 + 0.2**2) / 2))
    for added in (network, process):
        write_answer(tmp_path / "one.json", Answer(values={"k": 1.0}, added=added))
        assert read_answer(tmp_path / "one.json").added == added


def test_what_parameters_can_do_is_no_discrepancy() -> None:
    draws = np.random.default_rng(0)
    x = draws.normal(size=(400, 1))
    exponents = powers(1)
    library = np.concatenate([x**k for (k,) in exponents], axis=1)
    block = np.arange(400) // 20
    left = 3 * x[:, 0] + 0.1 * draws.normal(size=400)
    assert not chosen_terms(Equation(0, left, x, library, block, block % 4)).detected
    found = chosen_terms(Equation(0, left + 0.5 * x[:, 0] ** 3, x, library, block, block % 4))
    assert found.detected
    assert exponents[found.support].ravel().tolist() == [3]


def test_segments_hold_all_that_was_measured(stiffening: tuple[Comparison, TrueCase]) -> None:
    case, _ = stiffening
    cut = segments_of(case.learn)
    assert np.isfinite(cut.y).sum() == 2 * len(case.learn.begins)
    assert cut.h.sum() == pytest.approx(STEP * (SAMPLES - 1) * len(case.learn.labels))
    assert 0 < cut.left_out.sum() < len(cut.left_out) / 2


def test_who_is_late_has_the_best_answer_so_far(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(case: Comparison, seconds: float, report: Callable[[Answer], None]) -> Answer:
        report(Answer(values={"k": 1.0}))
        while True:
            sum(range(1000))

    def read(files: CaseFiles) -> None:
        return None

    monkeypatch.setattr(methods, "METHODS", {"slow": slow})
    monkeypatch.setattr(CaseFiles, "read", read)
    question = methods.Question(CaseFiles("foreign", "c", tmp_path), "slow", 1.0, tmp_path / "a.json", "abc")
    answer = question.ask()
    assert answer.answered
    assert answer.values == {"k": 1.0}
    assert "not done within 1 s" in answer.fault
    assert question.ask() == answer  # it is not asked again


def test_wrong_terms_are_a_wrong_name(stiffening: tuple[Comparison, TrueCase]) -> None:
    case, true = stiffening
    assert true.terms == CUBE
    square = Term(equation="v", exponents=(2, 0), coefficient=1.0)
    said = judged(
        "PySINDy", "concealment", case, true, Answer(detected=True, terms=(square,), equations=("v",))
    )
    assert said["name_wrong"]
    assert not said["name_right"]
    assert said["equation_right"]
    assert not said["place_right"]


def test_failures_are_counted_and_never_dropped(tmp_path: Path) -> None:
    common = {"generator": "foreign", "case": "c", "kind": "withheld", "knowable": True, "method": "m"}
    rows = [
        common | {"applied": True, "answered": True, "error": np.inf, "error_ratio": np.inf, "seconds": 1.0},
        common | {"applied": False, "answered": False, "error": 2.0, "error_ratio": 2.0, "seconds": 3.0},
        common | {"applied": True, "answered": False, "error": 2.0, "error_ratio": 2.0, "seconds": 5.0},
    ]
    write_scores(rows, tmp_path / "scores.parquet")
    assert list(pd.read_csv(tmp_path / "scores.csv").columns) == list(COLUMNS)
    (found,) = summary.summarised(tmp_path / "scores.parquet").to_dict("records")
    assert (found["cases"], found["ran_away"], found["no_answer"], found["not_applied"]) == (3, 1, 1, 1)
    assert found["error_ratio"] == 2.0
    assert found["error_ratio_high"] == np.inf
    assert "∞" in summary.text(pd.DataFrame([found]))


def test_there_are_twenty_cases_of_each_generator() -> None:
    sets = read_sets(Path(__file__).parents[2] / "config" / "discrepancies.yaml")
    assert (sets.concealment.cases, sets.foreign.cases) == (20, 20)
