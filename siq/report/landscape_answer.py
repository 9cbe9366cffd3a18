"""The answer of a landscape: how many stable states, where, how deep, how long each lasts.

What is said here is said by the page of a study and by `siq.Landscape.report` alike: both hand in a landscape
as plain data, see `siq.quasipotential.landscape_files.landscape_data`.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from siq.data.two_states import RecordStates
from siq.numerics.text import number_text, range_text, unit_text, value_text
from siq.numerics.text import place_text as place_text_measured_text
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_files import landscape_data
from siq.quasipotential.rates import DWELL_TIMES_FEWEST, MeanTime
from siq.report.landscape_summary import SaidLandscape, SaidVisits, SaidWell, well_name
from siq.report.page import Badge, ReportTable
from siq.workflow.outcomes import Method

TESTS = {
    "identity": "the formulas add up to the identified f",
    "hamilton_jacobi": "U solves its equation at points that were held out",
    "branch": "U has the right curvature at every stable state",
    "descent": "U falls along recordings that were held out",
    "error": "the error that remains is small enough to be stated",
    "existence": "stable states and saddles exist, whatever f its uncertainty allows for",
    "characteristics": "an independent calculation, along characteristics of f, gives the same U",
    "agreement": "two routes to U lead to the same one",
    "prediction": "f predicts recordings that were held out",
    "record": "the record hops, and is spread, as f and D say",
    "same_as_refined": "it is the same U as the one above",
}
"""What each test asks, as a reader is told."""

FAILURES = {
    "identity": "the formulas do not add up to the identified f",
    "hamilton_jacobi": "U does not solve its equation at points that were held out",
    "branch": "U does not have the curvature at the stable states that f asks for",
    "descent": "U does not fall along recordings that were held out",
    "error": "the error that remains is too large to be stated",
    "existence": "the recordings do not tell whether all stable states and saddles exist",
    "characteristics": "an independent calculation, along characteristics of f, gives another U",
    "agreement": "two routes to U lead to different ones",
    "prediction": "f does not predict recordings that were held out",
    "record": "the record hops, or is spread, otherwise than f and D say",
}
"""The same where the answer is no."""

PERCENT = 1e-4  # a smaller share is written with a power of ten


def share_text(share: float) -> str:
    """A relative error: ``3.7 %``, ``4.2 × 10⁻⁶``.

    Examples
    --------
    >>> share_text(0.0371)
    '3.7 %'
    """
    if share < PERCENT:
        return number_text(share, decimals=1)
    percent = 100 * share
    return f"{percent:.2g} %" if percent < 99.5 else f"{percent:.0f} %"


def certificate_badge(
    certificate: Mapping[str, Any] | None,
    *,
    certified: int,
    runs: int,
    refusals: Mapping[str, str],
    given: bool = False,
) -> Badge:
    """The badge of a study.

    Parameters
    ----------
    certificate
        That of the formulas that are shown, as in `model.json`; None where there is no formula.
    certified, runs
        How many runs are certified, of how many.
    refusals
        Why the others are not, by test.
    given
        Whether f was given as equations.
    """
    if certificate is None:
        return Badge("no formula", False, ["There is nothing that a certificate could be given for."])
    made = len(certificate.get("tests", {}))
    if not certificate["certified"]:
        return Badge("not certified", False, _refused(certificate, certified, runs, refusals, given))
    error = certificate["stated_error"]
    within = "" if error is None else f" to within {share_text(error)} of its height"
    promise = [
        f"All {made} tests passed. One of them computes U once more, by a method that shares nothing with the"
        f" fit but f, and finds the same{within}.",
        "This does not promise anything outside the domain, nor that these equations are those of nature."
        if given
        else "This does not promise anything outside the recorded region, nor that all states that matter"
        " were recorded.",
    ]
    if runs > 1:
        promise.append(f"{certified} of {runs} runs are certified.")
    return Badge("certified", True, promise)


def _refused(
    certificate: Mapping[str, Any], certified: int, runs: int, refusals: Mapping[str, str], given: bool
) -> list[str]:
    failed = [name for name, test in certificate.get("tests", {}).items() if not test["passed"]]
    lines = []
    if failed:
        told = "; ".join(FAILURES.get(name, name.replace("_", " ")) for name in failed)
        lines.append(f"{told[0].upper()}{told[1:]}.")
    elif reason := str(certificate.get("reason") or "; ".join(refusals.values())):
        lines.append(f"{reason[0].upper()}{reason[1:]}.".replace("..", "."))
    tests = certificate.get("tests", {})
    if given or tests.get("prediction", {}).get("passed"):
        lines.append(
            "Positions, depths and times above follow from f, along its most likely ways out. It is U as a"
            " formula"
            " that failed."
        )
    lines.append(
        "Do not rely on the formula before you have checked it in another way."
        if given
        else "A formula that fails a test may belong to another landscape that fits the recordings just as"
        " well. Do not"
        " rely on it before you have checked it in another way."
    )
    if runs > 1:
        lines.append(f"{certified} of {runs} runs are certified.")
    return lines


def certificate_line(certificate: Mapping[str, Any] | None) -> str:
    """The certificate in one sentence, for text."""
    if certificate is None:
        return "No test was made of these formulas."
    if certificate["certified"]:
        error = certificate["stated_error"]
        return "The formulas are certified" + (
            "." if error is None else f": U is right to within {share_text(error)} of its height."
        )
    return f"The formulas are not certified: {certificate['reason']}."


def tests_table(certificates: pd.DataFrame, run: int, method: Method) -> pd.DataFrame:
    """The tests of the formulas that are shown: what was asked, the figure, its limit, the verdict."""
    mine = certificates[(certificates["run"] == run) & (certificates["method"] == method)]
    return pd.DataFrame(
        {
            "test": [str(name).replace("_", " ") for name in mine["test"]],
            "what it asks": [TESTS.get(str(name), "") for name in mine["test"]],
            "found": mine["value"].to_numpy(),
            "limit": mine["limit"].to_numpy(),
            "passed": mine["passed"].to_numpy(),
            "reason": mine["reason"].to_numpy(),
        }
    )


COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
LISTED = 3  # stable states that one sentence can list
LONGEST_PLACE = 4  # states of which a sentence writes out a position
LARGE = 0.5  # relative error from which a range says more than ±
RESOLVED = 2.0  # standard errors, the usual ones of 95 %: a barrier below may be none


def headline(data: Mapping[str, Any] | None, *, missing: str = "") -> str:
    """The answer in one sentence.

    Parameters
    ----------
    data
        The landscape as plain data, None where there is none.
    missing
        Why there is none, in words.
    """
    if data is None or not data["wells"]:
        notes = [] if data is None else list(data["notes"])
        reason = missing or (notes[0] if notes else "")
        region = "recorded region" if data is None else SaidLandscape(data).region
        return f"No stable state was found in the {region}" + (f": {reason}." if reason else ".")
    said = SaidLandscape(data)
    wells = said.wells
    count = COUNTS[len(wells)] if len(wells) < len(COUNTS) else str(len(wells))
    subject = "equations have" if said.given else "recordings show"
    kind = "attractor" if any(well.cycle is not None for well in wells) else "stable state"
    opening = f"The {subject} {count} {kind}{'s' if len(wells) > 1 else ''}"
    if len(wells) == 1:
        return _alone(said, wells[0], opening)
    if len(wells) > LISTED:
        return _many(said, opening)
    facts = [_facts(said, well) for well in wells]
    if len(set(facts)) == 1 and facts[0]:
        places = _listed([f"{well.name} {_where(said, well)}" for well in wells])
        return f"{opening}, {places}; each {facts[0]}."
    told = [
        f"{well.name} {_where(said, well)} {fact or 'has no barrier that could be found'}"
        for well, fact in zip(wells, facts, strict=True)
    ]
    return f"{opening}: {_listed(told, last='; and ', between='; ')}."


def _alone(said: SaidLandscape, well: SaidWell, opening: str) -> str:
    fact = _facts(said, well)
    if fact:
        return f"{opening}, {_where(said, well)}: it {fact}."
    text = f"{opening}, {_where(said, well)}, and no way out of it within the {said.region}"
    if math.isfinite(well.known_up_to):
        text += f"; U is known up to {value_text(well.known_up_to, unit=said.energy_unit)} above it"
    return f"{text}."


def _many(said: SaidLandscape, opening: str) -> str:
    known = [well for well in said.wells if math.isfinite(well.depth)]
    if not known:
        return f"{opening}, and no barrier between them could be found."
    deepest, shallowest = (pick(known, key=lambda well: well.depth) for pick in (max, min))
    text = f"{opening}: the deepest, {deepest.name} {_where(said, deepest)}, {_facts(said, deepest)}"
    return f"{text}; the shallowest, {shallowest.name}, {_facts(said, shallowest)}."


def _listed(parts: Sequence[str], *, last: str = " and ", between: str = ", ") -> str:
    return parts[0] if len(parts) == 1 else between.join(parts[:-1]) + last + parts[-1]


def _facts(said: SaidLandscape, well: SaidWell) -> str:
    """How deep a well is, and how long it lasts: ``is 0.25 µm²/s deep and lasts 33 ± 4 s``."""
    if not math.isfinite(well.depth):
        return ""
    ratio, error = said.relative_depth(well)
    if well.visits is not None and _below_law(said, well):
        barrier = f"behind a barrier of {value_text(ratio, error)} times the noise strength"
        return f"lasts {_visits_text(well.visits, said.time_unit)}, {barrier}"
    text = f"is {value_text(well.depth, well.depth_error, unit=said.energy_unit)} deep"
    if math.isfinite(ratio):
        text += f" ({value_text(ratio, error)} times the noise strength)"
    if well.time is not None:
        text += f" and lasts {time_text(well.time, said.time_unit)}"
    elif said.noise is not None and ratio <= 1:
        text += ", too shallow to hold the state against this noise"
    return text


def _below_law(said: SaidLandscape, well: SaidWell) -> bool:
    """Whether the barrier is too low for the law of escape, and is known to be."""
    return said.relative_depth(well)[0] < DWELL_TIMES_FEWEST


def _visits_text(visits: SaidVisits, unit: str) -> str:
    """How long visits last: ``890 (580 to 1400) s as counted and 600 ± 140 s by f and D``."""
    named = unit if unit_text(unit) else "time units"
    return f"{counted_text(visits, named)} as counted and {foreseen_text(visits, named)} by f and D"


def counted_text(visits: SaidVisits, unit: str = "") -> str:
    """The mean of visits on the record, with its interval of 95 %; of none that ended a lower bound."""
    if not visits.count:
        return f"more than {value_text(visits.lowest, unit=unit, digits=2)}"
    ends = range_text(visits.lowest, visits.highest)
    text = f"{value_text(visits.counted, digits=3)} ({ends})"
    return f"{text}\u00a0{unit_text(unit)}" if unit_text(unit) else text


def foreseen_text(visits: SaidVisits, unit: str = "") -> str:
    """The same mean as f and D say, with its error; a range where that is large."""
    share = visits.error / visits.predicted
    if share > LARGE:
        factor = math.exp(share)
        return range_text(visits.predicted / factor, visits.predicted * factor, unit=unit)
    return value_text(visits.predicted, visits.error, unit=unit)


def time_text(mean: MeanTime, unit: str, *, decorated: bool = True) -> str:
    """A mean time with its error; a range where the error is as large as the time.

    Parameters
    ----------
    mean
        The time.
    unit
        Of the time, ``1`` where nobody said.
    decorated
        Whether to name a unit that nobody said, and to say of which kind the figure is.
    """
    named = unit if unit_text(unit) or not decorated else "time units"
    if mean.error > LARGE:
        text = range_text(*mean.limits, unit=named)
    else:
        text = value_text(mean.value, mean.value * mean.error, unit=named)
    return text if mean.complete else f"at most {text}"


def _where(said: SaidLandscape, well: SaidWell) -> str:
    """``at (x, y) = (0, 0)``; of a cycle its period."""
    if well.cycle is None:
        return f"at {place_text(said, well)}"
    unit = said.time_unit if unit_text(said.time_unit) else ""
    text = f"a limit cycle of period\u00a0{value_text(well.period, unit=unit, digits=4)}"
    return text if len(said.wells) == 1 else f"({text})"


def place_text(said: SaidLandscape, well: SaidWell) -> str:
    """Where a well is: ``x = −0.996 ± 0.005 nm``, ``(x, y) = (−0.50, 0.00) µm``."""
    names, units = said.states, said.units
    if len(names) > LONGEST_PLACE:
        return "the place that the table gives"
    if len(names) == 1:
        return (
            f"{names[0]}\u00a0=\u00a0{value_text(well.position[0], well.position_errors[0], unit=units[0])}"
        )
    size = float(np.abs([one.position for one in said.wells]).max())
    values = [
        _rounded(value, error, size=size)
        for value, error in zip(well.position, well.position_errors, strict=True)
    ]
    if len(set(units)) == 1:
        unit = unit_text(units[0])
        listed, named = ", ".join(values), ",\u00a0".join(names)  # a phone breaks the values, not the names
        return f"({named})\u00a0=\u00a0({listed})" + (f"\u00a0{unit}" if unit else "")
    pairs = zip(names, values, units, strict=True)
    return ", ".join(
        f"{name}\u00a0=\u00a0{value}\u00a0{unit_text(unit)}".rstrip() for name, value, unit in pairs
    )


def _rounded(value: float, error: float, *, size: float) -> str:
    """A value to the digits that its error leaves, without the error."""
    if not math.isfinite(error) or error < 1e-4 * size:
        error = 1e-3 * size if size else 1.0
        if abs(value) < 0.5e-3 * error:  # what rounding left of zero
            return "0"
    decimals = max(0, -math.floor(math.log10(error))) if error > 0 else 3
    if decimals > 6 or size >= 1e5:
        return value_text(value)
    text = f"{abs(value):.{decimals}f}"
    return ("−" if value < 0 and float(text) else "") + text


def remarks(data: Mapping[str, Any] | None) -> list[str]:
    """What has to be known of the sentence: what the times mean, or what would make times of the depths."""
    if data is None or not data["wells"]:
        return []
    said = SaidLandscape(data)
    deep = [well for well in said.wells if math.isfinite(well.depth)]
    if not deep:
        return []
    noise = said.noise
    laws = any(way["prefactor"] is not None for way in data["transitions"])
    if noise is None and not laws and any(well.cycle is not None for well in said.wells):
        return []  # no noise would make times of these barriers
    if noise is None:
        silent = "the equations do not say how strong it is" if said.given else "these recordings show none"
        return [
            f"How long a stable state lasts depends on the noise, and {silent}. Give its"
            " strength ε, in the unit of U, as “landscape: {noise_intensities: [ε]}” in the study, and the"
            " times"
            " follow."
        ]
    lines = _visits_remarks(said, deep)
    by_law = [well for well in deep if well.visits is None or not _below_law(said, well)]
    if any(well.time is not None for well in by_law):
        strength = value_text(noise.intensity, noise.standard_error, unit=said.energy_unit)
        whence = "as the recordings show it" if noise.source == "estimated" else "as given"
        lines.append(
            "A time is the mean until the state has reached the next well, at the noise strength"
            f" ε = {strength}, {whence}. Its error covers f, the noise and the law itself, which is good"
            f" to about"
            " ε/ΔU."
        )
    low = [well for well in by_law if _below_law(said, well)]
    if low:
        times = any(well.time is not None for well in low)
        lines.append(
            "The law of escape holds for barriers far above the noise. Here"
            f" {_listed([well.name for well in low])} {'is' if len(low) == 1 else 'are'} less than"
            f" {DWELL_TIMES_FEWEST:.0f} times the noise strength deep:"
            + (" take the times as orders of magnitude." if times else " it gives no time.")
        )
    without = [well.name for well in by_law if well.time is None and said.relative_depth(well)[0] > 1]
    if without:
        notes = [note for way in data["transitions"] for note in way["notes"] if "no escape time" in note]
        lines.append(
            f"No time can be given for {_listed(without)}"
            + (f": {notes[0].split(': ', 1)[-1]}." if notes else ".")
        )
    return lines


def _visits_remarks(said: SaidLandscape, deep: Sequence[SaidWell]) -> list[str]:
    """What the times of wells mean whose barriers are too low for a law, and whether there are any."""
    low = [well for well in deep if well.visits is not None and _below_law(said, well)]
    if not low:
        return []
    names = _listed([well.name for well in low])
    are = "is" if len(low) == 1 else "are"
    methods = {well.visits.method for well in low if well.visits is not None}
    whence = "the Fokker–Planck operator of f and D" if methods == {"operator"} else "f and D"
    lines = [
        f"{names} {are} less than {DWELL_TIMES_FEWEST:.0f} times the noise strength deep, so that no law of"
        " escape holds."
        " The times are means of visits, from the core of a well to that of another: as counted on the"
        f" recordings, with the interval of 95 %, and as {whence} give{'s' if 'operator' in methods else ''}"
        " them. So low, where a core ends changes the time."
    ]
    unresolved = [
        well.name for well in low if said.relative_depth(well)[0] < RESOLVED * said.relative_depth(well)[1]
    ]
    if unresolved:
        subject = "barrier out of {} is" if len(unresolved) == 1 else "barriers out of {} are"
        lines.append(
            f"The {subject.format(_listed(unresolved))} not resolved:"
            " within the error there may be none. f says where states stay longer, not that they are"
            " held there."
        )
    return lines


def wells_table(data: Mapping[str, Any]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The wells for a reader, a column for each, and the same as numbers, a row for each."""
    said = SaidLandscape(data)
    share, led = "share_of_recorded_states", "recorded states"
    if said.given:
        share, led = "share_of_domain", "share of the domain"
    rows: dict[str, list[str]] = {}
    numbers = []
    for well in said.wells:
        ratio, ratio_error = said.relative_depth(well)
        mean = well.time
        numbers.append(
            {"well": well.name}
            | dict(zip(said.states, well.position.tolist(), strict=True))
            | {
                f"{name}_error": error
                for name, error in zip(said.states, well.position_errors.tolist(), strict=True)
            }
            | {
                "depth": well.depth, "depth_error": well.depth_error, "depth_over_noise": ratio,
                "depth_over_noise_error": ratio_error,
                "mean_time": math.nan if mean is None else mean.value,
                "mean_time_relative_error": math.nan if mean is None else mean.error,
                "next": well.beyond or "", share: well.basin,
            }
        )  # fmt: skip
        for name, unit, value, error in zip(
            said.states, said.units, well.position, well.position_errors, strict=True
        ):
            rows.setdefault(_headed(name, unit), []).append(value_text(value, error))
        if well.cycle is not None:
            for name, unit, low, high in zip(
                said.states, said.units, well.cycle.min(axis=0), well.cycle.max(axis=0), strict=True
            ):
                rows[_headed(name, unit)][-1] = range_text(low, high)
        if any(each.cycle is not None for each in said.wells):
            rows.setdefault(_headed("period", said.time_unit), []).append(
                "" if well.cycle is None else value_text(well.period, digits=4)
            )
            rows.setdefault("Floquet multipliers", []).append(
                ", ".join(_multiplier(one) for one in well.multipliers)
            )
        deep = math.isfinite(well.depth)
        rows.setdefault(_headed("depth ΔU", said.energy_unit), []).append(
            value_text(well.depth, well.depth_error) if deep else ""
        )
        rows.setdefault("ΔU/ε", []).append(value_text(ratio, ratio_error) if math.isfinite(ratio) else "")
        rows.setdefault(_headed("lasts", said.time_unit), []).append(
            "" if mean is None else time_text(mean, "1", decorated=False)
        )
        if any(each.visits is not None for each in said.wells):
            seen = well.visits
            rows.setdefault(_headed("mean visit, counted", said.time_unit), []).append(
                "" if seen is None else counted_text(seen)
            )
            rows.setdefault(_headed("mean visit, by f and D", said.time_unit), []).append(
                "" if seen is None else foreseen_text(seen)
            )
        rows.setdefault("next well", []).append(well.beyond or "")
        rows.setdefault(led, []).append(f"{100 * well.basin:.0f} %")
    kept = {name: cells for name, cells in rows.items() if any(cells)}
    if len(said.wells) == 1:
        kept.pop(led, None)
    names = [f"{well.name}" for well in said.wells]
    table = pd.DataFrame([[name, *cells] for name, cells in kept.items()], columns=["stable state", *names])
    if len(names) > LISTED + 1:  # as many columns would be too wide: a row for each
        table = pd.DataFrame({"stable state": names} | kept)
    return table, pd.DataFrame(numbers).dropna(axis=1, how="all")


def _multiplier(value: complex) -> str:
    real = value_text(value.real)
    return (
        real if not value.imag else f"{real} {'−' if value.imag < 0 else '+'} {value_text(abs(value.imag))} i"
    )


def _headed(name: str, unit: str) -> str:
    shown = unit_text(unit)
    return f"{name} ({shown})" if shown else name


METHODS = {"operator": "Fokker–Planck operator", "law": "law of Eyring and Kramers"}


def with_visits(overview: Mapping[str, Any] | None, record: pd.DataFrame) -> dict[str, Any] | None:
    """A landscape as plain data, with how long visits to its wells last.

    Parameters
    ----------
    overview
        The landscape of a run; None where there is none.
    record
        The table of that name, of all runs.
    """
    if overview is None:
        return None
    rows = {str(one["attractor"]): one for one in record[record["run"] == overview["run"]].to_dict("records")}
    visits = [
        {
            "well": index,
            "visits": int(one["visits"]),
            "counted": one["counted"],
            "lowest": one["lowest"],
            "highest": one["highest"],
            "predicted": one["predicted"],
            "error": one["predicted_error"],
            "method": one["method"],
        }
        for index, well in enumerate(overview["wells"])
        if (one := rows.get(place_text_measured_text(well["attractor"]))) is not None
    ]
    return {**overview, "visits": visits}


def with_seen_states(
    told: Sequence[str], overview: Mapping[str, Any], seen: RecordStates | None, *, certified: bool
) -> list[str]:
    """What is told of a landscape, with the states that the recordings show by themselves.

    Parameters
    ----------
    told
        The answer in one sentence, and what has to be known of it.
    overview
        The landscape as plain data.
    seen
        The states, None where nothing is known of them.
    certified
        Whether the landscape may be believed: then nothing is added.
    """
    own = "" if seen is None else seen.sentence()
    if own and len(overview["wells"]) == 1:
        # What is seen without any formula comes first where the formula misses it.
        alone = f"What was identified misses them: {told[0][0].lower()}{told[0][1:]}"
        return [own, alone, *told[1:]]
    if own and not certified:
        return [*told, f"Without any formula: {own[0].lower()}{own[1:]}"]
    return list(told)


def record_sentences(record: pd.DataFrame, missing: str) -> list[str]:
    """How many hops were seen, what that allows, and whether it agrees; or why there is no test.

    Parameters
    ----------
    record
        The rows of one run of the table of that name.
    missing
        Why there is no test; empty where there is one.
    """
    if record.empty:
        return [f"There is no test against the record itself: {missing}."] if missing else []
    hops, held = int(record["visits"].sum()), int(record["held_out_visits"].sum())
    if not hops:
        return ["No hop from well to well was seen."]
    fewest = int(record["visits"].min())
    worth = (
        "tells nothing of its mean" if not fewest else f"is known to {100 / math.sqrt(fewest):.0f} % at best"
    )
    seen = f"{hops} hops from well to well were seen" if hops > 1 else "One hop from well to well was seen"
    part = "none" if not held else str(held)
    return [
        f"{seen}, {part} of them on recordings that were held out. A mean time from n visits has a relative"
        f" error of 1/√n: the one of the fewest visits, {fewest}, {worth}."
    ]


def record_table(record: pd.DataFrame, time_unit: str, folder: Path) -> ReportTable | None:
    """Mean visits to each well, counted and predicted; None where there is no test.

    Parameters
    ----------
    record
        The rows of one run of the table of that name.
    time_unit
        Of the recordings.
    folder
        Where the whole tables are.
    """
    if record.empty:
        return None
    unit = f" ({unit_text(time_unit)})" if unit_text(time_unit) else ""
    rows = [
        {
            "well about": one["attractor"],
            "visits seen to end": int(one["visits"]),
            f"mean visit, counted{unit}": _counted(one),
            "held out: visits": int(one["held_out_visits"]),
            f"held out: mean{unit}": value_text(one["held_out_counted"], digits=3)
            if math.isfinite(one["held_out_counted"])
            else "none ended",
            f"predicted{unit}": _predicted(one),
            "by": METHODS.get(str(one["method"]), str(one["method"])),
            "probability": f"{one['probability']:.2g}",
        }
        for one in record.to_dict("records")
    ]
    explained = {
        "visits seen to end": "a visit lasts from where the core of a well is entered until the core of"
        " another one is; what the record cuts counts with its time, and not as a visit",
        f"mean visit, counted{unit}": "on all recordings: time over visits, with its interval of 95 %",
        f"predicted{unit}": "of the same visits, from f, D and ε, with the error that these leave",
        "probability": "of a count on held-out recordings that is as far off, were the prediction true within"
        " its error",
    }
    return ReportTable(
        "How long visits to each well last: counted on the record, and predicted.",
        pd.DataFrame(rows), explained, f"{folder}/record.csv", data=record, rows_named=True,
    )  # fmt: skip


def _counted(one: Mapping[Any, Any]) -> str:
    if not one["visits"]:
        return f"above {value_text(one['lowest'], digits=2)}"
    return f"{value_text(one['counted'], digits=3)} ({range_text(one['lowest'], one['highest'])})"


def _predicted(one: Mapping[Any, Any]) -> str:
    share = one["predicted_error"] / one["predicted"]
    if share > LARGE:
        return range_text(one["predicted"] * math.exp(-share), one["predicted"] * math.exp(share))
    return value_text(one["predicted"], one["predicted_error"])


def landscape_text(landscape: Landscape) -> str:
    """The report of a landscape as text: the answer, whether it may be believed, wells, ways out, notes."""
    parts = [*_opening(landscape)]
    for heading, table in _tables(landscape):
        parts += ["", heading, table.to_string(index=False, na_rep="-")]
    parts += ["", *landscape.notes] if landscape.notes else []
    return "\n".join(parts)


def landscape_html(landscape: Landscape) -> str:
    """The same as HTML, without scripts or styles."""
    parts = [f"<p>{html.escape(line)}</p>" for line in _opening(landscape)]
    for heading, table in _tables(landscape):
        parts += [f"<p>{html.escape(heading)}</p>", table.to_html(index=False, na_rep="-", border=0)]
    parts += [f"<p>{html.escape(note)}</p>" for note in landscape.notes]
    return "\n".join(parts)


def _opening(landscape: Landscape) -> list[str]:
    """What the page of a study opens with, too: the sentence, the verdict, what has to be known of it."""
    data = landscape_data(landscape, dynamics=landscape.dynamics)
    certificate = None if landscape.certificate is None else landscape.certificate.as_data()
    answer, *further = with_seen_states(
        [headline(data), *remarks(data)], data, landscape.seen,
        certified=certificate is not None and bool(certificate["certified"]),
    )  # fmt: skip
    written = certificate is not None or any(well is not None for well in landscape.wells)
    verdict = certificate_line(certificate) if written else "U is not written as a formula."
    return [answer, verdict, *further]


def _tables(landscape: Landscape) -> list[tuple[str, pd.DataFrame]]:
    data = landscape_data(landscape, dynamics=landscape.dynamics)
    tables = [("Stable states:", wells_table(data)[0])] if data["wells"] else []
    if landscape.transitions:
        ways = landscape.barriers().rename(columns={"start": "from", "end": "to"})
        for end in ("from", "to"):
            ways[end] = [None if pd.isna(well) else well_name(int(well)) for well in ways[end]]
        tables.append(("Ways out, and their barriers of U:", ways))
    return tables
