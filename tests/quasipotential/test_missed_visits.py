"""Visits of a record are foreseen as they are counted at its samples; a state that was missed is noticed."""

from __future__ import annotations

import numpy as np
import pytest

from siq.data.kinetics import continued_visits
from siq.data.preparation import in_stretches
from siq.data.recordings import Recordings
from siq.data.states import SIGNIFICANCE, DwellCount
from siq.inference.field_estimate import FieldEstimate
from siq.inference.library import IdentificationOptions, field_library
from siq.numerics.integration import FlowMap
from siq.quasipotential.fokker_planck import cores_about
from siq.quasipotential.occupancy import _as_sampled, _core_of, _VisitProcess, check_occupancy
from siq.quasipotential.rates import NoiseStrength
from siq.remarks import sentence
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics
from siq.systems.phase_portrait import phase_portrait

LIBRARY = field_library(["x"], IdentificationOptions(degree=3))


def field(values: dict[str, float], intensity: float) -> FieldEstimate:
    """An f of one state, as if it had been identified."""
    support = np.array([[0, LIBRARY.names.index(name)] for name in values])
    coefficients = np.zeros((LIBRARY.size, 1))
    coefficients[support[:, 1], 0] = list(values.values())
    return FieldEstimate(
        LIBRARY, coefficients, support, 1e-4 * np.eye(len(support)), np.array([[intensity]]), 0.1,
        FlowMap(1), Diffusion.identity(1),
    )  # fmt: skip


def wells() -> Dynamics:
    """``dx = (x - x³) dt + √ε dW``."""
    return field({"x": 1.0, "x**3": -1.0}, 0.5).dynamics


def record(
    intensity: float, step: float, samples: int, recordings: int = 1, substeps: int = 20
) -> np.ndarray:
    """It, simulated: shape ``(recordings, samples, 1)``."""
    generator, h = np.random.default_rng(1), step / substeps
    x, seen = np.ones(recordings), np.empty((recordings, samples, 1))
    for k in range(samples):
        kicks = np.sqrt(intensity * h) * generator.standard_normal((substeps, recordings))
        for kick in kicks:
            x = x + h * (x - x**3) + kick
        seen[:, k, 0] = x
    return seen


@pytest.mark.parametrize(("intensity", "step"), [(0.5, 0.2), (2.0, 0.1)])
def test_visits_are_foreseen_as_samples_show_them(intensity: float, step: float) -> None:
    dynamics = wells()
    portrait = phase_portrait(dynamics, np.linspace(-1.6, 1.6, 100)[:, None], seed=0)
    cores = cores_about(dynamics, portrait.attractors, portrait.saddles, intensity)
    values = record(intensity, step, 800, recordings=400, substeps=10)
    runs = [slice(start, start + 800) for start in range(0, values.size, 800)]
    visits = continued_visits(_core_of(cores, values.reshape(-1, 1)), runs)
    counts = DwellCount.of_visits(np.tile(step * np.arange(800), 400), visits, runs)
    counted = sum(one.time for one in counts) / sum(one.visits for one in counts)
    always, sampled = (
        _VisitProcess(dynamics, intensity, np.array([[-3.5, 3.5]]), one).means[0]
        for one in (cores, _as_sampled(cores, dynamics, intensity, step))
    )
    assert sampled == pytest.approx(counted, rel=0.04)
    assert counted > 1.1 * always  # samples miss visits


def test_a_state_that_the_record_shows_and_f_does_not_is_noticed() -> None:
    values = record(0.3, 0.1, 12_000, substeps=4)[0]
    whole = Recordings.from_arrays(0.1 * np.arange(len(values)), values, names=["x"])
    recordings = in_stretches(whole)
    alone = field({"1": 0.3, "x": -0.5}, 0.3)
    portrait = phase_portrait(alone.dynamics, values[::20], seed=0)
    held = np.arange(len(recordings.labels)) < 2
    found = check_occupancy(alone, portrait, NoiseStrength(0.3), recordings, [(alone, held)])
    verdict = found.verdicts(false_alarms=1e-4)["record"]
    assert not verdict.passed and verdict.value > -np.log10(SIGNIFICANCE)
    assert (
        "hops between two states" in verdict.reason
        and found.missing is not None
        and sentence(found.missing) == verdict.reason
    )
    both = field({"x": 1.0, "x**3": -1.0}, 0.3)
    portrait = phase_portrait(both.dynamics, values[::20], seed=0)
    agreed = check_occupancy(both, portrait, NoiseStrength(0.3, 0.003), recordings, [(both, held)])
    tests = agreed.verdicts(false_alarms=1e-4)
    assert all(one.passed for one in tests.values() if one.tested) and {"connected", "record"} <= tests.keys()
    assert sum(one.whole.visits for one in agreed.visits) > 30


def test_a_single_state_is_no_contradiction() -> None:
    generator = np.random.default_rng(0)
    x = np.zeros((6000, 1))
    for k in range(len(x) - 1):
        x[k + 1] = 0.95 * x[k] + 0.1 * generator.standard_normal()
    recordings = in_stretches(Recordings.from_arrays(0.1 * np.arange(len(x)), x, names=["x"]))
    alone = field({"x": -0.5}, 0.1)
    portrait = phase_portrait(alone.dynamics, x[::10], seed=0)
    found = check_occupancy(
        alone,
        portrait,
        NoiseStrength(0.1),
        recordings,
        [(alone, np.zeros(len(recordings.labels), dtype=bool))],
    )
    assert found.unseen is None and not found.verdicts(false_alarms=1e-4)
    assert sum(one.whole.visits for one in found.visits) == 0
