"""Roles, the dictionary of mechanisms, and what they become in a system."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy

from siq.diagnosis.dictionary import _Dictionary, dictionary_of, roles_of, standard_dictionary, unit_of
from siq.diagnosis.mechanisms import candidates_of
from siq.errors import InputError
from siq.numerics.files import Document, read_document, validate
from siq.systems.cards import SystemCard, build_system, load_system
from siq.systems.dynamics import Dynamics

NAMES = (
    "linear stiffness", "geometric stiffness", "gas spring", "preload", "elastic stop", "backlash",
    "gravity", "added mass", "moment of inertia", "linear damping", "quadratic stiffness",
    "cubic stiffness", "quintic stiffness", "quadratic drag", "cubic damping",
    "amplitude-dependent damping", "dry friction", "Coulomb and viscous friction",
    "rolling resistance and drag", "linear and quadratic drag", "asymmetric friction", "asymmetric damping",
    "Stribeck friction", "eddy-current brake", "position-dependent damping", "constant bias",
    "wind or current", "linear coupling", "attached oscillator", "nonlinear coupling", "competition",
    "mutualism", "self-limitation", "Gompertz growth", "Richards growth", "lag phase", "mortality",
    "harvest", "Allee effect", "sigmoid feedback", "prey refuge", "sigmoid functional response",
    "predator interference", "inhibition", "limiting resource", "photoinhibition", "decay or leakage",
    "delayed response", "saturation", "rate limit", "magnetic saturation", "parametric drive",
    "parameter drift", "dependence on an input", "temperature dependence", "periodic forcing", "lever arm",
    "unbalance", "overflow", "flow over a weir", "leak", "input delay", "hysteresis",
    "viscoelastic relaxation", "saturated elimination", "limited throughput", "second-order reaction",
    "washout", "exchange with a flow", "diode or exponential loss", "latent heat", "cooling by evaporation",
    "outflow through an opening", "thermal radiation", "reverse reaction or backflow", "adaptation",
    "waning immunity", "recruitment", "seasonality", "process noise", "sensor gain or offset",
    "thermal drift", "sensor lag", "quantisation", "rectification", "clipping", "input gain",
    "Joule heating", "thrust of a propeller", "pressure of a flow", "ground effect", "pull across a gap",
    "overpotential", "actuator lag", "fatigue or depletion", "hidden capacity", "maturation delay",
    "delayed self-limitation", "cogging or gear ripple", "clock offset and drift",
)  # fmt: skip


def model_of(card: dict) -> Dynamics:
    document = Document("card.yaml", {"name": "system", **card}, {})
    return build_system(document, validate(document, SystemCard))


def states(*names: str, unit: str = "1") -> dict:
    return {name: {"unit": unit, "domain": [0.1, 1.0]} for name in names}


@pytest.fixture
def oscillator() -> Dynamics:
    return model_of(
        {
            "time_unit": "s",
            "states": {"q": {"unit": "m", "domain": [-1, 1]}, "w": {"unit": "m/s", "domain": [-1, 1]}},
            "inputs": {"force": {"unit": "N"}},
            "parameters": {"k": {"value": 2.0}, "m": {"value": 1.5, "fixed": True}, "c_1": {"value": 0.1}},
            "equations": {"q": "w", "w": "(-k*q - c_1*w + force)/m"},
            "outputs": {"q": "q"},
        }
    )


def test_every_mechanism_that_was_promised_is_there() -> None:
    assert [each.name for each in standard_dictionary()] == list(NAMES)


def test_a_position_and_its_velocity(oscillator: Dynamics) -> None:
    roles = roles_of(oscillator)
    assert roles.motions == (("q", "w"),)
    assert roles.states == ("w",)
    assert not roles.amplitudes and not roles.populations


def test_two_quadratures_in_a_rotating_frame() -> None:
    model = model_of(
        {
            "states": states("a", "b"),
            "equations": {
                "a": "0.3*b - 0.1*a + 2*b*(a**2 + b**2)",
                "b": "-0.3*a - 0.1*b - 2*a*(a**2 + b**2) - 0.7",
            },
        }
    )
    assert roles_of(model).amplitudes == (("a", "b"),)


@pytest.mark.parametrize(
    "equations", [{"a": "0.3*b - 0.1*a", "b": "-0.4*a - 0.1*b"}, {"a": "-0.1*a", "b": "-0.1*b"}]
)
def test_two_states_that_do_not_turn_alike_are_no_quadratures(equations: dict) -> None:
    assert roles_of(model_of({"states": states("a", "b"), "equations": equations})).amplitudes == ()


def test_populations_and_levels() -> None:
    prey = model_of({"states": states("n", "p"), "equations": {"n": "n - n*p", "p": "-p + 0.5*n*p"}})
    assert roles_of(prey).populations == ("n", "p")
    tanks = model_of(
        {
            "states": states("h", "g"),
            "inputs": {"u": {}},
            "equations": {"h": "-sqrt(Max(h, 0)) + u", "g": "sqrt(Max(h, 0)) - sqrt(Max(g, 0))"},
        }
    )
    assert roles_of(tanks).levels == ("h", "g")
    assert roles_of(tanks).cascades == (("h", "g"),)  # the upper flows into the lower, and not back
    apart = model_of(
        {"states": states("h", "g"), "equations": {"h": "-sqrt(Max(h, 0)) + 1", "g": "1 - sqrt(Max(g, 0))"}}
    )
    assert roles_of(apart).cascades == ()


def test_names_of_the_card_are_not_taken_twice(oscillator: Dynamics) -> None:
    found = candidates_of(oscillator, roles_of(oscillator), standard_dictionary())
    drag = next(each for each in found if each.name == "quadratic drag")
    assert drag.amplitudes == ("c_2",)  # c_1 is the card's
    assert dict(drag.changes)["w"] == sympy.sympify("-c_2*Abs(w)*w", locals=dict(drag.model.names))


def test_without_its_amplitude_a_mechanism_changes_nothing(oscillator: Dynamics) -> None:
    for candidate in candidates_of(oscillator, roles_of(oscillator), standard_dictionary()):
        if not candidate.amplitudes:
            continue
        zero = {candidate.model.names[name]: 0 for name in candidate.amplitudes}
        for before, after in zip(oscillator.equations, candidate.model.equations, strict=False):
            assert sympy.simplify(after.subs(zero) - before) == 0, candidate.label


def test_units_are_worked_out(oscillator: Dynamics) -> None:
    found = {
        each.label: each for each in candidates_of(oscillator, roles_of(oscillator), standard_dictionary())
    }
    units = {label: each.model.parameters[-1].unit for label, each in found.items()}
    assert units["quadratic drag in w"] == "1/m"
    assert units["cubic stiffness in w"] == "1/(m**2*s**2)"
    assert unit_of("a/T", {"a": "°C", "T": "s"}) == "°C/s"


def test_what_fills_the_roles_tells_candidates_apart() -> None:
    populations = model_of(
        {"states": states("n", "p"), "equations": {"n": "n - 0.5*n*p", "p": "-p + 0.2*n*p"}}
    )
    masses = model_of(
        {
            "states": states("x", "v", "y", "w"),
            "parameters": {"k": {"value": 1.0}, "m": {"value": 1.0, "fixed": True}},
            "equations": {"x": "v", "v": "(-k*x + y)/m", "y": "w", "w": "-y"},
        }
    )
    for model in (populations, masses):
        labels = [each.label for each in candidates_of(model, roles_of(model), standard_dictionary())]
        assert len(set(labels)) == len(labels)
    # What a card holds fixed may drift, too.
    assert {"parameter drift in v (k)", "parameter drift in v (m)"} <= set(labels)


def test_saturation_of_a_predator_acts_on_the_encounters() -> None:
    model = model_of({"states": states("n", "p"), "equations": {"n": "n - 0.5*n*p", "p": "-p + 0.2*n*p"}})
    found = candidates_of(model, roles_of(model), standard_dictionary())
    fed = next(each for each in found if each.name == "saturation" and "h_1*n" in str(each.changes))
    names = fed.model.names
    expected = names["n"] - sympy.Float("0.5") * names["n"] * names["p"] / (1 + names["h_1"] * names["n"])
    assert sympy.simplify(fed.model.equations[0] - expected) == 0


def test_an_augmented_card_is_a_card(oscillator: Dynamics, tmp_path) -> None:
    generator = np.random.default_rng(1)
    for candidate in candidates_of(oscillator, roles_of(oscillator), standard_dictionary()):
        values = generator.uniform(0.5, 1.5, size=len(candidate.model.parameters))
        augmented = candidate.model.with_values(values)
        path = tmp_path / "card.yaml"
        path.write_text(augmented.to_card(), encoding="utf-8")
        again = load_system(path)
        assert again.states == augmented.states
        np.testing.assert_array_equal(again.values, augmented.values)
        np.testing.assert_array_equal(again.limits, augmented.limits)  # [-1, 1] is a domain like any other
        np.testing.assert_array_equal(again.diffusion.matrix, augmented.diffusion.matrix)
        for ours, theirs in zip(augmented.equations, again.equations, strict=True):
            assert sympy.simplify(ours - theirs) == 0, candidate.label


def test_entries_of_a_study_are_added_and_left_out() -> None:
    names = [each.name for each in dictionary_of(without=["hysteresis"], further=(), file="study.yaml")]
    assert "hysteresis" not in names and len(names) == len(NAMES) - 1
    with pytest.raises(InputError, match=r"study\.yaml, without: no mechanism is called 'histeresis'"):
        dictionary_of(without=["histeresis"], further=(), file="study.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mechanisms: [{name: a, sentence: b, forms: [{roles: {v: velocity}, coordinate: v,"
         " parameters: {}}]}]",
         "changes nothing"),
        ("mechanisms: [{name: a, sentence: b, forms: [{roles: {v: speed}, terms: {v: '1'}, coordinate: v,"
         " parameters: {}}]}]", "speed"),
        ("mechanisms: [{name: a, sentence: b, forms: [{roles: {v: velocity}, terms: {v: '1'}, coordinate: v,"
         " variant: 'against w in {u}', parameters: {}}]}]", "the variant names 'u', which has no role"),
        ("mechanisms: [{name: a, sentense: b, forms: []}]", "perhaps you meant 'sentence'"),
    ],
)  # fmt: skip
def test_entries_that_cannot_be_used_are_refused(text: str, message: str, tmp_path) -> None:
    path = tmp_path / "mechanisms.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        validate(read_document(path), _Dictionary)


def test_a_formula_outside_the_whitelist_is_refused(oscillator: Dynamics, tmp_path) -> None:
    path = tmp_path / "mechanisms.yaml"
    path.write_text(
        "mechanisms: [{name: evil, sentence: s, forms: [{roles: {v: velocity}, terms: {v: '__import__(1)'},"
        " coordinate: v, parameters: {c: {}}}]}]",
        encoding="utf-8",
    )
    with pytest.raises(InputError, match="evil"):
        candidates_of(
            oscillator,
            roles_of(oscillator),
            validate(read_document(path), _Dictionary).mechanisms,
        )


@pytest.mark.parametrize("inertia, offered", [({}, False), ({"fixed": True}, True)])
def test_another_unit_of_a_state_is_no_fault_of_its_sensor(inertia: dict, *, offered: bool) -> None:
    card = {
        "time_unit": "s",
        "states": {"q": {"unit": "rad"}, "w": {"unit": "rad/s"}},
        "inputs": {"u": {"unit": "N*m", "interpolation": "linear"}},
        "parameters": {"J": {"value": 0.03, **inertia}, "b": {"value": 0.08}},
        "equations": {"q": "w", "w": "(u - b*w)/J"},
        "outputs": {"y": "q"},
    }
    model = model_of(card)
    labels = {each.label for each in candidates_of(model, roles_of(model), standard_dictionary())}
    assert ("sensor gain or offset in y, by g_1" in labels) is offered
    assert {"dry friction in w", "clipping on both sides in y"} <= labels


def test_what_vanishes_with_its_shapes_is_a_special_case_and_what_leaves_them_is_not(
    oscillator: Dynamics,
) -> None:
    """Of friction that falls with the speed: what stays at high speed may be zero, and what falls may not."""
    found = candidates_of(oscillator, roles_of(oscillator), standard_dictionary())
    one = next(each for each in found if each.name == "Stribeck friction")
    staying, falling = one.amplitudes
    for zero, idle in ((staying, False), (falling, True)):
        values = dict.fromkeys(one.new, 1.0) | {zero: 0.01}
        fit: Any = SimpleNamespace(
            model=one.model.with_values([values.get(p.name, p.value) for p in one.model.parameters]),
            error_of=dict.fromkeys(one.new, 0.1),
        )
        assert one.idle(fit) is idle and not one.idle(fit, all)
