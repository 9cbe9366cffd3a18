"""The dictionary as physics: where entries apply, what is no candidate, and that each is found at home."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import sympy
from homes_of_mechanisms import HOMES, RESIDENTS, candidates, model_of, numbers, recorded, states, truth_of

from siq.data.correlation import resolution_step
from siq.diagnosis.dictionary import Mechanism, Shape, roles_of, standard_dictionary
from siq.diagnosis.mechanisms import (
    MechanismCandidate,
    _plateau,
    places_of,
)
from siq.diagnosis.screening import Probe, screen_all
from siq.diagnosis.study import SearchOptions, _measurements_of
from siq.inference.measurements import Measurements
from siq.inference.recalibration import recalibrate
from siq.systems.dynamics import Dynamics, _without_teeth, symbol

OSCILLATOR = {
    "time_unit": "s",
    "states": states(x="m", v="m/s"),
    "inputs": {"u": {"unit": "N"}},
    "outputs": {"x": "x"},
}


@cache
def dictionary() -> tuple[Mechanism, ...]:
    return standard_dictionary()


def names(model: Dynamics) -> set[str]:
    return {each.name for each in candidates(model)}


def oscillator(equation: str, **parameters: float) -> Dynamics:
    return model_of(
        {**OSCILLATOR, "parameters": numbers(**parameters), "equations": {"x": "v", "v": equation}}
    )


# What the file says


def test_entries_refer_to_entries_and_to_sources() -> None:
    known = {each.name for each in dictionary()}
    for each in dictionary():
        special = {*each.generalises, *(name for form in each.forms for name in form.generalises)}
        assert {*each.look_alikes} | special <= known - {each.name}, each.name
        assert re.search(r"\b(1[67]\d\d|1[89]\d\d|20\d\d)\b", each.reference), each.name
        assert each.sentence.endswith("."), each.name


def test_every_parameter_is_used() -> None:
    for each in dictionary():
        for form in each.forms:
            within = [text for texts in form.within.values() for text in texts.values()]
            further = [text for state in form.states.values() for text in (state.equation,)]
            texts = [*form.terms.values(), *form.replace.values(), *form.outputs.values(), *within, *further]
            used = set(re.findall(r"\w+", " ".join(map(str, texts))))
            assert set(form.parameters) <= used, each.name


def test_every_form_has_a_home() -> None:
    at_home = {resident.name for resident in RESIDENTS}
    assert at_home == {each.name for each in dictionary()} - {"process noise"}


# Where entries apply


def test_angles_are_told_from_displacements() -> None:
    assert roles_of(HOMES["pendulum"].model).angles == ("q",)
    assert roles_of(HOMES["mass"].model).angles == ()
    by_sine = model_of({"states": states(a="1", w="1"), "equations": {"a": "w", "w": "-sin(a)"}})
    assert roles_of(by_sine).angles == ("a",)


def test_who_feeds_on_whom_follows_from_the_meetings() -> None:
    assert roles_of(HOMES["prey and predator"].model).feeding == (("n", "p"),)
    rivals = model_of({"states": states(n="1", m="1"), "equations": {"n": "n - n*m", "m": "m - 2*n*m"}})
    assert roles_of(rivals).feeding == () and roles_of(rivals).populations == ("n", "m")


def test_a_store_has_a_unit() -> None:
    assert roles_of(HOMES["heat"].model).stores == ("s", "r")
    equations = {"s": "1 - s", "r": "0.2*(s - r) + 1"}
    assert roles_of(model_of({"states": states(s="1", r="1"), "equations": equations})).stores == ()
    # A number that begins at 0 is one of molecules, or of calls that wait.
    counted = {"s": {"unit": "1", "domain": [0, 20]}, "r": {"unit": "1", "domain": [-5, 5]}}
    assert roles_of(model_of({"states": counted, "equations": equations})).stores == ("s",)


@pytest.mark.parametrize(
    ("home", "strangers"),
    [
        ("mass", {"gravity", "moment of inertia", "overflow", "mortality", "harvest", "Allee effect",
                  "decay or leakage", "delayed response", "linear coupling", "prey refuge"}),
        ("pendulum", {"added mass", "preload", "geometric stiffness", "input delay", "clock offset and drift",
                      "saturation", "overflow"}),
        ("rotating frame", {"dry friction in a", "backlash", "decay or leakage", "mortality", "overflow",
                            "hysteresis", "added mass"}),
        ("crop", {"prey refuge", "sigmoid functional response", "predator interference", "delayed response",
                  "overflow", "linear damping", "clock offset and drift"}),
        ("heat", {"overflow", "mortality", "harvest", "linear damping", "linear stiffness", "gravity"}),
        ("two tanks", {"decay or leakage", "mortality", "linear damping", "dry friction", "gravity"}),
    ],
)  # fmt: skip
def test_no_entry_is_tried_where_it_makes_no_sense(home: str, strangers: set[str]) -> None:
    assert not names(HOMES[home].model) & strangers


# What a free parameter can do is no candidate


@pytest.mark.parametrize(
    ("equation", "parameters"),
    [
        ("-k*x - d*v + u", {"k": 4.0, "d": 0.3}),
        ("(-k*x - d*v + u)/m", {"k": 4.0, "d": 0.3, "m_": 2.0}),
        ("u - r**2*x - 2*z*r*v", {"r": 2.0, "z": 0.1}),  # a frequency and a damping ratio
        ("u - k*x - k*d*v", {"k": 4.0, "d": 0.0}),  # that happens to be zero
        ("u - (k + d)*(x + v) + d*x", {"k": 4.0, "d": 0.3}),  # in combinations only
    ],
)
def test_linear_damping_and_stiffness_are_no_mechanisms_beside_free_parameters_like_them(
    equation: str, parameters: dict[str, float]
) -> None:
    assert not {"linear damping", "linear stiffness"} & names(oscillator(equation, **parameters))


def test_they_are_where_the_parameter_is_fixed_or_missing() -> None:
    assert "linear damping" in names(oscillator("u - k*x - d*v", k=4.0, d_=0.3))
    assert "linear damping" in names(oscillator("u - k*x", k=4.0))
    assert "linear stiffness" in names(oscillator("u - d*v", d=0.3))
    # One parameter that turns both up together does not stand for either of them.
    assert {"linear damping", "linear stiffness"} <= names(oscillator("u - k*(x + v)", k=4.0))


def test_it_is_the_formula_that_counts_and_not_the_sign_of_what_was_recorded() -> None:
    # On positive speeds alone v² could not be told from |v| v.
    assert "quadratic drag" in names(oscillator("u - k*x - q*v**2", k=4.0, q=0.1))
    assert "quadratic drag" not in names(oscillator("u - k*x - q*v*Abs(v)", k=4.0, q=0.1))


def test_an_amplitude_that_a_parameter_stands_for_is_taken_out_of_its_mechanism() -> None:
    (coupling,) = (each for each in candidates(HOMES["heat"].model) if each.name == "linear coupling")
    assert coupling.equations == ("s",) and len(coupling.amplitudes) == 1
    assert coupling.positive == frozenset()  # it adds to what the parameter does
    assert [place for place, _ in coupling.changes] == ["s"]
    assert coupling.new == coupling.amplitudes


# What the formulas of entries may name


def test_a_mass_that_is_added_divides_all_forces() -> None:
    truth = truth_of(next(each for each in RESIDENTS if each.name == "added mass"))
    c = sympy.Symbol(truth.amplitudes[0], real=True)
    before = HOMES["mass"].model.equations[1]
    assert sympy.simplify(truth.model.equations[1] - before / (1 + c)) == 0


def test_two_joints_with_inertia_of_their_own() -> None:
    """With M the mass matrix of a double pendulum, M a = F, and with I on its diagonal (M + I) a = F."""
    model = HOMES["double pendulum"].model
    resident = next(each for each in RESIDENTS if each.home == "double pendulum")
    truth = truth_of(resident).model
    rng = np.random.default_rng(0)
    for _ in range(3):
        x = rng.normal(size=(1, 4))
        mixed = np.cos(x[0, 0] - x[0, 2])
        mass = np.array([[2.0, mixed], [mixed, 1.0]])  # equal masses and lengths
        own = np.diag([2.0 * resident.values["c"], 1.0 * resident.values["d"]])
        before, after = model.drift(x)[0, [1, 3]], truth.drift(x)[0, [1, 3]]
        np.testing.assert_allclose(after, np.linalg.solve(mass + own, mass @ before), rtol=1e-10)


def test_a_delay_acts_within_one_equation_only() -> None:
    truth = truth_of(next(each for each in RESIDENTS if each.name == "delayed response"))
    before = HOMES["prey with limits and predator"].model
    assert truth.equations == ("p",) and truth.model.equations[0] == before.equations[0]
    assert truth.begins == (sympy.Symbol("n", real=True),)


def test_a_clock_that_is_late_shows_what_was_before() -> None:
    truth = truth_of(next(each for each in RESIDENTS if each.name == "clock offset and drift"))
    x, v, o = (sympy.Symbol(name, real=True) for name in ("x", "v", truth.amplitudes[0]))
    late = dict(truth.model.outputs)["x"]
    assert sympy.expand(late.subs(o, 0)) == x
    assert sympy.expand(late.diff(o).subs(o, 0)) == -v
    assert sympy.expand(late.diff(o, 2) - HOMES["mass"].model.equations[1]) == 0


def test_the_step_of_a_sensor_is_read_off_what_it_recorded() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=500)
    assert resolution_step(0.25 * np.rint(values / 0.25)) == pytest.approx(0.25)
    assert resolution_step(np.append(0.1 * np.rint(values / 0.1), np.nan)) == pytest.approx(0.1)
    assert resolution_step(values) is None
    assert resolution_step(0.25 * np.rint(values / 0.25) + 0.1) == pytest.approx(0.25)
    assert resolution_step(np.zeros(50)) is None


def test_a_sensor_ends_where_recorded_values_stay() -> None:
    rng = np.random.default_rng(0)
    wave = np.sin(0.3 * np.arange(200))
    one = np.zeros(200, dtype=int)
    noise = 0.01 * rng.normal(size=200)
    assert _plateau(np.minimum(wave, 0.7) + noise, one, noise=0.01) == pytest.approx(0.7, abs=0.01)
    assert _plateau(-np.maximum(wave, -0.5) + noise, one, noise=0.01) == pytest.approx(0.5, abs=0.01)
    assert _plateau(wave + noise, one, noise=0.01) is None
    # Three in a row belong to one recording.
    assert _plateau(np.array([0.0, 1.0, 1.0, 1.0, 0.0]), np.array([0, 0, 0, 1, 1]), noise=1e-3) is None


def test_a_sawtooth_rounds_and_its_slope_is_that_of_what_it_rounds() -> None:
    y, q = sympy.symbols("y q", real=True)
    rounded = y - q / sympy.pi * sympy.atan(sympy.tan(sympy.pi * y / q))
    at = np.linspace(-2.03, 2.11, 50)
    np.testing.assert_allclose(sympy.lambdify((y, q), rounded)(at, 0.3), 0.3 * np.rint(at / 0.3), atol=1e-12)
    assert _without_teeth(rounded).diff(y) == 1
    assert _without_teeth(sympy.atan(y)) == sympy.atan(y)


def test_the_time_of_a_course_is_that_in_which_it_changes() -> None:
    data = recorded(next(each for each in RESIDENTS if each.name == "constant bias"))
    model = HOMES["mass"].model
    wave = np.stack([np.sin(2.0 * data.t), 2.0 * np.cos(2.0 * data.t)], axis=1)
    places = places_of(Shape(time_of="x", at=(1.0, 3.0)), data, model, wave)
    np.testing.assert_allclose(places, [0.5, 1.5], rtol=0.03)  # 1/ω, less what straight lines cut off


def test_recordings_on_one_clock_tell_a_frequency_to_a_part_of_their_span() -> None:
    model, table, waves = HOMES["mass"].model, [], np.random.default_rng(0)
    for number in range(3):
        t = 300.0 * number + 0.4 * np.arange(500)
        x = np.cos(0.7413 * t) + 0.5 * waves.normal(size=500)
        table.append(pd.DataFrame({"recording": number, "t": t, "x": x, "u": 0.0}))
    data = _measurements_of(pd.concat(table), model)
    places = places_of(Shape(frequencies=90), data, model, np.zeros((1500, 2)))
    assert np.abs(places - 0.7413).min() < 0.25 / 800  # of a turn over all of them


def test_a_sign_is_lost_only_where_the_simulation_has_one() -> None:
    resident = next(each for each in RESIDENTS if each.name == "rectification")
    data, model, candidate = recorded(resident), HOMES["cart"].model, the("rectification", "cart")
    (name,), x = candidate.shapes, data.outputs

    def tried(candidate: MechanismCandidate, data: Measurements) -> list[Probe]:
        return Probe.all_of(candidate, data, model, x)

    (probe,) = tried(candidate, data)
    assert dict(probe.shapes) == {name: 1.0}
    assert not tried(candidate, replace(data, outputs=x - 0.5))
    assert not tried(replace(candidate, model=candidate.begun(model, {"g": 0.0})), data)
    # Fits that follow the recordings have lost it; the simulation that runs by itself has it, and values.
    fit, _ = recalibrate(model, data)
    known, states = probe.begin(fit, data, fit.x)
    assert known == pytest.approx({"g": 0.4, "d": 0.3, name: 1.0}, rel=0.02)
    assert abs(fit.model.parameters[0].value) < 0.2
    assert (states < -0.5).any() and np.abs(np.abs(states) - x).max() < 0.1


def test_a_period_has_to_come_back_within_a_recording() -> None:
    resident = next(each for each in RESIDENTS if each.name == "periodic forcing")
    data, model = recorded(resident), HOMES[resident.home].model
    longest = float(np.ptp(data.t[data.recording == 0]))
    lowest = places_of(Shape(frequencies=90), data, model, np.zeros((len(data.t), model.dimension))).min()
    assert lowest == pytest.approx(4 * np.pi / longest)
    candidate = next(each for each in candidates(model) if each.name == resident.name)
    (name,) = candidate.shapes
    for frequency in (1.2 * lowest, 0.95 * lowest, 0.6 * lowest):
        fitted = candidate.begun(model, {name: frequency})
        fit: Any = SimpleNamespace(model=fitted, error_of={name: 0.03 * lowest})
        assert candidate.admits(fit, data) == (frequency > 0.9 * lowest)


def test_a_time_that_no_recording_shows_is_no_time_constant() -> None:
    resident = next(each for each in RESIDENTS if each.name == "actuator lag")
    data, model, candidate = recorded(resident), HOMES["mass"].model, the("actuator lag", "mass")
    (name,) = candidate.shapes
    longest = float(np.ptp(data.t[data.recording == 0]))
    for time in (0.1 * longest, 1e6 * longest):
        fit: Any = SimpleNamespace(model=candidate.begun(model, {name: time}), error_of={name: 0.1 * time})
        assert candidate.admits(fit, data) == (time < longest)


# Each is found at home


SCREENED = (
    "linear stiffness", "geometric stiffness", "preload", "backlash", "added mass", "moment of inertia",
    "linear damping", "linear coupling", "mortality", "harvest", "Allee effect", "prey refuge",
    "sigmoid functional response", "predator interference", "decay or leakage", "delayed response",
    "thermal drift", "sensor lag", "quantisation", "clipping", "clock offset and drift",
    "input gain", "thrust of a propeller", "actuator lag", "hidden capacity", "maturation delay",
    "cogging or gear ripple", "saturated elimination", "diode or exponential loss",
    "outflow through an opening", "thermal radiation",
    "reverse reaction or backflow", "adaptation", "waning immunity", "eddy-current brake",
    "inhibition", "attached oscillator", "rate limit", "magnetic saturation",
    "photoinhibition", "Gompertz growth", "second-order reaction", "asymmetric damping", "wind or current",
    "flow over a weir", "limiting resource", "Joule heating", "dependence on an input",
    "washout", "unbalance", "lever arm", "ground effect", "pull across a gap", "overpotential",
    "sigmoid feedback", "competition", "mutualism", "linear and quadratic drag", "Richards growth",
    "temperature dependence", "latent heat", "limited throughput", "gas spring", "fatigue or depletion",
    "pressure of a flow", "lag phase", "exchange with a flow",
)  # fmt: skip


@pytest.mark.parametrize("name", SCREENED)
def test_each_mechanism_is_among_those_that_are_fitted(name: str) -> None:
    """One form each; `tests/slow/test_every_mechanism.py` has whole diagnoses, of all forms of all."""
    resident = next(each for each in RESIDENTS if each.name == name)
    model, truth = HOMES[resident.home].model, truth_of(resident)
    data = recorded(resident)
    best: dict[str, float] = {}
    screened, _ = screen_all(data, recalibrate(model, data)[0], candidates(model))
    for each in screened:
        label = each.term.candidate.label
        best[label] = max(best.get(label, 0.0), each.gain)
    ranked = sorted(best, key=lambda label: -best[label])[: SearchOptions().fitted]
    assert truth.label in ranked and best[truth.label] > SearchOptions().same


# Formulas of the literature


def the(name: str, home: str, label: str = "") -> MechanismCandidate:
    """The candidate of a name in a home."""
    return next(each for each in candidates(HOMES[home].model) if each.name == name and label in each.label)


def test_mechanisms_add_up_in_any_order_also_those_that_bring_a_state() -> None:
    model, wall = HOMES["hut"].model, the("hidden capacity", "hut", "next to u")
    others = {each.name: each for each in candidates(model) if each.model.dimension == model.dimension}
    assert len(others) > 3
    for other in others.values():
        for one, more in ((wall, other), (other, wall)):
            both = more.rebased(model, one.model).model
            assert both.states == wall.model.states
            further = both.parameters[len(one.model.parameters) :]
            fresh = {symbol(a): symbol(p.name) for a, p in zip(more.new, further, strict=True)}
            for place, row in enumerate(model.equations):
                added = one.model.equations[place] + (more.model.equations[place] - row).xreplace(fresh)
                assert sympy.simplify(both.equations[place] - added) == 0, (one.label, more.label)


def test_a_speed_by_itself_is_known_by_its_unit() -> None:
    for unit in ("m/s", "rad/s", "mm/s", "km/h", "rpm", "1/s"):  # of a tachometer
        card = {"states": states(v=unit), "parameters": numbers(k=1.0), "equations": {"v": "k - v"}}
        roles = roles_of(model_of(card))
        assert (roles.speeds, roles.stores) == (("v",), ()), unit
    for unit in ("Hz", "K", "m/s**2", "mol/s"):
        card = {"states": states(v=unit), "parameters": numbers(k=1.0), "equations": {"v": "k - v"}}
        assert roles_of(model_of(card)).speeds == (), unit
    # A coasting cart stays at rest, as a population that is gone does; it is none.
    coasting = model_of({"states": states(v="m/s"), "parameters": numbers(k=1.0), "equations": {"v": "-k*v"}})
    assert roles_of(coasting).populations == () and {"quadratic drag", "dry friction"} <= names(coasting)


def test_drag_in_a_stream_goes_with_the_square_of_the_relative_speed() -> None:
    # Morison et al. (1950): F = C (u - v) |u - v|; it drives what is slower than the stream.
    change = dict(the("quadratic drag", "cart", "relative to u").changes)["v"]
    c, u, v = (next(each for each in change.free_symbols if each.name == name) for name in ("c_1", "u", "v"))
    assert change.subs({c: 2, u: 3, v: 1}) == 8 and change.subs({c: 2, u: 1, v: 3}) == -8


def test_a_fan_drives_a_stream_whose_drag_goes_with_the_relative_speed() -> None:
    change = dict(the("quadratic drag", "ball in a tube", "that u drives").changes)["v"]
    at = {"c_1": 2, "k_1": 3, "u": 2, "v": 1}
    assert change.subs({each: at[each.name] for each in change.free_symbols}) == 2 * (3 * 2 - 1) ** 2


def test_a_rotor_lifts_more_near_the_ground() -> None:
    # Cheeseman and Bennett (1955): T / T∞ = 1 / (1 - (R / 4z)²), of which this is the first term.
    rate = the("ground effect", "drone").model.equations[-1]
    radius, height = 0.5, 1.5
    at = {"u": 10.0, "h": height, "c_1": (radius / 4) ** 2, "v": 0.0, "m": 1.0, "g": 0.0, "c": 0.0}
    lift = rate.subs({each: at[each.name] for each in rate.free_symbols})
    assert float(lift) == pytest.approx(10.0 / (1 - (radius / (4 * height)) ** 2), rel=1e-4)


def test_a_plate_is_pulled_by_the_square_of_the_field_in_the_gap() -> None:
    # Nathanson et al. (1967): F = ε A V² / 2 (d - x)².
    rate = the("pull across a gap", "plate").model.equations[-1]
    gap, x, force = 2.5, 1.0, 0.08
    at = {"u": 2.0, "x": x, "v": 0.0, "k": 0.0, "d": 0.0, "e": force / 4, "c_1": 1 / gap}
    pulled = rate.subs({each: at[each.name] for each in rate.free_symbols})
    assert float(pulled) == pytest.approx(force * gap**2 / (gap - x) ** 2)


def test_a_cell_under_a_current_polarises_as_a_resistor_with_a_capacitor_does() -> None:
    # Plett (2015), chapter 2: the voltage falls by R I (1 - exp(-t / R C)).
    model = the("overpotential", "cell").model
    rate, (seen,) = model.equations[-1], dict(model.outputs).values()
    assert {each.name for each in rate.free_symbols} >= {"u", "tau_1"}
    at = {"a": 3.0, "b": 0.0, "q": 0.0, "R": 0.0, "u": 2.0, "c_1": 0.1, "tau_1": 5.0}
    (hidden,) = {each for each in seen.free_symbols if each.name not in at}
    known = {each: at[each.name] for each in (rate.free_symbols | seen.free_symbols) - {hidden}}
    assert float(rate.subs({**known, hidden: 0.5})) == pytest.approx((2.0 - 0.5) / 5.0)
    assert float(seen.subs({**known, hidden: 2.0})) == pytest.approx(3.0 - 0.1 * 2.0)


def test_what_an_enzyme_made_stays_with_it() -> None:
    # Cornish-Bowden (2012): v = V s / (K (1 + p / w) + s).
    rate = the("inhibition", "enzyme", "by p, competitive").model.equations[-1]
    at = {"V": 3.0, "K": 2.0, "s": 4.0, "p": 6.0, "w_1": 3.0}
    assert float(rate.subs({each: at[each.name] for each in rate.free_symbols})) == pytest.approx(
        3 * 4 / (2 * 3 + 4)
    )


def test_a_lake_recycles_from_a_threshold_on() -> None:
    # Carpenter, Ludwig and Brock (1999): r P^q / (m^q + P^q), half of it at the threshold.
    change = dict(the("sigmoid feedback", "lake").changes)["p"]
    at = {"c_1": 3.0, "w_1": 2.0, "n_1": 8.0}
    for level, expected in ((2.0, 1.5), (1.0, 3.0 / 257), (4.0, 3.0 * 256 / 257)):
        known = {each: {**at, "p": level}[each.name] for each in change.free_symbols}
        assert float(change.subs(known)) == pytest.approx(expected)


def test_too_much_of_what_is_eaten_slows_growth() -> None:
    # Andrews (1968): M S / (K + S + S² / W), here with M = m w / (w + k), K = k w / (w + k) and W = w + k.
    rate = the("inhibition", "chemostat", "of m by s in").model.equations[0]
    k, m, s, w = 1.0, 0.5, 3.0, 5.0
    at = {"u": 0.0, "f": 0.0, "m": m, "k": k, "y": 1.0, "n": 2.0, "s": s, "w_1": w}
    found = float(rate.subs({each: at[each.name] for each in rate.free_symbols}))
    assert found == pytest.approx(-2.0 * m * w / (w + k) * s / (k * w / (w + k) + s + s**2 / (w + k)))


def test_what_coasts_has_a_resistance_that_is_constant_and_one_that_grows_with_the_square() -> None:
    # White and Korst (1972): m dv/dt = -(A + C v²) ahead, and the other way around.
    change = dict(the("rolling resistance and drag", "mass").changes)["v"]
    c, d, v = (
        next(each for each in change.free_symbols if each.name == name) for name in ("c_1", "d_1", "v")
    )
    assert change.subs({c: 2, d: 3, v: 4}) == -(2 + 3 * 16) == -change.subs({c: 2, d: 3, v: -4})


def test_a_pendulum_meets_a_drag_with_its_speed_and_one_with_the_square() -> None:
    # Nelson and Olsson (1986): F = -(a |v| + b v²) sign(v).
    change = dict(the("linear and quadratic drag", "mass without damping").changes)["v"]
    for v in (4.0, -4.0):
        at = {"c_1": 0.1, "d_1": 3.0, "v": v}
        found = change.subs({each: at[each.name] for each in change.free_symbols})
        assert float(found) == pytest.approx(-(0.1 * 4.0 + 3.0 * 16.0) * np.sign(v))


def test_growth_ends_at_a_capacity_with_a_power() -> None:
    # Richards (1959), as Gilpin and Ayala (1973) write it: r N (1 - (N / K)^θ).
    rate = the("Richards growth", "crop").model.equations[0]
    at = {"r": 0.5, "c": 0.0, "n": 3.0, "w_1": 5.0, "n_1": 2.5}
    found = float(rate.subs({each: at[each.name] for each in rate.free_symbols}))
    assert found == pytest.approx(0.5 * 3.0 * (1 - (3.0 / 5.0) ** 2.5))


def test_a_protein_represses_its_gene() -> None:
    # Becskei and Serrano (2000): a / (1 + k R), with a power as Hill (1910) has it.
    rate = the("inhibition", "gene and protein", "of b by r").model.equations[0]
    at = {"b": 8.0, "u": 0.5, "d": 0.0, "s": 1.0, "r": 6.0, "w_1": 2.0}
    for power, left in ((1.0, 4.0), (2.0, 10.0)):
        known = {**at, "n_1": power}
        found = float(rate.subs({each: known[each.name] for each in rate.free_symbols}))
        assert found == pytest.approx(8.0 * 0.5 / left)


def test_what_a_gear_with_play_moves_follows_where_the_play_ends() -> None:
    # Nordin and Gutman (2002): within the gap 2a what is moved rests; beyond, it is u - a or u + a.
    model = the("backlash", "mass", "in what u moves").model
    acceleration, follows = model.equations[-2:]
    # A time that is fitted becomes shorter and shorter.
    assert [each.name for each in model.parameters if each.fixed] == ["m", "tau_1"]
    at = {"k": 0.0, "d": 0.0, "m": 1.0, "x": 0.0, "v": 0.0, "a_1": 0.5, "tau_1": 0.1, "z_1": 1.0}
    for u, moved in ((2.0, 1.5), (1.3, 1.0), (0.7, 1.0), (-1.0, -0.5)):
        known = {**at, "u": u}
        for formula, expected in ((acceleration, moved), (follows, (moved - 1.0) / 0.1)):
            found = formula.subs({each: known[each.name] for each in formula.free_symbols})
            assert float(found) == pytest.approx(expected)


def test_a_shock_absorber_resists_one_way_more_than_the_other() -> None:
    # Dixon (2007): F = -C_rebound v for v > 0, -C_bump v for v < 0.
    change = dict(the("asymmetric damping", "mass without damping").changes)["v"]
    c, d, v = (
        next(each for each in change.free_symbols if each.name == name) for name in ("c_1", "d_1", "v")
    )
    assert change.subs({c: 2, d: 3, v: 4}) == -8 and change.subs({c: 2, d: 3, v: -4}) == 12


def test_drag_in_wind_goes_with_the_relative_speed_and_a_linear_one_is_a_constant_force() -> None:
    # Fossen (2011), chapter 8: drag acts on ν - ν_c.
    change = dict(the("wind or current", "boat").changes)["v"]
    w, v, u, d = (
        next(each for each in change.free_symbols if each.name == name) for name in ("w_1", "v", "u", "d")
    )
    assert change.subs({w: 1, v: 3, u: 0, d: 2}) == -8 and change.subs({w: 1, v: 0, u: 0, d: 2}) == 2
    linear = names(oscillator("-k*x - d*v + u", k=4.0, d=0.5))
    assert "constant bias" in linear and "wind or current" not in linear


def test_the_flow_over_a_weir_goes_with_the_power_three_halves_of_the_height() -> None:
    # Poleni (1717): Q = 2/3 μ b sqrt(2 g) h^(3/2).
    change = dict(the("flow over a weir", "basins", "weir in h").changes)["h"]
    c, h = (next(each for each in change.free_symbols if each.name == name) for name in ("c_1", "h"))
    assert change.subs({c: 2, h: 4}) == -16 and change.subs({c: 2, h: -1}) == 0


def test_growth_on_a_limiting_resource_is_that_of_monod() -> None:
    # Monod (1949): μ = μ_max S / (K_s + S), and what is used up follows.
    model = the("limiting resource", "culture", "of m").model
    rates = dict(zip(model.states, model.equations, strict=True))
    at = {"n": 3, "s": 2, "w_1": 4, "m": 0.5, "y": 0.5}
    told = {name: rate.subs({s: at[s.name] for s in rate.free_symbols}) for name, rate in rates.items()}
    assert told == {"n": 0.5 * 2 / 6 * 3, "s": -0.5 * 2 / 6 * 3 / 0.5}


def test_a_current_heats_with_its_square() -> None:
    # Joule (1841): Q = R I² t.
    change = dict(the("Joule heating", "lamp").changes)["s"]
    c, u = (next(each for each in change.free_symbols if each.name == name) for name in ("c_1", "u"))
    assert change.subs({c: 2, u: 3}) == 18 == change.subs({c: 2, u: -3})


def test_an_unbalance_pulls_outwards_with_the_square_of_the_speed() -> None:
    # Den Hartog (1934): m r ω² once a turn.
    change = dict(the("unbalance", "rotor").changes)["v"]
    at = {"c_1": 0.5, "d_1": 2.0, "w": 3.0, "a": sympy.pi / 2}
    assert change.subs({each: at[each.name] for each in change.free_symbols}) == 18.0


def test_what_a_trolley_does_to_a_pendulum_goes_with_the_cosine() -> None:
    # Franklin, Powell and Emami-Naeini (1986): I θ'' + m g l sin θ = -m l x'' cos θ.
    (_, rate) = the("lever arm", "pendulum on a trolley").model.equations
    at = {"k": 0.0, "c": 0.0, "th": sympy.pi / 3, "w": 0.0, "a": 4.0, "c_1": 1.0}
    assert rate.subs({each: at[each.name] for each in rate.free_symbols}) == -2.0


def test_a_parameter_goes_with_an_input_in_proportion() -> None:
    # McAdams (1954): a film coefficient goes with the speed of the air, h = h0 (1 + c w).
    model = the("dependence on an input", "cart", "of d on u").model
    (rate,) = model.equations
    at = {"d": 2.0, "c_1": 0.5, "u": 3.0, "v": 1.0, "g": 0.0, "p": 1.0}
    assert rate.subs({each: at[each.name] for each in rate.free_symbols}) == -2.0 * (1 + 0.5 * 3.0)


def test_what_flows_through_carries_off_what_is_there() -> None:
    # Fogler (2016): V dC/dt = v (C_in - C) of a stirred tank; Novick and Szilard (1950): nothing flows in.
    for name, home in (("washout", "salt mixer"), ("exchange with a flow", "mixer")):
        change = dict(the(name, home, "has w").changes)["s"]
        c, u, w, s = (next(e for e in change.free_symbols if e.name == k) for k in ("c_1", "u", "w", "s"))
        assert change.subs({c: 2, u: 3, w: 5, s: 1}) == 24 and change.subs({c: 2, u: 3, w: 1, s: 1}) == 0
    change = dict(the("washout", "fermenter with a feed").changes)["n"]
    c, u, n = (next(e for e in change.free_symbols if e.name == name) for name in ("c_1", "u", "n"))
    assert change.subs({c: 2, u: 3, n: 4}) == -24


def test_behind_a_gear_with_play_nothing_moves_until_it_is_taken_up() -> None:
    # Nordin and Gutman (2002): the load follows a drive only beyond the gap.
    model = the("backlash", "mass", "of what is measured").model
    rate, (seen,) = model.equations[-1], dict(model.outputs).values()
    by_name = {each.name: each for each in rate.free_symbols | seen.free_symbols}
    a, z, v, x = (by_name[name] for name in ("a_1", "z_1", "v", "x"))
    assert seen == x - z
    assert rate.subs({a: 2, z: 2, v: 3}) == 0 == rate.subs({a: 2, z: -2, v: -3})  # taken along
    assert rate.subs({a: 2, z: 0, v: 3}) == 3 == -rate.subs({a: 2, z: 2, v: -3})  # in the gap


def test_friction_of_two_kinds_is_one_kind_where_the_card_has_the_other() -> None:
    # Armstrong-Hélouvry et al. (1994): F = -Fc sign(v) - Fv v.
    change = dict(the("Coulomb and viscous friction", "mass without damping").changes)["v"]
    c, d, v = (
        next(each for each in change.free_symbols if each.name == name) for name in ("c_1", "d_1", "v")
    )
    assert change.subs({c: 2, d: 3, v: 4}) == -(2 + 3 * 4) == -change.subs({c: 2, d: 3, v: -4})
    damped = names(oscillator("-k*x - d*v + u", k=4.0, d=0.5))
    assert "dry friction" in damped and "Coulomb and viscous friction" not in damped


def test_a_drive_gives_no_more_than_its_limit() -> None:
    model = the("saturation", "mass", "at a limit").model
    rate = dict(zip(model.states, model.equations, strict=True))["v"]
    a, u = (next(each for each in rate.free_symbols if each.name == name) for name in ("a_1", "u"))
    acts = [sympy.simplify(rate.subs({a: 2, u: drive}) - rate.subs({a: 2, u: 0})) for drive in (1, 2, 3, -5)]
    assert acts[1] == acts[2] == 2 * acts[0] == -acts[3]


def test_an_actuator_that_lags_has_the_transfer_function_of_first_order() -> None:
    # Åström and Murray (2008): 1 / (1 + s tau), of what reaches the mass.
    model = the("actuator lag", "mass").model
    rates = dict(zip(model.states, model.equations, strict=True))
    by_name = {each.name: each for each in rates["z_1"].free_symbols | rates["v"].free_symbols}
    assert "u" not in {each.name for each in rates["v"].free_symbols}
    assert sympy.simplify(rates["z_1"] - (by_name["u"] - by_name["z_1"]) / by_name["tau_1"]) == 0


def test_who_matures_in_three_stages_does_so_after_tau_with_a_variance_of_a_third_of_its_square() -> None:
    # MacDonald (1978): the Laplace transform of the ages is (1 + s tau/3)**-3.
    model = the("maturation delay", "crop", "in three stages").model
    rates = dict(zip(model.states, model.equations, strict=True))
    by_name = {each.name: each for formula in rates.values() for each in formula.free_symbols}
    stages = [by_name[name] for name in ("z1_1", "z2_1", "z3_1")]
    tau, n, r, c = (by_name[name] for name in ("tau_1", "n", "r", "c"))
    assert sympy.expand(rates["n"] - (stages[2] - c * n**2)) == 0  # nobody else waits, and losses do not
    s, b = sympy.symbols("s b")
    born = sympy.solve([s * z - rates[z.name].subs(r * n, b) for z in stages], stages)
    ages = sympy.simplify(born[stages[2]] / b)
    assert sympy.simplify(-ages.diff(s).subs(s, 0) - tau) == 0
    assert sympy.simplify(ages.diff(s, 2).subs(s, 0) - tau**2 - tau**2 / 3) == 0


def test_a_hidden_capacity_takes_up_what_it_gives_back() -> None:
    # Bacher and Madsen (2011), model TiTe: Ci dTi = (Te - Ti)/R dt, Ce dTe = (Ti - Te)/R dt; c = 1/(Ci R) and
    # tau = Ce R, so that c tau = Ce/Ci and Ti + c tau Te is kept.
    model = the("hidden capacity", "heat", "capacity in s").model
    before = HOMES["heat"].model.equations[0]
    rates = dict(zip(model.states, model.equations, strict=True))
    by_name = {each.name: each for formula in rates.values() for each in formula.free_symbols}
    kept = rates["s"] - before + by_name["c_1"] * by_name["tau_1"] * rates["z_1"]
    assert sympy.simplify(kept) == 0


def test_who_matures_after_one_time_is_born_that_long_before() -> None:
    # Voelker and Eliasmith (2018): the transfer function is the Padé approximant [3/4] of exp(-s tau).
    model = the("maturation delay", "crop", "of one length").model
    rates = dict(zip(model.states, model.equations, strict=True))
    by_name = {each.name: each for formula in rates.values() for each in formula.free_symbols}
    stages = [by_name[f"z{k}_1"] for k in range(1, 5)]
    tau, n, r, s, b = (*(by_name[name] for name in ("tau_1", "n", "r")), *sympy.symbols("s b"))
    born = sympy.solve([s * z - rates[z.name].subs({r * n: b, tau: 1}) for z in stages], stages)
    shown = sympy.cancel(sum(born[z] for z in stages) / b)
    top, bottom = (
        sum(
            sign**k
            * sympy.binomial(size, k)
            * sympy.Rational(sympy.factorial(7 - k), sympy.factorial(7))
            * s**k
            for k in range(size + 1)
        )
        for sign, size in ((-1, 3), (1, 4))
    )
    assert sympy.cancel(shown - top / bottom) == 0


def test_an_enzyme_removes_half_of_what_it_can_at_its_constant() -> None:
    # Michaelis and Menten (1913): V s / (K + s).
    change = dict(the("saturated elimination", "heat", "in s").changes)["s"]
    c, w, s = (
        next(each for each in change.free_symbols if each.name == name) for name in ("c_1", "w_1", "s")
    )
    assert change.subs({c: 3, w: 2, s: 2}) == sympy.Rational(-3, 2)


def test_a_junction_conducts_one_way() -> None:
    # Shockley (1949): I0 (exp(V/V0) - 1), whose conductance at rest is I0/V0.
    change = dict(the("diode or exponential loss", "circuit").changes)["s"]
    c, w, s = (
        next(each for each in change.free_symbols if each.name == name) for name in ("c_1", "w_1", "s")
    )
    assert change.diff(s).subs(s, 0) == -c
    assert sympy.simplify(change - -c * w * (sympy.exp(s / w) - 1)) == 0
    assert float(change.subs({c: 1, w: 0.1, s: -2})) == pytest.approx(0.1)


def test_a_basin_empties_in_a_time_that_goes_with_the_root_of_its_height() -> None:
    # Torricelli (1644): sqrt(h) falls evenly, so that it is empty after 2 sqrt(h0)/c.
    change = dict(the("outflow through an opening", "basins", "in h").changes)["h"]
    h, t, c = sympy.Symbol("h", real=True), *sympy.symbols("t c", positive=True)
    (new,) = (each for each in change.free_symbols if each.name == "c_1")
    falling = (2 - c * t / 2) ** 2
    left = (falling.diff(t) - change.subs({new: c, h: falling})).subs({c: 0.5})
    assert all(abs(float(left.subs(t, at))) < 1e-12 for at in (0.0, 3.0, 7.9))


def test_what_comes_back_is_not_lost() -> None:
    # Guldberg and Waage (1879): s and r become each other; the sum stays.
    model, before = the("reverse reaction or backflow", "two bodies").model, HOMES["two bodies"].model
    change = [sympy.expand(new - old) for new, old in zip(model.equations, before.equations, strict=True)]
    assert sum(change) == 0 and len(change[0].free_symbols) == 2


def test_adaptation_works_against_what_there_is() -> None:
    # Benda and Herz (2003): at rest a current -c s, at first only the part that was there before.
    model, before = the("adaptation", "heat", "in s").model, HOMES["heat"].model.equations[0]
    rates = dict(zip(model.states, model.equations, strict=True))
    by_name = {each.name: each for formula in rates.values() for each in formula.free_symbols}
    (rest,) = sympy.solve(rates["z_1"], by_name["z_1"])
    assert sympy.expand((rates["s"] - before).subs(by_name["z_1"], rest) + by_name["c_1"] * by_name["s"]) == 0


def test_those_who_recovered_are_the_rest_of_all() -> None:
    # Hethcote (2000): R = N - S - I.
    change = dict(the("waning immunity", "epidemic").changes)["s"]
    c, n, s, i = (next(e for e in change.free_symbols if e.name == k) for k in ("c_1", "N_1", "s", "i"))
    assert change.subs({c: 2, n: 1, s: sympy.Rational(1, 2), i: sympy.Rational(1, 4)}) == sympy.Rational(1, 2)
    with_rest = the("waning immunity", "epidemic with those who recovered", "in s, r").model
    before = HOMES["epidemic with those who recovered"].model
    assert sympy.expand(sum(with_rest.equations) - sum(before.equations)) == 0


def test_who_multiply_may_come_from_elsewhere_too() -> None:
    light = {"parameters": numbers(g=0.1, k=1.0, b=0.01), "inputs": {"P": {}}, "states": states(s="1")}
    amplified = {**light, "equations": {"s": "g*P*s - k*s + b"}}  # b: spontaneous emission
    assert roles_of(model_of(amplified)).populations == ("s",)
    for equation in ("P - k*s + b", "s - s**3 + P"):  # heated from outside; pushed either way
        assert roles_of(model_of({**light, "equations": {"s": equation}})).populations == ()
    of_either_sign = {**amplified, "states": {"s": {"unit": "1", "domain": [-1, 1]}}}
    assert roles_of(model_of(of_either_sign)).populations == ()


def test_what_only_decays_is_no_population_where_it_has_a_unit() -> None:
    card = {"parameters": numbers(k=1.0), "equations": {"a": "-k*a"}}
    assert roles_of(model_of({**card, "states": states(a="mol/L")})).stores == ("a",)
    assert roles_of(model_of({**card, "states": states(a="1")})).populations == ("a",)
    lost = {"equations": {"s": "-s*i", "i": "s*i - i"}, "states": states(s="1/km**2", i="1/km**2")}
    assert roles_of(model_of(lost)).contagion == (("s", "i"),)
    assert roles_of(HOMES["prey and predator"].model).contagion == ()  # prey are born
    # Susceptibles who come from elsewhere, or are born of all, as Kermack and McKendrick have it in 1932.
    vital = {"s": "mu - b*s*i - mu*s", "i": "b*s*i - (g + mu)*i"}
    card = {"states": states(s="1", i="1"), "parameters": numbers(mu=0.02, b=0.5, g=0.2), "equations": vital}
    assert roles_of(model_of(card)).contagion == (("s", "i"),)
    assert {"waning immunity", "seasonality"} <= names(model_of(card))


def test_the_gain_of_a_laser_saturates_and_its_losses_do_not() -> None:
    # Siegman (1986): g0 u / (1 + I/Is) times I.
    truth = the("saturation", "laser", "of the gain")
    by_name = {each.name: each for each in truth.model.equations[0].free_symbols}
    g, u, p, c, s, h = (by_name[name] for name in ("g", "u", "p", "c", "s", "h_1"))
    assert sympy.simplify(truth.model.equations[0] - (g * u * p / (1 + h * p) - c * p + s)) == 0


def test_the_activity_of_a_catalyst_dies_away() -> None:
    # Fogler (2016), chapter 10: da/dt = -r a, from one.
    truth = the("parameter drift", "mass", "as a decay in v (k)")
    by_name = {each.name: each for each in truth.model.equations[1].free_symbols}
    rate = sympy.simplify(truth.model.equations[1].diff(by_name["x"]) * by_name["m"] / -by_name["k"])
    assert sympy.simplify(rate.diff(by_name["t"]) + by_name["r_1"] * rate) == 0
    assert rate.subs(by_name["t"], 0) == 1


def test_a_body_radiates_with_the_fourth_power_of_its_absolute_temperature() -> None:
    # Boltzmann (1884). At 0 °C it is 273.15 K.
    in_kelvin = dict(the("thermal radiation", "furnace").changes)["s"]
    in_celsius = dict(the("thermal radiation", "kettle").changes)["s"]
    c, s = sympy.Symbol("c_1", real=True), sympy.Symbol("s", real=True)
    assert in_kelvin == -c * s**4
    assert float(in_celsius.subs({c: 1, s: 20})) == pytest.approx(float(in_kelvin.subs({c: 1, s: 293.15})))


def test_a_rate_grows_with_the_temperature_by_its_energy_of_activation() -> None:
    # Arrhenius (1889): 50 kJ/mol make a rate 1.924 times as fast at 35 °C as at 25 °C.
    at = the("temperature dependence", "heated reactor").model.equations[0]
    c, k, s, u = (next(e for e in at.free_symbols if e.name == name) for name in ("c_1", "k", "s", "u"))
    rate = -at.coeff(s).subs({k: 1, c: 50_000 / (8.314462618 * 273.15)})
    assert float(rate.subs(u, 35) / rate.subs(u, 25)) == pytest.approx(1.924, abs=5e-4)
    assert float(rate.subs(u, 0)) == 1.0
    # The same of a state, and in kelvin.
    for unit, zero in (("K", 273.15), ("°C", 0.0)):
        card = {"states": states(s=unit), "parameters": numbers(k=1.0), "equations": {"s": "1 - k*s"}}
        own = next(each for each in candidates(model_of(card)) if each.name == "temperature dependence")
        names = {each.name: each for each in own.model.equations[0].free_symbols}
        values = {names["k"]: 1.0, names["c_1"]: 20.0}
        faster = sympy.lambdify(names["s"], (1 - own.model.equations[0].subs(values)) / names["s"])
        assert faster(zero + 35) == pytest.approx(float(np.exp(20 * 35 / (35 + 273.15))))


def changed(name: str, home: str, state: str, label: str = "") -> tuple[sympy.Expr, dict[str, sympy.Symbol]]:
    """What a mechanism adds to the equation of a state, and the symbols in it by name."""
    change = dict(the(name, home, label).changes)[state]
    return change, {each.name: each for each in change.free_symbols}


def test_ice_takes_its_latent_heat_to_melt() -> None:
    # Bonacina et al. (1973): what is taken up between two temperatures is the integral of the heat capacity,
    # here 1 + 8 exp(-((T - 60)/5)²), with the latent heat 8 √π 5.
    change, names = changed("latent heat", "kettle", "s")
    values = {names["c_1"]: 8.0, names["m_1"]: 60.0, names["w_1"]: 5.0, names["u"]: 1.0}
    values |= {names["g"]: 1.0, names["h"]: 0.0}
    rate = sympy.lambdify(names["s"], (1 + change).subs(values))
    at = np.linspace(30.0, 90.0, 2001)
    taken = np.trapezoid([1 / rate(one) for one in at], at)
    assert taken == pytest.approx(60 + 8 * np.sqrt(np.pi) * 5, rel=1e-6)


def test_a_gas_pushes_back_by_its_pressure() -> None:
    # Poisson: p V^n stays, so that at half the height the pressure is 2^n times that at rest.
    change, names = changed("gas spring", "mass", "v")
    force = change.subs({names["c_1"]: 1, names["h_1"]: 2.0, names["n_1"]: 1.3})
    assert float(force.subs(names["x"], -1.0)) == pytest.approx(2**1.3 - 1)
    assert float(force.subs(names["x"], 0.0)) == 0.0


def test_no_more_is_served_than_can_be() -> None:
    # Daganzo (1994): the flow is the lesser of what waits over a time and a capacity.
    change, names = changed("limited throughput", "heat", "r", label="in r")
    waiting = [0.5, 2.0, 5.0]
    added = [float(change.subs({names["c_1"]: 0.2, names["L_1"]: 1.5, names["r"]: one})) for one in waiting]
    assert [0.2 * one - more for one, more in zip(waiting, added, strict=True)] == pytest.approx(
        [min(0.2 * one, 0.3) for one in waiting]
    )


def test_what_an_input_uses_up_comes_back_in_time() -> None:
    # Tsodyks and Markram (1997): of the resources R, u U R are used and (1 - R)/τ come back. In the long run
    # R = 1/(1 + u U τ).
    candidate = the("fatigue or depletion", "circuit")
    driven, own = candidate.model.equations
    names = {each.name: each for each in driven.free_symbols | own.free_symbols}
    z, c, u = names[candidate.model.states[-1]], names["c_1"], names["u"]
    at_rest = sympy.solve(own, z)[0]
    assert sympy.simplify((1 - c * at_rest) - 1 / (1 + c * u)) == 0  # with c = U τ
    values = {names["g"]: 1.0, names["s"]: 0.0, c: 0.5, u: 2.0}
    assert float(driven.subs(values).subs(z, 0.4)) == pytest.approx(2.0 * (1 - 0.5 * 0.4))


def test_wind_pushes_with_the_square_of_its_speed() -> None:
    change, names = changed("pressure of a flow", "wind turbine", "w")
    pushes = [float(change.subs({names["c_1"]: 0.5, names["u"]: one})) for one in (-2.0, 1.0, 2.0)]
    assert pushes == [-2.0, 0.5, 2.0]
    assert not [each for each in candidates(HOMES["wind turbine"].model) if "propeller" in each.name]


def test_friction_that_creeps_is_dry_friction_beyond_its_width() -> None:
    change = dict(the("dry friction", "mass", "creeps").changes)["v"]
    names = {each.name: each for each in change.free_symbols}
    values = {names["c_1"]: 2.0, names["w_1"]: 0.1}
    forces = [float(change.subs(values).subs(names["v"], one)) for one in (-1.0, 0.01, 1.0)]
    assert forces == pytest.approx([2.0, -0.2, -2.0], rel=5e-3)


def test_before_they_grow_bacteria_get_ready() -> None:
    # Baranyi and Roberts (1994): growth times q/(1 + q) with dq/dt = νq.
    change = dict(the("lag phase", "crop").changes)["n"]
    names = {each.name: each for each in change.free_symbols}
    n, t = names["n"], names["t"]
    growth = n - sympy.Rational(1, 5) * n**2
    values = {names["r"]: 1, names["c"]: sympy.Rational(1, 5), names["c_1"]: 1}
    share = sympy.simplify(1 + change.subs(values) / growth).subs({names["n_1"]: 0.9, names["l_1"]: 3.0})
    q = np.exp(0.9 * (np.array([0.5, 2.0, 3.0, 6.0]) - 3.0))
    np.testing.assert_allclose([float(share.subs(t, one)) for one in (0.5, 2.0, 3.0, 6.0)], q / (1 + q))


def test_water_evaporates_by_the_pressure_of_its_vapour() -> None:
    # Sonntag (1990), over water: 6.112 hPa at 0 °C, 23.4 hPa at 20 °C, 123.4 hPa at 50 °C. In air that is wet
    # already nothing evaporates.
    change = dict(the("cooling by evaporation", "pond").changes)["s"]
    c, d, s = (next(e for e in change.free_symbols if e.name == k) for k in ("c_1", "d_1", "s"))
    for celsius, pressure in ((0, 6.112), (20, 23.4), (50, 123.4)):
        assert float(-change.subs({c: 6.112, d: 0, s: celsius})) == pytest.approx(pressure, rel=5e-3)
    assert float(change.subs({c: 6.112, d: 23.4, s: 20})) == pytest.approx(0, abs=0.1)
    card = {"states": states(s="K"), "parameters": numbers(r=1.0), "equations": {"s": "-r*s"}}
    kelvin = next(each for each in candidates(model_of(card)) if each.name == "cooling by evaporation")
    hot = dict(kelvin.changes)["s"].subs(s, s + 273.15)
    assert sympy.lambdify((c, d, s), hot - change)(1.0, 0.5, 40.0) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("variant", "at", "forces"),
    [("from above", 2, [0, 0, -3]), ("from below", -2, [3, 0, 0]), ("on both sides", 2, [3, 0, -3])],
)
def test_a_stop_pushes_back_beyond_it_alone(variant: str, at: float, forces: list[float]) -> None:
    # Shaw and Holmes (1983): a second spring is touched at x = a.
    force = the("elastic stop", "mass", variant).model.equations[1] - HOMES["mass"].model.equations[1]
    x, c, a = (next(e for e in force.free_symbols if e.name == name) for name in ("x", "c_1", "a_1"))
    assert [force.subs({c: 3, a: at, x: where}) for where in (-3, 1, 3)] == forces


def test_a_wall_stands_between_a_room_and_the_outside() -> None:
    # Bacher and Madsen (2011): C T' = (T_i - T)/R_i + (T_a - T)/R_a; at rest as a voltage is divided.
    truth = the("hidden capacity", "hut", "next to u")
    (z,) = set(truth.model.symbols) - set(HOMES["hut"].model.symbols)
    rate = truth.model.equations[truth.model.symbols.index(z)]
    names = {each.name: each for each in rate.free_symbols}
    s, u, tau, eta = (names[one] for one in ("s", "u", "tau_1", "eta_1"))
    assert sympy.simplify(sympy.solve(rate, z)[0] - (eta * s + tau * u) / (eta + tau)) == 0


def test_what_is_held_relaxes_as_a_spring_in_line_with_a_damper_does() -> None:
    # Maxwell (1867): of a deflection a that is held, the force c a exp(-t/τ).
    truth = the("viscoelastic relaxation", "mass")
    by_name = {each.name: each for each in truth.model.equations[1].free_symbols}
    x, c = by_name["x"], by_name["c_1"]
    (z,) = set(truth.model.symbols) - set(HOMES["mass"].model.symbols)
    tau, t = sympy.Symbol("tau_1", real=True), sympy.Symbol("t", positive=True)
    force = truth.model.equations[1] - HOMES["mass"].model.equations[1]
    held = x * (1 - sympy.exp(-t / tau))  # solves z' = (x - z)/τ from zero
    rate = truth.model.equations[truth.model.symbols.index(z)].subs(z, held)
    assert sympy.simplify(rate - held.diff(t)) == 0
    assert sympy.simplify(force.subs(z, held) + c * x * sympy.exp(-t / tau)) == 0


def test_forms_ask_for_units() -> None:
    assert "diode or exponential loss" in names(HOMES["circuit"].model)
    assert not {"thermal radiation", "outflow through an opening"} & names(HOMES["circuit"].model)
    assert not {"diode or exponential loss", "outflow through an opening"} & names(HOMES["heat"].model)
    for unit, empty in (("°C", False), ("kg", True)):  # zero degrees are not empty
        card = {"states": states(s=unit), "parameters": numbers(r=1.0), "equations": {"s": "-r*s"}}
        labels = {each.label for each in candidates(model_of(card))}
        assert "hidden capacity in s" in labels and ("hidden capacity empty at first in s" in labels) is empty


def test_recruitment_makes_up_for_what_is_lost() -> None:
    # Hethcote (2000): births of mu N, deaths of mu S, so that S tends to N.
    change = dict(the("recruitment", "epidemic").changes)["s"]
    by_name = {each.name: each for each in change.free_symbols}
    assert sympy.solve(change, by_name["s"]) == [by_name["N_1"]]
    assert change.diff(by_name["s"]) == -by_name["c_1"]


def test_a_population_is_limited_by_what_it_was() -> None:
    # Hutchinson (1948): n' = r n - c n n(t - tau), n(t - tau) being the sum of the states.
    model = the("delayed self-limitation", "crop").model
    by_name = {each.name: each for each in model.equations[0].free_symbols}
    late = sum(by_name[f"z{k}_1"] for k in range(1, 5))
    expected = by_name["r"] * by_name["n"] - by_name["c"] * by_name["n"] * late
    assert sympy.simplify(model.equations[0] - expected) == 0


def test_a_magnet_brakes_most_at_its_own_speed() -> None:
    # Wouterse (1991): T = 2 T0/(v/w + w/v), largest at v = w, and viscous at low speed.
    change = dict(the("eddy-current brake", "mass", "in v").changes)["v"]
    c, w, v = (next(e for e in change.free_symbols if e.name == k) for k in ("c_1", "w_1", "v"))
    assert sympy.simplify(change + 2 * (c * w / 2) / (v / w + w / v)) == 0


def test_below_its_threshold_a_population_dies_out() -> None:
    # Lewis and Kareiva (1993): r n (1 - n/K)(n/A - 1).
    candidate, before = the("Allee effect", "crop", "threshold"), HOMES["crop"].model.equations[0]
    a, n = (next(e for e in candidate.model.equations[0].free_symbols if e.name == k) for k in ("a_1", "n"))
    assert sympy.simplify(candidate.model.equations[0] - before * (n / a - 1)) == 0


def test_a_product_stops_those_who_make_it() -> None:
    # Levenspiel (1980): growth ends at a concentration of the product; yields stay as they are.
    candidate, before = the("inhibition", "fermenter", "in proportion"), HOMES["fermenter"].model
    c, q = (next(e for e in candidate.model.equations[1].free_symbols if e.name == k) for k in ("c_1", "q"))
    for after, rate in zip(candidate.model.equations, before.equations, strict=True):
        assert sympy.simplify(after - rate * (1 - c * q)) == 0
    # In a chain of reactions without organisms it would be saturated elimination by another name.
    assert not {"inhibition"} & names(HOMES["two bodies"].model)


def test_an_absorber_stills_what_it_is_tuned_to() -> None:
    # Ormondroyd and Den Hartog (1928): without damping of its own a body stands still where it is driven at
    # the frequency of what is attached, and both push each other alike.
    candidate = the("attached oscillator", "mass", "in v")
    rates = dict(zip(candidate.model.states, candidate.model.equations, strict=True))
    by_name = {each.name: each for formula in rates.values() for each in formula.free_symbols}
    added = dict(candidate.changes)["v"]
    assert sympy.simplify(added + by_name["m_1"] * rates["z2_1"]) == 0
    held = rates["z2_1"].subs({by_name["x"]: 0, by_name["v"]: 0, by_name["d_1"]: 0})
    assert sympy.simplify(held + by_name["z1_1"] / by_name["tau_1"] ** 2) == 0


def test_a_receptor_is_half_bound_at_its_constant() -> None:
    # Hill (1910), two at a time: u²/(w² + u²), of which nothing is left in proportion where u is small.
    change = the("saturation", "inducible gene", "threshold").model.equations[0]
    u, w, b, s = (next(e for e in change.free_symbols if e.name == k) for k in ("u", "w_1", "b", "s"))
    response = change.subs({s: 0, b: 1}) / w
    assert response.subs(u, w) == sympy.Rational(1, 2) and sympy.limit(response.diff(u), u, 0) == 0


def test_what_is_as_hot_as_its_surroundings_radiates_nothing() -> None:
    # Boltzmann (1884): c (s⁴ - a⁴).
    change = dict(the("thermal radiation", "furnace", "to surroundings").changes)["s"]
    c, d, s = (next(e for e in change.free_symbols if e.name == k) for k in ("c_1", "d_1", "s"))
    assert change.subs({d: c * 300**4, s: 300}) == 0


def test_what_meets_its_like_is_half_gone_in_a_time_that_goes_with_its_amount() -> None:
    # Guldberg and Waage (1879): 1/s grows evenly. Where two kinds meet, as much is lost of each.
    home = HOMES["two substances"].model
    change = dict(the("second-order reaction", "two substances", "in s").changes)["s"]
    c, s = (next(e for e in change.free_symbols if e.name == k) for k in ("c_1", "s"))
    assert sympy.simplify(-change / s**2 - c) == 0
    both = the("second-order reaction", "two substances", "in s, r").model.equations
    one, other = (sympy.expand(after - before) for after, before in zip(both, home.equations, strict=True))
    assert one == other and one != 0
    # Heat does not meet its like.
    assert "second-order reaction" not in names(HOMES["heat"].model) | names(HOMES["furnace"].model)


def test_growth_ends_where_its_logarithm_does() -> None:
    # Laird (1964): V' = V (A - α log V), which ends at exp(A/α).
    change = dict(the("Gompertz growth", "crop of known growth").changes)["n"]
    c, n = (next(e for e in change.free_symbols if e.name == k) for k in ("c_1", "n"))
    assert float((change / n).subs({c: 0.5, n: np.exp(2.0)})) == pytest.approx(-1.0)


def test_light_is_best_at_its_own_strength() -> None:
    # Steele (1962): u exp(1 - u/w), largest at w.
    grown = the("photoinhibition", "algae").model.equations[0]
    h, u = (next(e for e in grown.free_symbols if e.name == k) for k in ("h_1", "u"))
    assert sympy.simplify(grown.diff(u).subs(u, 1 / h)) == 0


def test_more_light_than_is_good_for_what_saturates_does_harm() -> None:
    # Peeters and Eilers (1978): u/(a u² + b u + c), largest at √(c/a).
    grown = the("photoinhibition", "algae", "beyond a saturation").model.equations[0]
    k, u = (next(e for e in grown.free_symbols if e.name == name) for name in ("k_1", "u"))
    assert sympy.simplify(grown.diff(u).subs(u, 1 / sympy.sqrt(k))) == 0


def test_a_motor_goes_no_faster_than_it_can() -> None:
    home = HOMES["circuit"].model
    rate = the("rate limit", "circuit").model.equations[0]
    (r,) = (e for e in rate.free_symbols if e.name == "r_1")
    at = {e: 0.01 for e in home.equations[0].free_symbols if e.name == "s"}
    at |= {e: 0.4 for e in home.equations[0].free_symbols if e.name == "g"}
    for drive, slow in ((5.0, 0.25), (-5.0, -0.25), (0.1, None)):
        (u,) = (e for e in home.equations[0].free_symbols if e.name == "u")
        free = home.equations[0].subs({**at, u: drive})
        assert float(rate.subs({**at, u: drive, r: 0.25})) == pytest.approx(
            float(free) if slow is None else slow
        )
