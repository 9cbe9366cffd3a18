"""`siq.diagnose(..., simulate=...)`: a simulator without equations gets what its equations would get."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

import siq
from siq.diagnosis.dictionary import standard_dictionary

CARD: dict[str, Any] = {
    "name": "pendulum",
    "time_unit": "s",
    "states": {"phi": {"unit": "rad"}, "omega": {"unit": "rad/s"}},
    "parameters": {"k": {"value": 9.0, "unit": "1/s**2"}},
    "equations": {"phi": "omega", "omega": "-k*sin(phi)"},
    "outputs": {"phi": "phi"},
}
BODY: dict[str, Any] = {
    "name": "body",
    "time_unit": "h",
    "states": {"T": {"unit": "K"}},
    "inputs": {"q": {"unit": "kW", "interpolation": "zero_order"}},
    "parameters": {"g": {"value": 0.8, "unit": "K/(kW*h)"}, "a": {"value": 0.5, "unit": "1/h"}},
    "equations": {"T": "g*q - a*T"},
}


def turned(states: Any, inputs: Any, parameters: Any, dt: float, damping: float = 0.0) -> np.ndarray:
    """A Runge–Kutta step of a pendulum."""

    def rate(x: np.ndarray) -> np.ndarray:
        return np.array([x[1], -parameters[0] * np.sin(x[0]) - damping * x[1]])

    x = np.asarray(states, dtype=float)
    a = rate(x)
    b = rate(x + dt / 2 * a)
    c = rate(x + dt / 2 * b)
    return x + dt / 6 * (a + 2 * b + 2 * c + rate(x + dt * c))


def warmed(states: Any, inputs: Any, parameters: Any, dt: float) -> list[Any]:
    """The exact answer of a body that is heated, and loses heat in proportion."""
    (T,), (q,), (g, a) = states, inputs, parameters
    return [g * q / a + (T - g * q / a) * np.exp(-a * dt)]


def swings() -> pd.DataFrame:
    """Pendulums that are damped, k being 9.6/s² and the damping 0.35/s."""
    noise, tables = np.random.default_rng(0), []
    for label, begin in enumerate([(0.5, 0.0), (1.2, 0.0), (2.0, 0.0), (0.2, 2.0)]):
        path = [np.array(begin)]
        for _ in range(590):
            path.append(turned(path[-1], (), (9.6,), 0.01, 0.35))
        phi = np.array(path)[::10, 0]
        tables.append(pd.DataFrame({"recording": label, "t": 0.1 * np.arange(len(phi)), "phi": phi}))
    table = pd.concat(tables, ignore_index=True)
    return table.assign(phi=table.phi + 0.005 * noise.normal(size=len(table)))


def warmings() -> pd.DataFrame:
    """Bodies that also lose 0.03 K/h per K² of heat."""
    noise, tables = np.random.default_rng(0), []
    for label in range(3):
        q, T, course = np.repeat(noise.uniform(0, 6, 6), 15), noise.uniform(0, 6), []
        for heat in q:
            course.append(T)
            for _ in range(50):
                T += 0.002 * (heat - 0.5 * T - 0.03 * T * abs(T))
        tables.append(pd.DataFrame({"recording": label, "t": 0.1 * np.arange(len(q)), "T": course, "q": q}))
    table = pd.concat(tables, ignore_index=True)
    return table.assign(T=table["T"] + 0.02 * noise.normal(size=len(table)))


@pytest.mark.parametrize(
    ("card", "simulate", "recordings", "kept"),
    [
        pytest.param(CARD, turned, swings(), {"phi": "omega"}, marks=pytest.mark.slow, id="pendulum"),
        pytest.param(BODY, warmed, warmings(), {}, id="first order"),
    ],
)
def test_a_simulator_gets_what_its_equations_get(
    card: dict[str, Any], simulate: Any, recordings: pd.DataFrame, kept: dict[str, str]
) -> None:
    # What a dictionary of ninety has does not depend on who runs the equations: a few mechanisms are enough.
    some = {
        "linear damping",
        "quadratic drag",
        "gravity",
        "decay or leakage",
        "thermal radiation",
        "hidden capacity",
    }
    without = [each.name for each in standard_dictionary() if each.name not in some]
    settings = siq.MismatchStudy(without=without)
    written = siq.diagnose(siq.load_system(card), recordings, settings=settings)
    asked = siq.diagnose(card | {"equations": kept}, recordings, simulate=simulate, settings=settings)
    assert asked.verdict == written.verdict == "missing physics"
    assert [each.label for each in asked.mechanisms] == [each.label for each in written.mechanisms]
    assert asked.location is not None and written.location is not None
    assert asked.location.equations == pytest.approx(written.location.equations, rel=1e-6)
    assert asked.location.coordinate == written.location.coordinate
    # Drag has a name; a loss like the square of T is a function without one.
    ours, theirs = (
        (each.mechanisms or each.statement.described)[0].parameters["c_1"] for each in (asked, written)
    )
    assert ours.unit == theirs.unit
    assert ours.standard_error == pytest.approx(theirs.standard_error, rel=0.01)
    for one, other in zip(asked.augmented.parameters, written.augmented.parameters, strict=True):
        assert one.name == other.name
        error = 0.01 * theirs.standard_error if one.name == "c_1" else 1e-4 * abs(other.value)
        assert one.value == pytest.approx(other.value, abs=error)
    for stage in ("recalibrated", "augmented"):
        here, there = (getattr(each.held_out.errors, stage) for each in (asked, written))
        assert here == pytest.approx(there, rel=1e-3), stage
    state = card["equations"].keys() - kept.keys()
    assert f"simulated_{state.pop()}(" in str(asked.augmented.equations)
    assert asked.report() and asked._repr_html_() and asked.to_card()


def test_a_simulator_that_fails_is_told_before_anything_is_fitted() -> None:
    def raising(*_: Any) -> None:
        raise ValueError("out of range")

    with pytest.raises(
        siq.InputError, match=r"the simulator, at phi = .*: it raises ValueError: out of range"
    ):
        siq.diagnose(CARD, swings(), simulate=raising)
    with pytest.raises(siq.InputError, match=r"the simulator, at T = .*: the next T is no number"):
        siq.diagnose(BODY, warmings(), simulate=lambda s, i, p, dt: s * np.nan)


def test_the_step_is_a_sixteenth_of_the_time_between_samples_or_as_given() -> None:
    steps = set()

    def counted(states: Any, inputs: Any, parameters: Any, dt: float) -> Any:
        steps.add(dt)
        raise KeyError("enough")

    for step in (None, 0.02):
        with pytest.raises(siq.InputError, match="it raises KeyError"):
            siq.diagnose(CARD, swings(), simulate=counted, step=step)
    assert sorted(steps) == pytest.approx([0.1 / 16, 0.02])
