"""Sentences and tables of a diagnosis never contradict each other, whatever the numbers are."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from siq.diagnosis.holdout import HeldOutErrors
from siq.diagnosis.mechanisms import PROCESS_NOISE
from siq.diagnosis.statement import (
    Alternative,
    DescribedCurve,
    Description,
    Estimate,
    Evidence,
    Location,
    Recalibrated,
    StatedTerm,
    Statement,
)
from siq.diagnosis.study import MismatchVerdict
from siq.diagnosis.verdict import statement_of_failure
from siq.numerics.text import p_text, percent
from siq.remarks import Remark
from siq.report import diagnosis_page
from siq.report.diagnosis_page import sentences_of

NAMES = ("dry friction", "Stribeck friction", "hysteresis", "quadratic drag", "cubic damping", "input delay")
SAME = 10.0
CASES = range(300)


def mechanism_of(draw: np.random.Generator, number: int) -> StatedTerm:
    """A mechanism with rivals whose gains are drawn, and classed by them as the search does."""
    gain = float(draw.uniform(20, 5000))
    rivals = []
    for name in draw.permutation(NAMES)[: draw.integers(0, 5)]:
        further, other = int(draw.integers(-1, 3)), gain + float(draw.normal(0, 15))
        if other <= gain - SAME:
            standing = "less"
        else:
            standing = "needless" if further > 0 and other - gain < 2 * further else "same"
        rivals.append(Alternative(str(name), f"{name} in w{number}", other, further, standing))
    parameters = {
        f"c_{k}": Estimate(float(draw.normal()), float(draw.uniform(1e-3, 1)), "m/s**2")
        for k in range(draw.integers(0, 3))
    }
    name = str(draw.choice(NAMES))
    return StatedTerm(
        name=name, label=f"{name} in v", terms={"v": "-c_1*sign(v)"}, parameters=parameters,
        evidence=Evidence(gain, 7 - gain, 0.0, 0.0),
        share_of_excess=float(draw.choice([0.0, 0.4, 0.9994, 0.99997, 1.0])),
        equations=("v",), rivals=tuple(rivals),
    )  # fmt: skip


def errors_of(draw: np.random.Generator) -> HeldOutErrors:
    floor = float(10 ** draw.uniform(-4, 0))

    def error() -> float | None:
        choices = (None, floor, floor * 1.02, floor * float(10 ** draw.uniform(0, 2)))
        return choices[draw.integers(0, 4)]

    before, recalibrated = error(), error()
    augmented = recalibrated if draw.random() < 0.3 else error()
    values = int(10 ** draw.uniform(1, 4))
    runs = {"before": before, "recalibrated": recalibrated, "augmented": augmented}
    return errors_with(runs, floor, draw.chisquare(1, values))


def errors_with(
    runs: dict[str, float | None], floor: float, shape: np.ndarray | float = 1.0
) -> HeldOutErrors:
    """Errors of given sizes, whose squares vary alike from value to value."""
    alike = np.full(1000, 1.0) * shape if np.ndim(shape) == 0 else np.asarray(shape)
    squares = {
        name: None if error is None else error**2 * alike / alike.mean() for name, error in runs.items()
    }
    return HeldOutErrors.of(squares, noise_floor=floor)


def statement_from(number: int, verdict: MismatchVerdict, **changes: Any) -> Statement:
    draw = np.random.default_rng(number)
    mechanisms = tuple(mechanism_of(draw, k) for k in range(draw.integers(1, 3)))
    missing = verdict is MismatchVerdict.MISSING_PHYSICS
    by = mechanisms if draw.random() < 0.8 else ()
    description = Description(
        float(mechanisms[0].share_of_excess if by else 0.0), by, float(10 ** -draw.uniform(0, 20)),
        bool(draw.integers(2)), too_faint=bool(by) and bool(draw.integers(2)),
    )  # fmt: skip
    recalibration = {
        name: Recalibrated(
            1.0, 1.0 + float(draw.normal()), float(10 ** draw.uniform(-3, 1)), "N/m" if name == "k" else "1"
        )
        for name in ("k", "d", "m", "tau", "a")[: draw.integers(1, 6)]
    }
    given = {
        "mechanisms": mechanisms if missing else (),
        "description": description if verdict is MismatchVerdict.UNEXPLAINED else None,
        "recalibration": recalibration,
        "errors": errors_of(draw),
    }
    return Statement(verdict, **{**given, **changes})


def said(statement: Statement) -> str:
    words = sentences_of(statement)["words"]
    return " ".join([statement.sentence, *(line for lines in words.values() for line in lines)])


def percentages(text: str) -> list[float]:
    """All numbers in per cent, as a reader takes them."""
    superscripts = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
    found = re.findall(r"([\d.]+)(?: × 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))? %", text)
    return [float(number) * 10.0 ** int(power.translate(superscripts) or 0) for number, power in found]


def mechanisms_in(statement: Statement) -> tuple[StatedTerm, ...]:
    return statement.mechanisms if statement.description is None else statement.description.by


@pytest.mark.parametrize("verdict", [MismatchVerdict.MISSING_PHYSICS, MismatchVerdict.UNEXPLAINED])
def test_no_other_is_said_only_where_none_is_as_good(verdict):
    denied = 0
    for number in CASES:
        statement = statement_from(number, verdict)
        lines = sentences_of(statement)["words"]["alternatives"]
        for each in mechanisms_in(statement):
            alone = any(f"as well as {own}:" in line for line in lines for own in (each.name, each.label))
            others = [m for m in mechanisms_in(statement) if m is not each and m.name == each.name]
            if alone and not others:
                denied += 1
                assert each.rivals
                assert all(rival.delta_chi2 <= each.evidence.delta_chi2 - SAME for rival in each.rivals)
            for rival in each.rivals:
                if rival.standing != "less":
                    name = rival.label if rival.name == each.name else rival.name
                    assert any(name.lower() in line.lower() for line in lines), (number, name, lines)
    assert denied > 5


def test_a_class_of_equals_is_part_of_the_first_sentence():
    for number in CASES:
        statement = statement_from(number, MismatchVerdict.MISSING_PHYSICS)
        text = statement.sentence
        open_ended = [m for m in statement.mechanisms if any(r.standing == "same" for r in m.rivals)]
        assert text.count("the recordings as well") == len(open_ended)


@pytest.mark.parametrize("verdict", list(MismatchVerdict))
def test_a_gain_is_said_only_where_the_held_out_error_falls(verdict):
    for number in CASES:
        statement = statement_from(number, verdict)
        text, errors = statement.sentence, statement.errors
        assert "nan" not in text and "None" not in text and "unknown" not in text
        pair = {
            MismatchVerdict.MISSING_PHYSICS: ("without", "augmented"),
            MismatchVerdict.PARAMETER_SHIFT: ("before", "recalibrated"),
        }.get(verdict)
        falls = "falls from" in text
        if pair is None or None in [errors.error(name) for name in pair]:
            assert not falls
            continue
        first, second = pair
        by_chance = "no more than it may by chance" in text
        assert falls == (errors.change(first, second) == "better" or by_chance)
        assert not by_chance or errors.change(first, second) == "same"
        if falls and not by_chance:
            *before, after, _noise = percentages(text.split("falls from")[1])
            assert after < min(before)
        elif errors.at_noise(first) and errors.change(first, second) != "worse":
            assert "too noisy to show it" in text
        else:
            assert "does not improve" in text or "worse" in text


def test_missing_physics_without_a_gain_cannot_be_read_as_one():
    same = errors_with({"before": 0.103, "recalibrated": 0.103, "augmented": 0.103}, 0.020)
    text = statement_from(3, MismatchVerdict.MISSING_PHYSICS, errors=same).sentence
    assert "does not improve the prediction of recordings held out" in text
    assert text.count("10.3 %") == 2


def test_what_lands_elsewhere_from_some_time_on_is_told_by_its_typical_error():
    errors = errors_with({"before": 0.103, "recalibrated": 0.103, "augmented": 0.110}, 0.001)
    blocks = {
        "before": (0.0106,) * 12,
        "recalibrated": (0.0106,) * 12,
        "augmented": (1e-6,) * 6 + (0.024,) * 6,
    }
    text = statement_from(3, MismatchVerdict.MISSING_PHYSICS, errors=replace(errors, squares=blocks)).sentence
    assert "the typical error on recordings that it did not see falls from 10.3 %" in text
    assert "In the mean it is 10.3 %" in text and "11.0 %" in text and "does not improve" not in text


def test_a_typical_gain_is_that_of_the_two_which_are_compared():
    errors = errors_with({"before": 0.2, "recalibrated": 0.2, "augmented": 0.103, "named": 0.103}, 0.001)
    assert errors.falls_typically("without", "augmented") and not errors.falls_typically("named", "augmented")


def test_a_parameter_shift_names_its_parameters_with_both_values():
    for number in CASES:
        statement = statement_from(number, MismatchVerdict.PARAMETER_SHIFT)
        text = statement.sentence
        assert statement.recalibration is not None
        z = {n: abs(e.after - e.before) / e.standard_error for n, e in statement.recalibration.items()}
        certain = sorted((n for n in z if z[n] > 1.96), key=lambda n: -z[n])
        for name in certain[:3] or [max(z, key=z.__getitem__)]:
            assert re.search(rf"\b{name} is .* ± .*, where the card has 1", text)
        for name in set(z) - set(certain[:3]) - {max(z, key=z.__getitem__)}:
            assert f"{name} is " not in text


def test_all_of_it_is_never_said_of_what_is_not_explained():
    for number in CASES:
        statement = statement_from(number, MismatchVerdict.UNEXPLAINED)
        text = said(statement)
        description = statement.description
        assert description is not None
        assert "Nothing accounts" not in text and "probability that" not in text
        assert ("no mechanism in the dictionary accounts" in text) == (not description.by)
        if description.share_described < 1:
            assert " all of " not in text
        if description.share_described > 0.999:
            assert "nothing explains it fully" not in text
        assert ("looks like noise (p =" in text) == (description.p_residuals_random >= 2e-3)


def curve_in_v(**shape: Any) -> StatedTerm:
    return StatedTerm(
        name="a function of x", label="a function of x in v", kind="curve", terms={}, parameters={},
        evidence=Evidence(90.0, -80.0, 0.0, 0.0), equations=("v",), coordinates=("x",), **shape,
    )  # fmt: skip


@pytest.mark.parametrize("described", [False, True])
def test_a_model_without_a_name_is_said_with_its_gain_or_that_nothing_was_gained(described):
    part = curve_in_v()
    augmented = 0.05 if described else 0.31
    errors = errors_with({"before": 0.5, "recalibrated": 0.3, "augmented": augmented}, 0.04)
    description = Description(0.0, (), 0.0, False)
    text = Statement(
        MismatchVerdict.UNEXPLAINED, description=description, errors=errors,
        described=(part,) if described else (),
    ).sentence  # fmt: skip
    if described:
        assert "An effect of x in the equation of v describes a part of it. With it, the error" in text
        assert percentages(text.split("falls from")[1])[:3] == [50.0, 30.0, 5.0]
    else:
        assert "the simulation stays as it was" in text and "falls from" not in text


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ("proportional", "in proportion"), ("straight line", "along a straight line"),
        ("square", "like its square"), ("cube", "like its cube"),
        ("saturating", "saturating over 2.00 ± 0.10 m"),
        ("threshold", "with a threshold at 2.00 ± 0.10 m"), ("periodic", "periodic over 2.00 ± 0.10 m"),
        ("exponential", "exponential over 2.00 ± 0.10 m"), ("rising", "rising"), ("falling", "falling"),
        ("late", "which is late by 2.00 ± 0.10 m"), ("constant", "the same everywhere"),
    ],
)  # fmt: skip
def test_a_shape_is_said_in_words(shape, words):
    part = curve_in_v(shape=shape, sizes={"s_1": Estimate(2.0, 0.1, "m")})
    errors = errors_with({"before": 0.5, "recalibrated": 0.3, "augmented": 0.05}, 0.04)
    errors = replace(errors, spread=10.0, unit="m")
    statement = Statement(MismatchVerdict.MISSING_PHYSICS, described=(part,), errors=errors)
    text = statement.sentence.replace("\u00a0", " ")
    assert statement.outcome == "modelled"
    assert text.startswith(f"An effect of x is missing in the equation of v, {words}. With it, the error on")
    assert (
        "falls from 5.00 m (3.00 m with its own parameters refitted) to 0.500 m (noise alone: 0.400 m)"
        in text
    )


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ("", "in proportion to u"), ("constant", "in proportion to u alone"),
        ("saturating", "in proportion to u and, along x, saturating over 2.00 ± 0.10 m"),
    ],
)  # fmt: skip
def test_a_coefficient_is_said_in_words(shape, words):
    part = curve_in_v(
        shape=shape, formula="s_1*x", sizes={"s_1": Estimate(2.0, 0.1, "m")},
        curve=DescribedCurve("x", (0.0, 1.0), (0.0, 1.0), (0.1, 0.1)),
    )  # fmt: skip
    part = replace(part, coordinates=("x", "u"))
    errors = errors_with({"before": 0.5, "recalibrated": 0.3, "augmented": 0.05}, 0.04)
    statement = Statement(MismatchVerdict.MISSING_PHYSICS, described=(part,), errors=errors)
    text = statement.sentence.replace("\u00a0", " ")
    assert text.startswith(f"An effect of x and u is missing in the equation of v, {words}. With it")
    assert "As a formula: s_1*x times u, s_1 = 2.00 ± 0.10 m." in text


def test_what_describes_a_rest_is_told_from_what_has_a_name():
    part = curve_in_v()
    statement = statement_from(3, MismatchVerdict.MISSING_PHYSICS)
    runs = {"before": 0.5, "recalibrated": 0.3, "augmented": 0.05, "named": 0.2}
    errors = errors_with(runs, 0.04)
    text = replace(statement, errors=errors, described=(part,)).sentence
    named, rest = text.split("What is left has no name; an effect of x in the equation of v describes it. ")
    assert percentages(named.split("falls from")[1])[:3] == [50.0, 30.0, 20.0]
    assert percentages(rest.split("falls from")[1])[:2] == [20.0, 5.0] and "refitted" not in rest


def test_random_forces_are_a_verdict_of_their_own():
    forces = StatedTerm(
        name=PROCESS_NOISE, label=PROCESS_NOISE, terms={},
        parameters={"intensity_v": Estimate(0.02, None, "m**2/s**3")},
        evidence=Evidence(None, None, None, None), share_of_excess=1.0, indistinguishable_from=(),
    )  # fmt: skip
    text = said(statement_from(1, MismatchVerdict.MISSING_PHYSICS, mechanisms=(forces,))).replace(
        "\u00a0", " "
    )
    assert "driven by process noise" in text and "0.0200 m²/s³ on v" in text
    assert "lacks" not in text and "falls from" not in text and "explains" not in text


def test_a_failure_keeps_its_sentence():
    statement = statement_of_failure("it runs away")
    assert statement.sentence == sentences_of(statement)["sentence"]
    assert statement.sentence.startswith("The simulation cannot be compared with the recordings")


@pytest.mark.parametrize("recordings", range(1, 6))
def test_recordings_are_counted_only_where_there_are_several(recordings):
    for affected in range(1, recordings + 1):
        labels = tuple(f"r{number}" for number in range(affected))
        place = Location(
            {"v": 0.9}, "x", {"x": (-2.0, 1.5)}, None, labels, recordings_total=recordings, unit="mm"
        )
        text = sentences_of(statement_from(0, MismatchVerdict.MISSING_PHYSICS, location=place))["location"]
        assert "between −2.00 and 1.50 mm" in text
        assert ("all" in text) == (affected == recordings > 1)
        assert ("recording" in text) == (recordings > 1)
        assert "1 recordings" not in text.replace("of 1 recordings", "")


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0, "none"), (1, "all"), (0.99996, "more than 99.9 %"), (0.9996, "more than 99.9 %"),
        (0.99899, "99.8 %"), (0.5, "50 %"), (0.0004, "less than 0.1 %"), (0.996, "99.6 %"), (0.263, "26 %"),
    ],
)  # fmt: skip
def test_a_share_is_not_rounded_to_all_or_nothing(share, text):
    assert percent(share) == text


@pytest.mark.parametrize(
    ("p", "text"),
    [(0.4, "0.4"), (0.034, "0.034"), (2.9e-3, "2.9 × 10⁻³"), (0.0, "less than 10⁻¹²"), (1e-9, "1.0 × 10⁻⁹")],
)
def test_p_values_are_written_as_people_do(p, text):
    assert p_text(p) == text


@pytest.mark.parametrize("verdict", list(MismatchVerdict))
def test_a_statement_is_read_as_it_was_written(verdict):
    for number in range(20):
        place = Location({"v": 0.9}, "t", {}, (0.0, 2.0), ("r1",), recordings_total=3)
        remarks = (Remark("diagnosis.partial", {"untried": 2, "stopped_by": "work"}),)
        statement = statement_from(number, verdict, location=place, remarks=remarks)
        data = json.loads(json.dumps(statement.as_data(), allow_nan=False))
        assert Statement.from_data(data) == statement
        assert Statement.from_data(data).as_data() == data


def test_a_fault_of_a_sensor_is_in_what_it_measures_and_not_in_a_state_of_its_own() -> None:
    lag = StatedTerm(
        name="sensor lag", label="sensor lag in y", terms={"y": "z_1", "z_1": "(x - z_1)/tau_1"},
        parameters={}, evidence=Evidence(500.0, -490.0, 0.0, 0.0, 9.0), outputs=("y",),
        indistinguishable_from=(),
    )  # fmt: skip
    statement = Statement(MismatchVerdict.MISSING_PHYSICS, mechanisms=(lag,))
    again = Statement.from_data(json.loads(json.dumps(statement.as_data())))
    assert said(statement) == said(again)
    assert said(again).startswith("Sensor lag is missing in the measurement of y.")


def test_a_value_below_its_error_is_said_to_be_uncertain_and_not_zero() -> None:
    # Of two compartments of which one is measured the recordings tell two rates, and not the three.
    sizes = {"c": Estimate(0.7655, 16083.5, "1/h"), "d": Estimate(2.2941, 0.0079, "1/s")}
    said = " ".join(str(diagnosis_page._templates().numbers(sizes)).split())
    assert said == "c ≈ 0.77 1/h (uncertain by more than that), d = 2.2941 ± 0.0079 1/s"
