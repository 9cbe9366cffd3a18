"""What does `siq` say of a record?"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from benchmarks.laboratories.models import Laboratory
from benchmarks.laboratories.records import table
from benchmarks.laboratories.truths import Truth
from siq.data.recordings import Recordings
from siq.quasipotential.landscape import Landscape
from siq.workflow.pipeline import Analysis, PipelineSettings, analyse
from siq.workflow.study import StateSpace

SAME_PLACE = 0.25  # of the way from an attractor to its saddle: where an attractor found is this one
TRUE_BRANCH = 3.0  # a curvature of V that is wrong by this factor is that of another solution (a choice)


@dataclass
class Answer:
    """What was said of one record; barriers are in the order of the true attractors, NaN where there is none.

    Attributes
    ----------
    certified
        Whether the landscape is certified.
    barriers, standard_errors
        As a user reads them.
    path_barriers
        By the path alone, which knows no formula.
    extra_wells
        Attractors that are none.
    wrong_branch
        Whether a formula of V has another curvature than V at its attractor.
    stated_error
        The certificate's, relative to V.
    terms
        How many terms f has.
    seconds
        What the analysis took.
    said
        Why there is no certificate, in the words of the method.
    """

    certified: bool = False
    barriers: list[float] = field(default_factory=list)
    standard_errors: list[float] = field(default_factory=list)
    path_barriers: list[float] = field(default_factory=list)
    extra_wells: int = 0
    wrong_branch: bool = False
    stated_error: float = float("nan")
    terms: int = 0
    seconds: float = float("nan")
    said: str = ""

    def as_data(self) -> dict[str, Any]:
        """For a file."""
        return asdict(self)


def answered(laboratory: Laboratory, seen: np.ndarray, known: Truth) -> Answer:
    """Identification, wells, barriers of one record by the usual way, without networks."""
    recordings = Recordings.from_frame(table(laboratory, seen))
    space = StateSpace(diffusion="identity" if laboratory.diffusion_given else None)
    before = time.process_time()  # of one core, whatever else the machine does
    analysis = analyse(recordings, PipelineSettings(space=space))
    seconds = time.process_time() - before
    answer = _read(laboratory, analysis, known)
    answer.seconds = seconds
    return answer


def _read(laboratory: Laboratory, analysis: Analysis, known: Truth) -> Answer:
    count = len(known.attractors)
    answer = Answer(*(False, [np.nan] * count, [np.nan] * count, [np.nan] * count))
    said = [one.reason for one in analysis.outcomes if one.reason]
    if analysis.identified.result is not None:
        answer.terms = len(analysis.identified.result.support)
    certificate = analysis.refined.certificate
    if certificate is not None:
        answer.certified, answer.stated_error = certificate.certified, float(certificate.error)
        failed = [name for name, verdict in certificate.tests.items() if not verdict.passed]
        said += [certificate.reason, f"tests not passed: {', '.join(failed)}" if failed else ""]
    found = None if analysis.landscape is None else analysis.landscape.result
    if found is not None:
        _read_landscape(laboratory, found, known, answer)
    else:
        answer.certified = False
    answer.said = "; ".join(dict.fromkeys(each for each in said if each))
    return answer


def _read_landscape(laboratory: Laboratory, found: Landscape, known: Truth, answer: Answer) -> None:
    reach = SAME_PLACE * np.linalg.norm(known.attractors - known.saddles, axis=1)
    unit, unsure = 1.0, 0.0
    if not laboratory.diffusion_given:
        unit, unsure = np.nan, np.nan  # U over a noise that nobody knows
        if found.noise is not None:
            unit = found.noise.intensity
            unsure = found.noise.standard_error / unit
    for place, one in enumerate(found.attractors):
        away = np.linalg.norm(known.attractors - one.position, axis=1)
        true = int(away.argmin())
        if away[true] > reach[true]:
            answer.extra_wells += 1
            continue
        well = found.wells[place]
        if well is not None:
            hessian = well.hessians(one.position[None])[0]
            answer.wrong_branch |= _other_branch(laboratory, found, hessian, known, true)
        ways = [way for way in found.transitions if way.start == place and np.isfinite(way.barrier)]
        if ways:
            lowest = min(ways, key=lambda way: way.barrier)
            height = float(lowest.barrier) / unit
            answer.barriers[true] = height
            answer.standard_errors[true] = float(np.hypot(lowest.standard_error / unit, height * unsure))
            if lowest.path is not None:
                answer.path_barriers[true] = float(lowest.path.action) / unit


def _other_branch(
    laboratory: Laboratory, found: Landscape, hessian: np.ndarray, known: Truth, true: int
) -> bool:
    """Whether the curvatures of V are off the true ones by more than a factor."""
    scale = 1.0
    if not laboratory.diffusion_given:  # V for its own D: the true one is for D = 1 at the attractor
        scale = float(found.dynamics.diffusion.at(known.attractors[true][None])[0, 0, 0])
    shares = np.linalg.eigvals(np.linalg.solve(known.curvatures[true], scale * hessian)).real
    return bool(shares.min() < 1 / TRUE_BRANCH or shares.max() > TRUE_BRANCH)
