from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sympy

from siq.errors import InputError
from siq.systems import formulas
from siq.systems.cards import diffusion_rows, load_exact, load_system
from siq.systems.diffusion import Diffusion
from siq.systems.dynamics import Dynamics

Write = Callable[..., Path]
CARDS = sorted((Path(__file__).parents[2] / "config" / "systems").glob("*.yaml"))

CARD = """\
name: spiral
states:
  p: {unit: m, domain: [-1, 2]}
  q: {unit: m/s, domain: [0, 3]}
parameters:
  zeta: {value: 4.5e-4}
  omega: {value: 3}
equations:
  p: "q"
  q: "-omega**2*p - zeta*q + tanh(p*q)/(1 + p**2)"
"""


def refusal(path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        load_system(path)
    return caught.value


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.stem)
def test_every_card_of_the_project_loads(path: Path) -> None:
    system = load_system(path)
    assert system.name == path.stem
    if system.autonomous:
        assert np.isfinite(system.drift_of_components(system.box.mean(axis=1))).all()
    else:
        with pytest.raises(ValueError, match="no function of x alone"):
            system.drift(system.box.mean(axis=1)[None])


def test_a_card_becomes_the_system_that_it_describes(write: Write) -> None:
    system = load_system(write(CARD))
    assert system.states == ("p", "q")
    assert system.units == ("m", "m/s")
    np.testing.assert_array_equal(system.domain, [[-1, 2], [0, 3]])
    np.testing.assert_array_equal(system.diffusion.matrix, np.eye(2))
    p, q = 0.3, -0.8
    np.testing.assert_allclose(
        system.drift_of_components(np.array([p, q])),
        [q, -9 * p - 4.5e-4 * q + np.tanh(p * q) / (1 + p**2)],
        rtol=1e-15,
    )


def test_parameters_keep_all_their_digits(write: Write) -> None:
    system = load_system(
        write(CARD.replace("value: 3}", f"value: {1 / 3!r}}}").replace("omega**2*p", "omega*p"))
    )
    assert system.drift_of_components(np.array([1.0, 0.0]))[1] == -1 / 3


def test_parameters_stay_symbols_and_their_values_stand_in_the_formulas(write: Write) -> None:
    system = load_system(write(CARD))
    assert [each.name for each in system.parameters] == ["zeta", "omega"]
    p, omega = sympy.symbols("p omega", real=True)
    assert system.equations[1].coeff(p) == -(omega**2)
    assert system.formulas[1].coeff(p) == -9
    assert system.with_values(np.array([0.0, 2.0])).formulas[1].coeff(p) == -4


@pytest.mark.parametrize("formula", ["p/(omega - 3)", "p**(11*omega)", "sqrt(-omega)*p"])
def test_a_formula_that_is_none_with_the_parameters_values_is_refused(write: Write, formula: str) -> None:
    error = refusal(write(CARD.replace('p: "q"', f'p: "{formula}"')))
    assert error.place == "line 9 (equations.p)"


def test_gravity_is_known_unless_a_card_says_how_well(write: Write) -> None:
    text = (
        "name: fall\nstates: {x: {unit: m}, v: {unit: m/s}}\nequations: {x: v, v: -g + a}\n"
        "parameters: {g: {value: 9.81, unit: 'm/s^2'}, a: {value: 9.81, unit: m/s, error: 0.2}}"
    )
    system = load_system(write(text))
    assert [each.error for each in system.parameters] == [0.03, 0.2]
    assert [each.error for each in load_system(write(system.to_card())).parameters] == [0.03, 0.2]
    for value, unit, error in ((9.81, "m/s**2", 0.03), (9.81, "cm/s^2", None), (3.71, "m/s^2", None)):
        other = text.replace("9.81, unit: 'm/s^2'", f"{value}, unit: '{unit}'")
        assert load_system(write(other)).parameters[0].error == error
    with pytest.raises(InputError, match="error"):
        load_system(write(text.replace("error: 0.2", "error: -1")))


def test_a_whole_parameter_may_be_an_exponent(write: Write) -> None:
    system = load_system(write(CARD.replace('p: "q"', 'p: "q**omega"')))
    assert system.formulas[0].is_polynomial(*system.symbols)


def test_the_archetype_has_the_equations_of_the_paper(archetype: Dynamics) -> None:
    x, y, z = np.random.default_rng(1).uniform(-2, 2, size=(3, 40))
    cubic = 2 * (x**3 - x)
    np.testing.assert_allclose(
        archetype.drift_of_components(np.array([x, y, z])),
        [-cubic - y - z, -y + cubic, -z + cubic],
        rtol=1e-13, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_array_equal(archetype.domain, [[-2, 2], [-1.5, 1.5], [-1.5, 1.5]])
    np.testing.assert_array_equal(archetype.diffusion.matrix, np.eye(3))


def test_the_exact_quasipotential_of_the_archetype_solves_hamilton_jacobi(archetype: Dynamics) -> None:
    potential = load_exact(CARDS[0].parent / "archetype3d.yaml") / 2
    gradient = [potential.diff(symbol) for symbol in archetype.symbols]
    residual = sum(v * (f + v) for v, f in zip(gradient, archetype.formulas, strict=True))
    assert sympy.expand(residual) == 0


def test_the_jacobian_equals_finite_differences(write: Write) -> None:
    system = load_system(write(CARD))
    points = np.random.default_rng(2).uniform(-1, 1, size=(2, 7))
    jacobian = system.jacobian(points.T)
    assert jacobian.shape == (7, 2, 2)
    for j in range(2):
        step = 1e-6 * np.eye(2)[j][:, None]
        difference = (
            system.drift_of_components(points + step) - system.drift_of_components(points - step)
        ) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, j], difference.T, atol=1e-8)


@pytest.mark.parametrize("function", ["Abs(p)*p", "Max(p, 0)", "Min(p, q)", "Abs(p)", "sign(p)"])
def test_the_jacobian_of_a_mechanism_with_a_corner_is_that_of_its_smooth_parts(
    write: Write, function: str
) -> None:
    system = load_system(write(CARD.replace('p: "q"', f'p: "{function}"')))
    points = np.array([[0.4, -0.7, 0.2], [0.9, 0.3, -0.5]])
    step = np.array([[1e-6], [0.0]])
    difference = (
        system.drift_of_components(points + step) - system.drift_of_components(points - step)
    ) / 2e-6
    np.testing.assert_allclose(system.jacobian(points.T)[:, :, 0], difference.T, atol=1e-7)


def test_an_unknown_parameter_names_card_line_and_name(write: Write) -> None:
    error = refusal(write(CARD.replace("zeta*q", "zetta*q"), "spiral.yaml"))
    assert error.file.endswith("spiral.yaml")
    assert error.place == "line 10 (equations.q)"
    assert "'zetta'" in error.fault
    assert error.remedy == "perhaps you meant 'zeta'"


@pytest.mark.parametrize(
    ("old", "new", "place", "fault", "remedy"),
    [
        ("equations:", "equation:", "line 8 (equation)", "'equation' is unknown", "you meant 'equations'"),
        ("unit: m,", "unti: m,", "line 3 (states.p.unti)", "'unti' is unknown", "you meant 'unit'"),
        ("value: 3", "valeu: 3", "line 7 (parameters.omega.valeu)", "'valeu' is", "you meant 'value'"),
        ("[-1, 2]", "[2, -1]", "line 3 (states.p.domain)", "the domain is empty", "lower < upper"),
        ("[-1, 2]", "[.nan, 2]", "line 3 (states.p.domain.0)", "nan", "finite"),
        ('  p: "q"\n', "", "", "'p' has no equation", "add"),
        ("zeta: {", "q: {", "", "both a state and a parameter", "rename"),
        ('  p: "q"', '  p: "q"\n  r: "q"', "", "belongs to no state", "declare"),
        ("name: spiral", "name: ../evil", "line 1 (name)", "'../evil'", ""),
    ],
)  # fmt: skip
def test_a_faulty_card_is_refused_with_its_line(
    write: Write, old: str, new: str, place: str, fault: str, remedy: str
) -> None:
    text = CARD.replace(old, new)
    assert text != CARD
    error = refusal(write(text))
    assert fault in error.fault
    assert remedy in error.remedy
    assert error.place.startswith(place)


@pytest.mark.parametrize("name", ["lambda", "class", "None", "sin", "pi", "t", "recording", "2x", "x-y"])
def test_a_name_that_no_formula_could_use_is_refused(write: Write, name: str) -> None:
    error = refusal(write(CARD.replace("zeta", name)))
    assert f"'{name}'" in str(error)
    assert error.place.startswith("line 6")


@pytest.mark.parametrize(
    ("diffusion", "expected"),
    [
        ("identity", np.eye(2)),
        ([1.0, 4.0], np.diag([1.0, 4.0])),
        ([[2.0, 0.5], [0.5, 1.0]], np.array([[2.0, 0.5], [0.5, 1.0]])),
    ],
)
def test_diffusion_is_the_identity_a_diagonal_or_a_matrix(diffusion: object, expected: np.ndarray) -> None:
    np.testing.assert_array_equal(diffusion_rows(diffusion, 2), expected)


@pytest.mark.parametrize(
    "diffusion",
    ["[1]", "[1, 2, 3]", "[[1, 2], [3, 4]]", "[[1, 0]]", "[[1, 0], [0]]", "[1, -1]",
     "[[1, 2], [2, 1]]", "[1, .nan]", "[1, .inf]", "[]", "unity", "[[1, 0, 0], [0, 1, 0]]"],
)  # fmt: skip
def test_a_diffusion_that_is_no_covariance_is_refused(write: Write, diffusion: str) -> None:
    assert "diffusion" in str(refusal(write(f"{CARD}diffusion: {diffusion}\n")))


def test_domain_and_noise_of_a_state_may_be_left_out(write: Write) -> None:
    system = load_system(
        write(CARD.replace("{unit: m, domain: [-1, 2]}", "{unit: m}") + "diffusion: [0, 2]\n")
    )
    np.testing.assert_array_equal(system.limits, [[np.nan, np.nan], [0, 3]])
    with pytest.raises(ValueError, match="no domain of p is known"):
        _ = system.box
    assert not system.diffusion.regular


def test_a_dynamics_without_a_card_becomes_one(write: Write) -> None:
    p, q = sympy.symbols("p q", real=True)
    ours = Dynamics.of((p, q), (q, -sympy.sin(p)), diffusion=np.array([[0, 0], [0, 0.25]]))
    again = load_system(write(ours.to_card()))
    assert again.equations == ours.equations and again.units == ours.units
    assert np.isnan(again.limits).all()
    np.testing.assert_array_equal(again.diffusion.matrix, ours.diffusion.matrix)
    whole = ours.with_diffusion(Diffusion(np.array([[2.0, 0.5], [0.5, 1.0]])))
    np.testing.assert_array_equal(
        load_system(write(whole.to_card())).diffusion.matrix, whole.diffusion.matrix
    )


def test_a_hostile_card_is_refused_without_being_run(write: Write, tmp_path: Path) -> None:
    trap = tmp_path / "trap"
    formula = f"__import__('os').system('touch {trap}')"
    error = refusal(write(CARD.replace('p: "q"', f'p: "{formula}"')))
    assert error.place == "line 9 (equations.p)"
    assert not trap.exists()


@pytest.mark.parametrize(
    ("entry", "fault"),
    [
        (("domain: [-1, 2]", "domain: [-1, 1e300]"), "the domain is too wide or too narrow"),
        (("domain: [-1, 2]", "domain: [0, 1e-300]"), "the domain is too wide or too narrow"),
        (("parameters:", "diffusion: [1e300, 1]\nparameters:"), "the diffusion is too large or too small"),
        (("zeta:", "z" * 101 + ":"), "has 101 letters"),
    ],
)
def test_numbers_and_names_without_measure_are_refused(
    write: Write, entry: tuple[str, str], fault: str
) -> None:
    assert fault in refusal(write(CARD.replace(*entry, 1))).fault


def test_names_match_however_their_letters_are_written(write: Write) -> None:
    micro, full = "µ", "ｐ"  # the sign of micro, and a letter of full width, which formulas read as others
    system = load_system(write(CARD.replace("zeta", micro).replace("  p:", f"  {full}:")))
    assert system.states == ("p", "q") and system.parameters[0].name == "μ"


def test_a_state_may_be_called_as_a_function_of_the_generated_code(write: Write) -> None:
    name = "integer_power"
    system = load_system(write(f"name: a\nstates: {{{name}: {{}}}}\nequations: {{{name}: -{name}**3}}\n"))
    np.testing.assert_allclose(system.drift(np.array([[2.0]])), [[-8.0]])
    np.testing.assert_allclose(system.jacobian(np.array([[2.0]])), [[[-12.0]]])


def test_formulas_that_take_for_ever_are_refused(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formulas, "LONGEST_WORK", 0.02)
    nested = "p"
    for _ in range(8):
        nested = f"Max(sin({nested}), exp(-({nested})), p)"
    error = refusal(write(CARD.replace('"q"', f'"{nested}"')))
    assert error.place == "line 9 (equations.p)"
    assert error.fault == "the formula could not be worked out within 0.02 s"
