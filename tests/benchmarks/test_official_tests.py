"""Official tests: what a simulation is told, what is scored, and how ours stand beside published figures."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from benchmarks.publication.official_scores import official_tables, scored_run
from benchmarks.publication.official_tests import official_page, official_rows
from benchmarks.publication.public_recordings import Benchmark, OfficialTest, PublishedError
from siq.data.recordings import Recordings
from siq.inference.measurements import Measurements, measurements
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics

CARD = """\
name: decay
states: {x: {domain: [0, 2]}}
parameters: {k: {value: 1.0}}
equations: {x: -k*x}
"""
STIFF = """\
name: follower
states: {x: {domain: [-2, 2]}}
inputs: {u: {interpolation: zero_order}}
parameters: {k: {value: 40.0}}
equations: {x: -k*(x - u)}
"""


@pytest.fixture
def decay(write) -> Dynamics:
    return load_system(write(CARD))


def recording(model: Dynamics, label: str = "a", values: np.ndarray | None = None) -> Measurements:
    t = np.linspace(0, 1, 101)
    x = np.exp(-t) if values is None else values
    return measurements(Recordings(("x",), (None,), (label,), np.zeros(101, dtype=int), t, x[:, None]), model)


def test_score_is_the_error_of_a_free_run(decay):
    data, variance = recording(decay), np.array([1e-8])
    (right,) = scored_run(decay, data, variance=variance, window=5).errors
    (wrong,) = scored_run(decay.with_values(np.array([1.5])), data, variance=variance, window=5).errors
    assert right < 1e-6 < 1e-3 < wrong


@pytest.mark.parametrize("window", [5, 20])
def test_nothing_behind_the_window_tells_the_initial_state_nor_is_the_window_scored(decay, window):
    truth = np.exp(-np.linspace(0, 1, 101))
    later = truth.copy()
    later[window:] += 0.1
    variance = np.array([1e-8])
    before = scored_run(decay, recording(decay, values=truth), variance=variance, window=window)
    after = scored_run(decay, recording(decay, values=later), variance=variance, window=window)
    assert after.simulated == pytest.approx(before.simulated, abs=1e-12)
    assert after.errors == pytest.approx([0.1], rel=1e-5)


def test_steps_are_as_fine_as_the_simulation_needs(write):
    model = load_system(write(STIFF))
    t = np.arange(101) * 0.1  # at k dt = 4 two steps of Runge and Kutta between samples are far off
    u = np.sign(np.sin(t))
    x = np.empty(101)
    x[0] = 0.0
    for k in range(100):
        x[k + 1] = u[k] + (x[k] - u[k]) * np.exp(-4.0)
    table = Recordings(
        ("x", "u"), (None, None), ("a",), np.zeros(101, dtype=int), t, np.stack([x, u], axis=1)
    )
    run = scored_run(model, measurements(table, model), variance=np.array([1e-6]), window=5)
    assert run.errors[0] < 1e-3


def test_one_table_says_whose_figure_is_whose_and_how_it_was_scored(decay):
    benchmark = Benchmark(
        file="f.csv", what="f.csv", read=lambda path: pytest.fail("nothing is read"), unit="mV", factor=1e3,
        tests={"a": OfficialTest(5, (PublishedError(0.3, "another method", source="its authors"),))},
    )  # fmt: skip
    models = {"recalibrated": decay.with_values(np.array([1.5])), "augmented": decay}
    errors, runs = official_tables(benchmark, models, recording(decay), variance=np.array([1e-8]))
    assert errors["simulation"].tolist() == ["recalibrated", "augmented", "another method"]
    assert errors["error"].iloc[1] < 1e-2 < 10 < errors["error"].iloc[0]  # in mV
    assert errors["source"].tolist() == ["this table", "this table", "its authors"]
    assert "first 5" in errors["scored"].iloc[0]
    assert int((~runs["scored"]).sum()) == 5
    assert runs["augmented"].to_numpy() == pytest.approx(runs["measured"].to_numpy(), abs=1e-5)
    page = official_page(official_rows("decay", errors), {"decay": {"sentence": "Nothing is missing."}})
    assert "| decay | a | another method | 0.3 mV |" in page.replace("0.300", "0.3")
    assert "Nothing is missing." in page


def test_runs_are_drawn_with_few_points_and_lose_no_extreme():
    from benchmarks.publication.plots import FINE, envelope, plot_official_tests

    values = np.zeros(50_000)
    values[31_234] = 3.0
    t, shown = envelope(np.arange(50_000.0), values)
    assert len(t) <= FINE and shown.max() == 3.0 and t[shown.argmax()] == 31_234
    runs = pd.DataFrame(
        {
            "test": "a", "output": "y", "t": np.arange(100.0), "measured": np.zeros(100),
            "scored": np.arange(100) >= 5, "recalibrated": np.ones(100), "augmented": np.zeros(100),
        }
    )  # fmt: skip
    figure = plot_official_tests(runs, unit="V", time_unit="s")
    assert [len(axes.lines) for axes in figure.axes] == [2, 2]
