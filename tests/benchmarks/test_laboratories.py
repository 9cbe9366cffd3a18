"""The simulated laboratories themselves: barriers, bounds and counts that are known otherwise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.laboratories import summary
from benchmarks.laboratories.__main__ import tasks
from benchmarks.laboratories.bounds import bound, inverse
from benchmarks.laboratories.coverage import CONFIDENCES, landscape_figures, landscape_table
from benchmarks.laboratories.information import information, information_of_states
from benchmarks.laboratories.models import LABORATORIES, Laboratory
from benchmarks.laboratories.others import OTHERS
from benchmarks.laboratories.records import crossings, generator, recorded, table
from benchmarks.laboratories.truths import Truth, truth


@pytest.mark.parametrize(
    ("name", "barriers"),
    [
        ("hop", [0.5, 0.5]),  # U = x⁴/2 - x² + (1 + x²)y² + 1/2
        ("archetype", [1.0, 1.0]),  # U = x⁴ - 2x² + y² + z² + 1
        ("resonator", [1.047e-8, 8.16e-9]),  # by minimum action, as the documentation has them
    ],
)
def test_barriers_of_several_states(name: str, barriers: list[float]) -> None:
    assert truth(LABORATORIES[name]).barriers == pytest.approx(barriers, rel=1e-3)


def test_barriers_of_the_trap_are_those_of_its_energy() -> None:
    known = truth(LABORATORIES["trap"])

    def energy(x: np.ndarray) -> np.ndarray:
        return 4 * ((x / 0.25) ** 2 - 1) ** 2 - 0.3 * x / 0.25

    assert known.barriers == pytest.approx(
        (energy(known.saddles) - energy(known.attractors)).ravel(), rel=1e-9
    )


@pytest.mark.parametrize(
    "name", ["hop", pytest.param("resonator", marks=pytest.mark.slow), "state-dependent", "trap"]
)
def test_derivatives_of_barriers_are_those_of_differences(name: str) -> None:
    laboratory = LABORATORIES[name]
    known, values = truth(laboratory), laboratory.parameters
    for place in (0, len(laboratory.terms) - 1, len(values) - 1):
        step = 1e-3 * abs(values[place]) * np.eye(len(values))[place]
        up, down = (truth(laboratory.with_parameters(values + sign * step)).barriers for sign in (1, -1))
        slope = known.slopes[:, place] * 2 * step[place]
        assert up - down == pytest.approx(slope, rel=1e-2, abs=2e-6 * known.barriers.max())


def relaxation(sensor: float = 0.0) -> Laboratory:
    """``dx = -x dt + √0.2 dW``."""
    return Laboratory(
        name="relaxation", title="", states=("x",), drift=({(1,): -1.0},), intensity={(0,): 0.2},
        attractors=((0.0,),), saddles=((1.0,),), records=2, samples=2_000, step=0.05,
        sensor_noise=(sensor,),
    )  # fmt: skip


def test_information_without_sensor_noise() -> None:
    """Of the rate h Σ x²/q, which is T/2 in the mean; of q half a unit of log q for each step."""
    laboratory = relaxation()
    matrix = information_of_states(laboratory, recorded(laboratory, generator(laboratory, 0)))
    steps = laboratory.records * (laboratory.samples - 1)
    assert matrix[0, 0] == pytest.approx(steps * laboratory.step / 2, rel=0.25)
    assert matrix[1, 1] == pytest.approx(steps / 2 / 0.2**2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["relaxation", "trap", "hop-02", "state-dependent"])
def test_scores_have_the_covariance_of_the_information(name: str) -> None:
    """What makes it a bound: derivatives of the log-likelihood have the mean zero and the covariance G."""
    laboratory = relaxation(sensor=0.1) if name == "relaxation" else LABORATORIES[name].shorter(2_000)
    squares, count = [], 0
    for seed in range(24):
        found = information(laboratory, recorded(laboratory, generator(laboratory, seed)), substeps=5)
        count = len(found.score)
        squares.append(found.score @ inverse(found.matrix) @ found.score)
    spread = np.sqrt(2 * count / len(squares))
    assert np.mean(squares) == pytest.approx(count, abs=4 * spread)


@pytest.mark.slow
def test_information_with_and_without_a_filter_agree() -> None:
    laboratory = LABORATORIES["hop"].shorter(3_000)
    seen = recorded(laboratory, generator(laboratory, 0))
    matrix = information(laboratory, seen, substeps=1).matrix
    assert np.diag(matrix) == pytest.approx(np.diag(information_of_states(laboratory, seen)), rel=0.02)


def test_the_bound_of_the_tryouts() -> None:
    """0.018 of 0.5: what the identification reached on them where no sensor noise was."""
    assert bound(LABORATORIES["hop"], simulated=1).barriers == pytest.approx([0.018, 0.018], rel=0.1)


@pytest.mark.parametrize("name", list(LABORATORIES))
def test_records(name: str) -> None:
    laboratory = LABORATORIES[name].shorter(500)
    seen, again, other = (recorded(laboratory, generator(laboratory, seed)) for seed in (3, 3, 4))
    assert np.array_equal(seen, again)
    assert not np.array_equal(seen, other)
    assert list(table(laboratory, seen).columns) == ["recording", "t", *laboratory.states]


def test_exposure_takes_a_third_of_the_increments() -> None:
    """The mean of Brownian motion over a step: increments have the variance 2/3 qh instead of qh."""
    laboratory = LABORATORIES["trap"].shorter(20_000)
    seen = recorded(laboratory, generator(laboratory, 0))[0, :, 0]
    change = np.diff(seen).var() - 2 * laboratory.sensor[0] ** 2
    moved = laboratory.intensities[0] * laboratory.step
    assert change == pytest.approx(2 / 3 * moved, rel=0.1)  # the force takes a little, too


def test_crossings() -> None:
    laboratory = LABORATORIES["hop"]
    x = np.array([1.0, 0.9, 0.1, -0.1, 0.9, 0.0, -0.9, -1.0, 0.2, 1.1])  # two: what turns back is none
    assert crossings(laboratory, np.stack([x, 0 * x], axis=1)[None]) == 2


@pytest.mark.parametrize("method", ["Kramers–Moyal", pytest.param("PySINDy", marks=pytest.mark.slow)])
def test_other_methods_find_the_barrier_of_a_clean_record(method: str) -> None:
    laboratory = LABORATORIES["hop-often"]
    known = truth(laboratory)
    answer = OTHERS[method](laboratory, recorded(laboratory, generator(laboratory, 0)), known)
    assert answer.barriers == pytest.approx(
        [0.5, 0.5], abs=0.12
    )  # five bounds: they choose no terms as we do


def answer(
    *, barrier: float, error: float = 0.1, certified: bool = True, **other: object
) -> dict[str, object]:
    said = {
        "certified": certified, "barriers": [barrier, 1.0], "standard_errors": [error, error],
        "extra_wells": 0, "wrong_branch": False, "seconds": 1.0,
    }  # fmt: skip
    return {"crossings": 4, "siq": said | other}


def test_the_table_counts_errors_and_false_certificates() -> None:
    answers = [
        answer(barrier=1.1),
        answer(barrier=1.4),  # four errors off: false
        answer(barrier=1.0, extra_wells=1),  # an invented well: false
        answer(barrier=1.0, wrong_branch=True),  # false
        answer(barrier=float("nan")),  # a missing one: false
        answer(barrier=9.0, certified=False),
    ]
    row = summary.row("hop", "siq", answers, {"barriers": [1.0, 1.0], "bounds": [0.1, 0.1]})
    assert row.false == 4
    assert (row.records, row.certified, row.answered) == (6, pytest.approx(5 / 6), pytest.approx(5 / 6))
    assert row.ratio_certified == pytest.approx(np.sqrt((1 + 16) / 9))
    assert row.covered_certified == pytest.approx(8 / 9)
    assert "| hop | siq | 6 | 4.0 |" in summary.text([row])


def test_a_run_is_resumed_seed_by_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SFI_PYTHON", raising=False)
    wanted = tasks(["hop", "trap"], seeds=2, others=1)
    assert [(one.laboratory, one.seed, one.method) for one in wanted] == [
        ("hop", 0, "siq"), ("hop", 0, "Kramers–Moyal"), ("hop", 0, "PySINDy"),
        ("trap", 0, "siq"), ("trap", 0, "Kramers–Moyal"), ("trap", 0, "PySINDy"),
        ("hop", 1, "siq"), ("trap", 1, "siq"),
    ]  # fmt: skip
    (tmp_path / "hop").mkdir()
    (tmp_path / "hop" / "000.json").write_text(
        json.dumps({"laboratory": repr(LABORATORIES["hop"])} | answer(barrier=0.5)), encoding="utf-8"
    )
    known = Truth(np.zeros((2, 1)), np.zeros((2, 1)), np.zeros((2, 1, 1)), np.ones(2), np.ones((2, 1)))
    file = tmp_path / "hop" / "truth.json"
    key = {"laboratory": repr(LABORATORIES["hop"]), "barriers": known.barriers.tolist(), "bounds": [0.1, 0.1]}
    file.write_text(json.dumps(key), encoding="utf-8")
    (row,) = summary.summarised(tmp_path, ["hop", "trap"])
    assert row.records == 1


def test_intervals_of_what_a_user_reads_hold_in_drawn_laboratories() -> None:
    # Of one passage to eleven, with and without a noisy sensor; two of them sampled coarsely. The seeds are
    # fixed; the benchmark counts over hundreds.
    found = {str(seed): landscape_figures(seed) for seed in (0, 1, 3, 10)}
    assert {name: one["fault"] for name, one in found.items() if one["fault"]} == {}
    figures = [each for one in found.values() for each in one["figures"]]  # type: ignore[attr-defined]
    assert {what for what, _ in figures} == {"f", "ε", "position", "barrier", "time"}
    beyond = [(what, off) for what, off in figures if not abs(off) < CONFIDENCES["95 %"]]
    assert len(beyond) < 5 and len(figures) > 24
    assert "| barrier | 1 to 10 |" in landscape_table(found)
