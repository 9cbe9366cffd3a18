"""The sentence that page and text open with, for every kind of landscape."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.stats
from known_systems import double_well, exact_field, portrait_of
from told_landscapes import NOISE, landscape, told

from siq.quasipotential.landscape_assembly import find_landscape
from siq.quasipotential.landscape_files import landscape_data
from siq.quasipotential.rates import NoiseStrength
from siq.quasipotential.refinement import RefinementOptions
from siq.remarks import Remark
from siq.report.landscape import answer_lines, landscape_tables
from siq.report.summary import summarise, well_name


def headline(data: dict[str, Any]) -> str:
    return answer_lines(summarise(told(data)))[0]


def remarks(data: dict[str, Any]) -> list[str]:
    return answer_lines(summarise(told(data)))[1:]


def test_two_wells_without_noise_have_depths_and_a_way_to_times() -> None:
    data = landscape([[-0.5], [0.6]], [0.25, 0.35])
    said = headline(data)
    assert said == (
        "The recordings show two stable states: A at x\u00a0=\u00a0−0.5000 ± 0.0040\u00a0µm is"
        " 0.250 ± 0.010\u00a0µm²/s deep; and B at x\u00a0=\u00a00.6000 ± 0.0040\u00a0µm is"
        " 0.350 ± 0.010\u00a0µm²/s deep."
    )
    (remark,) = remarks(data)
    assert "noise_intensities" in remark and "follow" in remark
    assert not any(
        "lasts" in text for text in landscape_tables(summarise(told(data)))["wells"][0]["stable state"]
    )


def test_like_wells_are_told_once() -> None:
    said = headline(landscape([[-0.5], [0.5]], [0.25, 0.25], noise=NOISE))
    assert "; each is 0.250 ± 0.010\u00a0µm²/s deep (2.50 ± 0.10 times the noise strength) and lasts " in said
    assert said.count("deep") == 1


def test_under_noise_every_well_lasts_as_the_law_says() -> None:
    data = landscape([[-0.5], [0.5]], [0.8, 0.9], noise=NOISE)
    mean = summarise(told(data)).wells[0].time(summarise(told(data)).noise)
    assert mean is not None and mean.value == pytest.approx(4 * math.exp(8))
    table, numbers = landscape_tables(summarise(told(data)))["wells"]
    assert list(numbers["mean_time"]) == pytest.approx([4 * math.exp(8), 4 * math.exp(9)])
    assert "lasts (s)" in list(table["stable state"]) and "ΔU/ε" in list(table["stable state"])
    assert "± " in headline(data) and " s" in headline(data)
    assert any("ε = 0.1000 ± 0.0010\u00a0µm²/s, as the recordings show it" in one for one in remarks(data))
    assert not any("orders of magnitude" in one for one in remarks(data))


def test_a_low_barrier_gives_a_range_and_a_warning() -> None:
    data = landscape([[-0.5], [0.5]], [0.15, 0.9], noise=NOISE)
    assert " to " in headline(data)
    warning = next(one for one in remarks(data) if "orders of magnitude" in one)
    assert "A is less than 3 times" in warning and "B" not in warning


def test_a_well_below_the_noise_has_no_time() -> None:
    said = headline(landscape([[-0.5], [0.5]], [0.05, 0.9], noise=NOISE))
    assert "less than the noise is strong, so that no law of escape holds" in said


def test_where_the_law_fails_it_is_said_why() -> None:
    data = landscape([[-0.5], [0.5]], [0.8, 0.9], noise=NOISE, prefactor=None)
    for way in data["transitions"]:
        reason = {"reason": "V is not smooth at the saddle"}
        way["remarks"] = [Remark("quasipotential.no_escape_time", reason).as_data()]
    assert "lasts" not in headline(data)
    assert "No time can be given for A and B: V is not smooth at the saddle." in remarks(data)


def test_one_stable_state_and_none() -> None:
    alone = landscape([[0.5]], [])
    known = (SimpleNamespace(level=0.6, points=np.zeros((1, 1))),)
    lines = answer_lines(summarise(replace(told(alone), wells=known)))  # type: ignore[arg-type]
    assert lines[0].startswith("The recordings show one stable state, at x")
    assert lines[0].endswith("U is known up to 1.200\u00a0µm²/s above it.") and lines[1:] == []
    none = landscape([], []) | {
        "remarks": [Remark("quasipotential.reason", {"reason": "they end on a limit cycle"}).as_data()]
    }
    assert headline(none) == "No stable state was found in the recorded region: they end on a limit cycle."


def test_more_wells_than_a_sentence_can_list_are_told_by_their_ends() -> None:
    data = landscape([[float(k)] for k in range(5)], [0.1, 0.5, 0.2, 0.3, 0.4])
    said = headline(data)
    assert "five stable states" in said and "the deepest, B at" in said and "the shallowest, A, " in said
    assert list(landscape_tables(summarise(told(data)))["wells"][0]["stable state"]) == [
        "A",
        "B",
        "C",
        "D",
        "E",
    ]  # a row for each


def test_states_of_one_unit_share_it_and_of_several_keep_theirs() -> None:
    data = landscape([[-0.5, 0.0], [0.5, 0.0]], [0.25, 0.25])
    assert "A at (x,\u00a0y)\u00a0=\u00a0(−0.500, 0.000)\u00a0µm" in headline(data)
    data["units"] = ["um", "um/s"]
    assert "A at x\u00a0=\u00a0−0.500\u00a0µm, y\u00a0=\u00a00.000\u00a0µm/s" in headline(data)
    assert summarise(told(data)).energy_unit == ""  # D then carries the units
    assert summarise(told(landscape([[0.0]], [], units="1"))).energy_unit == "s^-1"
    assert summarise(told(landscape([[0.0]], [], units="1", time="1"))).energy_unit == ""


def test_what_rounding_left_of_zero_is_zero() -> None:
    data = landscape([[-1.0, 4.94066e-324], [1.0, 1e-13]], [0.25, 0.25])
    for well in data["wells"]:
        well["standard_errors"] = [1e-12, 1e-12]
    table, _ = landscape_tables(summarise(told(data)))["wells"]
    assert list(table.set_index("stable state").loc["y (µm)"]) == ["0", "0"]
    assert "e-3" not in headline(data)


def test_ways_equilibria_and_times_for_given_noises_are_tables() -> None:
    summary = summarise(told(landscape([[-0.5], [0.5]], [0.25, 0.35])))
    tables = landscape_tables(summary, (0.05, 0.3))
    times, _ = tables["times"]
    assert list(times.columns)[1:] == ["A lasts (s)", "B lasts (s)"]
    assert times.iloc[1, 1] == "too strong a noise" and times.iloc[0, 1] != ""
    shown, numbers = tables["exits"]
    assert list(shown["way"]) == ["A to B", "B to A"] and list(numbers["barrier"]) == [0.25, 0.35]
    assert list(tables["equilibria"][0]["what"]) == ["stable state", "stable state"]


@pytest.mark.parametrize("noise", [None, NoiseStrength(0.05, 0.001, "estimated")])
def test_text_and_page_say_the_same_sentence(noise: NoiseStrength | None) -> None:
    known = double_well(2)
    found = find_landscape(
        exact_field(known, 3, relative_error=1e-3), portrait_of(known, 250, share=0.8),
        options=RefinementOptions(degrees=(4,)), noise=noise,
    )  # fmt: skip
    data = landscape_data(found)
    text = found.report()
    assert text.splitlines()[0] == headline(data)
    assert ("lasts" in headline(data)) == (noise is not None)
    assert np.isfinite(summarise(told(data)).wells[0].position_errors).all()


def test_letters_go_on_after_the_last() -> None:
    assert [well_name(index) for index in (0, 25, 26, 52)] == ["A", "Z", "A1", "A2"]


def test_a_barrier_below_the_law_tells_of_visits() -> None:
    data = landscape([[-0.5], [0.5]], [0.02, 0.9], noise=NOISE)
    data["transitions"][0]["standard_error"] = 0.03
    data["visits"] = [
        {"well": 0, "visits": 21, "time": 21 * 887.0, "predicted": 814.0, "error": 187.0,
         "method": "operator", "held_out": {"visits": 0, "time": 0.0}, "probability": 0.5}
    ]  # fmt: skip
    said = headline(data)
    assert (
        "lasts 887 (580 to 1400)\u00a0s as counted and 810 ± 190\u00a0s by f and D, behind a barrier" in said
    )
    assert "too shallow" not in said
    lines = remarks(data)
    assert any("A is less than 3 times" in one and "Fokker–Planck operator" in one for one in lines)
    assert any("barrier out of A is not resolved" in one for one in lines)
    assert not any("orders of magnitude" in one for one in lines)
    table, numbers = landscape_tables(summarise(told(data)))["wells"]
    assert "mean visit, counted (s)" in list(table["stable state"]) and len(numbers) == 2


def test_a_well_that_nobody_saw_end_has_a_lower_bound() -> None:
    data = landscape([[-0.5], [0.5]], [0.15, 0.9], noise=NOISE)
    time = 120.0 * scipy.stats.chi2.ppf(0.975, 2) / 2
    data["visits"] = [
        {"well": 0, "visits": 0, "time": time, "predicted": 100.0, "error": 90.0, "method": "operator",
         "held_out": {"visits": 0, "time": 0.0}, "probability": 0.5}
    ]  # fmt: skip
    assert "more than 120\u00a0s as counted and 41 to 246" in headline(data).replace("250", "246")
