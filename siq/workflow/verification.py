"""Verification of results: files by their digests, numbers derived again from the recordings.

The files are compared with ``provenance.jsonl``, in which each step has written what it read and made. Then
trajectories are drawn from the recordings again, f and D identified and the certificate computed, by the
steps that the study names. What formulas claim is judged by other means than those that found them: the
residual of ``f·p + p·Dp = 0``, p = ∇V, by derivatives of the stored formula; the branch by the flow ``f +
2Dp``, which has to lead away from the attractor; a barrier by a quadrature, a mesh, or the action of the
stored path.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import sympy

from siq.data.recordings import read_recordings
from siq.errors import InputError, NumericalFailure
from siq.inference.field_estimate import read_field
from siq.numerics.files import given_path
from siq.quasipotential.formulas import read_model
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations
from siq.quasipotential.landscape_files import read_landscape
from siq.quasipotential.wells import Well
from siq.remarks import Remark
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from siq.systems.formulas import compile_formulas
from siq.validation.mesh import STRAIGHT_REACH, mesh_quasipotential
from siq.workflow.answers import UNRECORDED, Provenance
from siq.workflow.pipeline import draw_run, identify_run, refine_run, source_of
from siq.workflow.study import Study, settings_of
from siq.workflow.tables import Method, Outcome, Step, StepResult, not_trained

Finding = tuple[Literal["agrees", "differs", "open"], Remark]
"""What was found of one claim: it holds, it does not, or it could not be derived again."""

SAME_FIELD = 1e-6  # of the size of f: another machine rounds otherwise
AGREEMENT = 0.05  # of a barrier: as far as a formula is believed whose residual is within its tolerance
NODES, MOST_NODES = 200, 600  # of the mesh along a state: errors of a per cent, in seconds
NODES_OF_TURNING = 20  # for each unit of r by which f turns: errors grow as (r/nodes)²
STATES = 2000  # at which f and a residual are judged


def verify(result: str | Path) -> Iterator[Finding]:
    """Derive again what a page claims.

    Parameters
    ----------
    result
        A folder of results, or the page in it.

    Yields
    ------
    tuple
        ``"agrees"``, ``"differs"`` or ``"open"``, and what was found.

    Raises
    ------
    InputError
        Where there are no results, or the steps that made them wrote no provenance.
    """
    folder = given_path(result)
    folder = folder.parent if folder.is_file() else folder
    kept = Provenance(folder)
    if not kept.file.is_file():
        fault = f"there is no {kept.file.name} in it" if folder.is_dir() else "there are no results"
        raise InputError(folder, "", fault, "name a folder in results, or make the results again")
    differences = list(_files(kept))
    yield from differences
    asked = next((job["study"] for job in kept.made.values() if "study" in job), None)
    if any(kind == "differs" for kind, _ in differences):
        yield _open("numbers_of_damaged_files")
    elif asked is None:
        yield _open("diagnosis")
    else:
        study = Study.model_validate(asked)
        card = _source(kept, "score", "equations")
        yield from (_of_equations if study.entrance == "equations" else _of_trajectories)(study, card, kept)
    yield _open("page")
    yield _open("logs")


def _open(what: str) -> Finding:
    return "open", Remark("workflow.not_derived", {"what": what})


def _told(holds: bool, remark: Remark) -> Finding:
    return "agrees" if holds else "differs", replace(remark, values={**remark.values, "holds": holds})


def _files(kept: Provenance) -> Iterator[Finding]:
    """The files against their digests, and what each step read against what the step before had made."""
    changed = [kept.folder / path for path in kept.changed()] + [kept.file] * bool(kept.broken)
    values = [{"file": str(file), "missing": not file.exists()} for file in changed]
    wrong = [_told(False, Remark("workflow.file_changed", each)) for each in values]
    folders = {path for path in kept.made if (kept.folder / path).is_dir()}
    for file in sorted(kept.folder.rglob("*")):
        place = file.relative_to(kept.folder)
        inside = folders & {each.as_posix() for each in place.parents}
        known = inside or place.as_posix() in kept.made or file.name in UNRECORDED
        if file.is_file() and not known and place.parts[0] not in ("logs", "benchmarks"):
            wrong.append(_told(False, Remark("workflow.file_unknown", {"file": str(file)})))
    outside: dict[str, str] = {}
    for made, job in kept.made.items():
        for source, digest in job["inputs"].items():
            if source not in kept.made:
                outside[source] = digest
            elif kept.made[source]["outputs"][source] != digest:
                wrong.append(_told(False, Remark("workflow.file_older", {"file": made, "source": source})))
    for source, digest in outside.items():
        if (now := Provenance.digest_of(kept.folder / source)) != digest:
            place = (kept.folder / source).resolve()
            remark = Remark("workflow.source_changed", {"file": str(place), "missing": now is None})
            wrong.append(_told(False, remark))
    yield from wrong or [_told(True, Remark("workflow.files_as_made", {"count": len(kept.made)}))]


def _source(kept: Provenance, *tasks: str) -> Path | None:
    """The file from outside that a step of one of these names has read."""
    read = [source for job in kept.made.values() if job["task"] in tasks for source in job["inputs"]]
    return next((kept.folder / source for source in read if source not in kept.made), None)


def _of_trajectories(study: Study, card: Path | None, kept: Provenance) -> Iterator[Finding]:
    """Trajectories, f, verdict, formulas and barrier of the first run that has a formula."""
    settings = settings_of(study, None if study.system is None or card is None else load_system(card))
    places = [kept.folder / "runs" / f"{run:03d}" for run in range(study.runs)]
    models = [read_model(place / "model.json") for place in places]
    run = next((run for run, model in enumerate(models) if model[0]), 0)
    place, (formulas, certificates) = places[run], models[run]
    stored = read_recordings(place / "recordings.parquet")
    source = _source(kept, "draw")
    if source is not None and source.exists():
        drawn = draw_run(settings, source_of(source, settings), number=run).result
        same = (
            drawn is not None and drawn.names == stored.names and np.array_equal(drawn.t, stored.t)
            and np.array_equal(drawn.values, stored.values)
        )  # fmt: skip
        yield _told(same, Remark("workflow.trajectories", {"run": run, "source": source.name}))
    record, again = read_field(place / "vector_field.json"), identify_run(settings, stored, number=run).result
    if record is None or again is None:
        yield _open("field")
        return
    dynamics, x = record.dynamics, stored.values[:: max(1, len(stored.values) // STATES)]
    yield from _field(dynamics, again.dynamics, x)
    if study.training is None:
        identified = StepResult(record, Outcome(run, Step.IDENTIFY))
        refined = refine_run(settings, stored, identified, not_trained(run))
        yield from _verdict(certificates.get(Method.REFINED), refined.certificates.get(Method.REFINED))
    else:
        yield _open("networks")
    for number, well in enumerate(formulas[Method.REFINED].wells if Method.REFINED in formulas else ()):
        yield from _formula(number, well, dynamics, x)
    file = place / "quasipotential.json"
    yield from _barrier(read_landscape(file, dynamics=dynamics) if file.is_file() else None, x)


def _of_equations(study: Study, card: Path | None, kept: Provenance) -> Iterator[Finding]:
    """The certificate of the landscape of equations, its formulas, and a barrier."""
    assert card is not None and study.landscape is not None  # or there would be no such study
    system = load_system(card)
    stored = read_landscape(kept.folder / "quasipotential.json", dynamics=system)
    if stored is None:
        yield _open("landscape")
        return
    settings = settings_of(study, system)
    own = EquationSettings(settings.seed, settings.refinement, settings.certificate, study.landscape)
    both = (stored, landscape_from_equations(system, own))
    yield from _verdict(*(None if one.certificate is None else one.certificate.as_data() for one in both))
    for number, well in enumerate(stored.wells):
        if well is not None:
            yield from _formula(number, well, system, well.points)
    yield from _barrier(stored, system.box.T)


def _field(one: Dynamics, other: Dynamics, x: np.ndarray) -> Iterator[Finding]:
    """The largest difference of f and of D at recorded states, as a share of the largest there."""
    if one.dimension != x.shape[1] or other.dimension != x.shape[1]:  # velocities that were not recorded
        error = 0.0 if list(map(str, one.formulas)) == list(map(str, other.formulas)) else np.inf
    else:
        pairs = ((one.drift(x), other.drift(x)), (one.diffusion.at(x), other.diffusion.at(x)))
        error = max(float(np.abs(a - b).max() / (np.abs(a).max() or 1.0)) for a, b in pairs)
    yield _told(error < SAME_FIELD, Remark("workflow.field", {"error": error}))


def _verdict(one: Mapping[str, Any] | None, other: Mapping[str, Any] | None) -> Iterator[Finding]:
    """The certificate, and whether each of its tests passed."""
    if one is None or other is None:
        yield _open("certificate")
        return
    passed = [{name: test["passed"] for name, test in each["tests"].items()} for each in (one, other)]
    tests = sorted(name for name in {*passed[0], *passed[1]} if passed[0].get(name) != passed[1].get(name))
    holds = one["certified"] == other["certified"] and not tests
    values = {"certified": one["certified"], "again": other["certified"], "tests": ", ".join(tests)}
    yield _told(holds, Remark("workflow.verdict", values))


def _formula(number: int, well: Well, dynamics: Dynamics, x: np.ndarray) -> Iterator[Finding]:
    """Residual and branch of V, by derivatives of what is stored."""
    if x.shape[1] != dynamics.dimension:
        yield _open("residual")
        return
    potential, symbols = well.to_sympy(), dynamics.symbols
    values = compile_formulas([potential, *(potential.diff(each) for each in symbols)], symbols)
    # Where V rises along the ray from the attractor: recorded states of other wells are left out.
    along = [values((well.attractor + share * (x - well.attractor)).T) for share in (0.25, 0.5, 0.75, 1.0)]
    rising = np.all(np.diff([0 * along[0][0], *(one[0] for one in along)], axis=0) > 0, axis=0)
    near = rising & (along[-1][0] < 0.9 * well.level)
    if near.any():
        y, p = x[near], along[-1][1:, near].T
        pushed = np.einsum("ni,nij,nj->n", p, dynamics.diffusion.at(y), p)
        carried = np.einsum("ni,ni->n", dynamics.drift(y), p)
        residual = float(np.quantile(np.abs(carried + pushed) / (np.abs(carried) + pushed), 0.95))
        holds, limits = residual <= well.tolerance, {"count": int(near.sum()), "limit": well.tolerance}
        yield _told(holds, Remark("workflow.residual", {"well": number, "residual": residual, **limits}))
    place, at_rest = well.attractor[None], dict(zip(symbols, well.attractor, strict=True))
    curvature = np.array(sympy.hessian(potential, symbols).xreplace(at_rest), dtype=float)
    flow = dynamics.jacobian(place)[0] + 2 * dynamics.diffusion.at(place)[0] @ curvature
    yield _told(bool((np.linalg.eigvals(flow).real > 0).all()), Remark("workflow.branch", {"well": number}))


def _barrier(landscape: Landscape | None, x: np.ndarray) -> Iterator[Finding]:
    """The lowest barrier by another method: a quadrature, a mesh over the states, the action of its path."""
    ways = () if landscape is None else landscape.transitions
    known = [way for way in ways if np.isfinite(way.barrier) and way.cycle is None]
    way = min(known, key=lambda one: one.barrier, default=None)
    if landscape is None or way is None or not landscape.dynamics.diffusion.regular:
        yield _open("barrier")
        return
    dynamics, start = landscape.dynamics, landscape.attractors[way.start].position
    other, method = np.nan, "mesh"
    if dynamics.dimension == 1:
        other, method = _action(dynamics, np.linspace(start, way.place, 10 * STATES)), "quadrature"
    elif dynamics.dimension == 2:
        low, high = np.minimum(x.min(axis=0), way.place), np.maximum(x.max(axis=0), way.place)
        box = np.stack([low - 0.1 * (high - low), high + 0.1 * (high - low)], axis=1)
        nodes, needed = 0, NODES
        while nodes < needed <= MOST_NODES:
            nodes = needed
            try:
                mesh = mesh_quasipotential(
                    dynamics.drift, start, hessian=hessian_at(dynamics, start), box=box,
                    shape=(nodes, nodes), diffusion=dynamics.diffusion, stop_at_boundary=False,
                )  # fmt: skip
            except (ValueError, NumericalFailure):  # too coarse for this start, or D none everywhere
                break
            needed = int(NODES_OF_TURNING * 2 * (mesh.reach - STRAIGHT_REACH))
            other = float(2 * mesh.evaluate(way.place[None])[0]) if needed <= nodes else np.nan
    elif way.path is not None:
        other, method = _action(dynamics, way.path.points), "path"
    if not np.isfinite(other):
        yield _open("barrier")
        return
    values = {"start": way.start, "barrier": way.barrier, "other": other, "method": method}
    yield _told(abs(other - way.barrier) <= AGREEMENT * way.barrier, Remark("workflow.barrier", values))


def _action(dynamics: Dynamics, points: np.ndarray) -> float:
    """U along a chain of states, the geometric action ``∫ (|f| |dx| - f·dx)`` in the metric of D⁻¹."""
    middle, step = (points[1:] + points[:-1]) / 2, np.diff(points, axis=0)
    inverse, f = np.linalg.inv(dynamics.diffusion.at(middle)), dynamics.drift(middle)
    f_f, s_s, f_s = (np.einsum("ni,nij,nj->n", a, inverse, b) for a, b in ((f, f), (step, step), (f, step)))
    return float((np.sqrt(f_f * s_s) - f_s).sum())
