"""What does a certificate claim of a record, and is it true?

A certified landscape claims ΔU/ε on every way out of every well, and mean times: of the visits that it
foresees, and by the law of Eyring and Kramers. Each has an interval of 95 %. It is *off* where the truth lies
outside of the interval *and* more than a tenth away. The truth of a diffusion in one state is by quadrature.
Of any other process it is what a user would count in a record twenty times as long: ``-log p`` at the top
less that at the well, and the time spent per hop. Where the process never passes from one claimed well to the
other, no finite barrier or time is true. What may be read in two ways, such as from where to where a visit is
counted, is off only where it is by both.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.hostile.kinds import Kind
from benchmarks.hostile.records import STEP, Record
from siq.data.recordings import Recordings
from siq.errors import InputError
from siq.quasipotential.landscape import Landscape
from siq.workflow.pipeline import analyse

LONGER = 20  # times the record: what is counted there is true
INTERVAL = 1.96  # standard errors on either side of a 95 % interval
TOLERANCE = 0.1  # of the truth
BINS = 160  # of a density: of the width of a well a tenth


@dataclass(frozen=True)
class Claim:
    """One number that a certificate stands for.

    Attributes
    ----------
    what
        ``barrier``, ``visit`` or ``law``.
    start, end
        The wells, dimensionless; the end of a barrier may be its top, where the way leads nowhere else.
    value, low, high
        The number, ΔU/ε or a dimensionless time, and its interval of 95 %.
    gain
        ``log q(top)/q(start)``: what a density shows of a barrier more than U/ε.
    """

    what: str
    start: float
    end: float
    value: float
    low: float
    high: float
    gain: float = 0.0


@dataclass
class Score:
    """What came of one case.

    Attributes
    ----------
    certified
        Whether anything was certified.
    claims, off
        How many numbers were claimed, and of which, in words, the truth is another one.
    excess
        How far the worst of these is off, in halves of its interval: 1 to 1.5 comes by chance, 3 does not.
    codes
        What refused, by name.
    seconds
        Of one core.
    said
        The refusal in words.
    """

    certified: bool = False
    claims: int = 0
    off: list[str] = field(default_factory=list)
    excess: float = 0.0
    codes: list[str] = field(default_factory=list)
    seconds: float = float("nan")
    said: str = ""

    @property
    def false(self) -> bool:
        """Whether a certificate stands for something that is not so."""
        return self.certified and bool(self.off)


def scored(kind: Kind, seed: int, strength: float, *, honest: bool = False) -> Score:
    """What siq says of one case, and whether it is so."""
    record = kind.record(seed, strength, honest=honest)
    found, score = answer(record.recordings())
    if score.certified and found is not None:
        claims = claims_of(found, record)
        longer = record if record.law else kind.record(seed, strength, honest=honest, copies=LONGER)
        faults = [fault(one, longer) for one in claims]
        score.claims, score.off = len(claims), [text for text, _ in faults if text]
        score.excess = max((excess for _, excess in faults), default=0.0)
    return score


def answer(recordings: Recordings) -> tuple[Landscape | None, Score]:
    """The landscape as a user has it, whether it is certified, and what refused it."""
    score, before = Score(), time.process_time()
    try:
        analysis = analyse(recordings)
    except InputError as error:
        score.codes, score.said, score.seconds = ["input"], str(error), time.process_time() - before
        return None, score
    score.seconds = time.process_time() - before
    landscape = None if analysis.landscape is None else analysis.landscape.result
    certificate = analysis.refined.certificate
    identified = analysis.identified.result
    reasons = [one.reason for one in analysis.outcomes if one.reason]
    if certificate is not None:
        score.certified = certificate.certified and landscape is not None
        score.codes = [name for name, verdict in certificate.tests.items() if not verdict.passed]
        reasons = [certificate.reason, *reasons]
    elif identified is None:
        refused = [one.details["claim"] for one in analysis.outcomes if "claim" in one.details]
        score.codes = ["no_dynamics", *refused]
    if landscape is None:
        score.codes.append("no_landscape")
    if identified is not None and identified.diagnosis is not None:
        kind_of_noise = identified.diagnosis.kind
        score.codes += [kind_of_noise] if kind_of_noise in ("coloured", "measurement", "rounding") else []
    score.said = "; ".join(dict.fromkeys(one for one in reasons if one))
    return landscape, score


def claims_of(found: Landscape, record: Record) -> list[Claim]:
    """The barriers and times of a landscape of one state, made dimensionless."""
    scene = record.scene

    def place(position: np.ndarray) -> float:
        return float((position[0] - scene.offset) / scene.unit)

    claims, noise, diffusion = [], found.noise, found.dynamics.diffusion
    wells = [place(one.position) for one in found.attractors]
    estimate = found.field_estimate
    # In the plane of a state and a slow force a barrier is no ``-log p`` of the state alone:
    # `benchmarks.slow_forces` holds it against equations.
    of_plane = estimate is not None and bool(getattr(estimate, "slow_force", 0.0))
    for way in found.transitions:
        if noise is None or not np.isfinite(way.barrier) or of_plane:
            continue
        height = way.barrier / noise.intensity
        error = np.hypot(
            np.nan_to_num(way.error) / noise.intensity,
            height * way.leverage * noise.standard_error / noise.intensity,
        )
        top = np.atleast_1d(way.place)
        strengths = diffusion.at(np.array([found.attractors[way.start].position, top]))[:, 0, 0]
        end = wells[way.end] if way.end is not None else place(top)
        margin, gain = INTERVAL * error, float(np.log(strengths[1] / strengths[0]))
        claims.append(Claim("barrier", wells[way.start], end, height, height - margin, height + margin, gain))
    times = [(one.well, one.predicted, one.error, "visit") for one in found.visits]
    # Times may be untested where the rest is certified; of older certificates all are claimed.
    if not getattr(found.certificate, "times_certified", True):
        return claims
    if noise is not None:
        row: Any
        for row in found.dwell_times().itertuples():
            spread = float(np.hypot(row.data_error, row.law_error))
            times.append((row.attractor, row.mean_time, spread, "law"))
    for well, mean, spread, what in times:
        others = [one for place, one in enumerate(wells) if place != well]
        if not others or not np.isfinite([mean, spread]).all():
            continue
        end = min(others, key=lambda one: abs(one - wells[well]))
        value, factor = mean / scene.pace, np.exp(INTERVAL * spread)
        claims.append(Claim(what, wells[well], end, value, value / factor, value * factor))
    return claims


def fault(claim: Claim, longer: Record) -> tuple[str, float]:
    """What a claim says and what is true, in words, and how far it is off in halves of its interval.

    Empty and zero where it is not off.
    """
    if claim.what == "barrier":
        low, high, error = _true_barrier(claim, longer)
    else:
        low, high, error = _true_time(claim, longer)
    nearest = min(max(claim.value, low), high)
    margin = error * nearest if np.isfinite(nearest) else 0.0
    inside = claim.low - margin <= nearest <= claim.high + margin
    if inside or (np.isfinite(nearest) and abs(claim.value - nearest) <= TOLERANCE * nearest):
        return "", 0.0
    truth = f"{low:.3g}" if high - low <= 1e-3 * low else f"{low:.3g} to {high:.3g}"
    text = (
        f"{claim.what} from {claim.start:.2f} to {claim.end:.2f}: claimed {claim.value:.3g}"
        f" ({claim.low:.3g} to {claim.high:.3g}), true {truth}"
    )
    half = claim.high - claim.value if nearest > claim.value else claim.value - claim.low
    return text, float(abs(nearest - claim.value) / max(half + margin, 1e-12))


def _true_barrier(claim: Claim, longer: Record) -> tuple[float, float, float]:
    """ΔU/ε by two readings, from the claimed well and from the lowest place near it; and a relative error."""
    near = 0.25 * abs(claim.end - claim.start)
    if longer.law is not None:
        grid, height, error = longer.law.grid, longer.law.height, 0.0
        gain = 0.0
    else:
        hops = counted(longer.states, claim.start, claim.end)[1]
        if not hops:
            return np.inf, np.inf, 0.0
        together = np.concatenate(longer.states)
        spread = np.quantile(together, [0.0005, 0.9995])
        counts, edges = np.histogram(together, bins=BINS, range=(spread[0], spread[1]))
        grid = (edges[1:] + edges[:-1]) / 2
        with np.errstate(divide="ignore"):
            height = -np.log(counts / counts.sum())
        error, gain = INTERVAL / np.sqrt(hops) / max(claim.value, 1.0), claim.gain
    between = (grid >= min(claim.start, claim.end)) & (grid <= max(claim.start, claim.end))
    about = np.abs(grid - claim.start) <= near
    if not between.any() or not about.any():
        return np.inf, np.inf, 0.0
    top = float(height[between].max()) - gain
    readings = top - float(np.interp(claim.start, grid, height)), top - float(height[about].min())
    return max(min(readings), 0.0), max(max(readings), 0.0), error


def _true_time(claim: Claim, longer: Record) -> tuple[float, float, float]:
    """Mean time by two readings, from well to well and from core to core; and a relative error."""
    inner = claim.start + 0.25 * (claim.end - claim.start), claim.end - 0.25 * (claim.end - claim.start)
    ends = [(claim.start, claim.end), inner]
    if longer.law is not None:
        readings, error = [longer.law.time(*one) for one in ends], 0.0
    else:
        seen = [counted(longer.states, *one) for one in ends]
        readings = [mean for mean, _ in seen]
        hops = min(count for _, count in seen)
        error = INTERVAL / np.sqrt(hops) if hops else 0.0
    return min(readings), max(readings), error


def counted(states: Sequence[np.ndarray], start: float, end: float) -> tuple[float, int]:
    """Time in the unit of a sample's step that is spent from reaching a start until an end, and how often."""
    sign, spent, hops = np.sign(end - start), 0, 0
    for one in states:
        core = np.select([sign * one >= sign * end, sign * one <= sign * start], [1, 0], -1)
        known = np.maximum.accumulate(np.where(core >= 0, np.arange(len(core)), -1))
        side = np.where(known >= 0, core[np.maximum(known, 0)], -1)
        spent += int((side == 0).sum())
        hops += int(((side[:-1] == 0) & (side[1:] == 1)).sum())
    return (spent * STEP / hops if hops else np.inf), hops


def as_row(kind: Kind, seed: int, strength: float, honest: bool, score: Score) -> dict[str, Any]:
    """One line of the table of cases."""
    named = not score.certified and bool(kind.named & set(score.codes))
    return {
        "kind": kind.name, "seed": seed, "strength": strength, "honest": honest,
        "certified": score.certified, "claims": score.claims, "false": score.false, "named": named,
        "codes": " ".join(score.codes), "off": "; ".join(score.off), "excess": round(score.excess, 2),
        "seconds": round(score.seconds, 2), "said": score.said,
    }  # fmt: skip
