"""Whether results are what they say: their files by digests, their numbers derived again from the recordings.

The files are compared with ``provenance.jsonl``, in which each step has written what it read and made. Then
the trajectories are drawn from the recordings again, f and D identified, and the certificate computed, by the
steps that the study names. What the formulas claim is judged by other means than those that found them: the
residual of ``f·p + p·Dp = 0``, p = ∇V, by derivatives of the stored formula; the branch by the flow ``f +
2Dp``, which has to lead away from the attractor; and a barrier by a quadrature, a mesh, or the action of the
stored path.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import sympy

from siq.data.recordings import Recordings, read_recordings
from siq.errors import InputError, NumericalFailure
from siq.inference.field_estimate import read_field
from siq.numerics.files import given_path
from siq.quasipotential.formulas import read_model
from siq.quasipotential.landscape import Landscape
from siq.quasipotential.landscape_assembly import EquationSettings, landscape_from_equations
from siq.quasipotential.landscape_files import read_landscape
from siq.remarks import Remark
from siq.systems.cards import load_system
from siq.systems.dynamics import Dynamics
from siq.systems.equilibria import hessian_at
from siq.systems.formulas import compile_formulas
from siq.validation.mesh import mesh_quasipotential
from siq.workflow.answers import UNRECORDED, Provenance
from siq.workflow.pipeline import draw_run, identify_run, refine_run, source_of
from siq.workflow.study import PipelineSettings, Study, settings_of
from siq.workflow.tables import Method, Outcome, Step, StepResult
from siq.workflow.training import not_trained

Finding = tuple[Literal["agrees", "differs", "open"], Remark]
"""What was found of one claim: it holds, it does not, or it could not be derived again."""

SAME_FIELD = 1e-6  # of the size of f: another machine may round otherwise, and a search then ends elsewhere
AGREEMENT = 0.05  # of a barrier: as far as a formula is believed whose residual is within its tolerance
NODES = 200  # of the mesh along a state: errors of a per cent, in seconds
STATES = 2000  # at which a residual is judged


def verify(result: str | Path) -> Iterator[Finding]:
    """Derive again what a page claims.

    Parameters
    ----------
    result
        ``results/NAME``, or the page in it.

    Yields
    ------
    tuple
        ``"agrees"``, ``"differs"`` or ``"open"``, and what was found, in the order in which it is.

    Raises
    ------
    InputError
        Where there are no results, or the steps that made them wrote no provenance.
    """
    folder = given_path(result)
    folder = folder.parent if folder.is_file() else folder
    kept = Provenance(folder)
    if not kept.file.is_file():
        fault = "there are no results" if not folder.is_dir() else f"there is no {kept.file.name} in it"
        raise InputError(folder, "", fault, "name a folder in results, or make the results again")
    found = list(_files(kept))
    yield from found
    jobs = list(kept.made.values())
    said = next((job for job in jobs if "study" in job), None)
    if said is None:
        yield "open", Remark("workflow.not_derived", {"what": "the diagnosis: its search is not made again"})
    elif not _stopped(found):
        study = Study.model_validate(said["study"])
        card = _source(kept, ("score", "equations", "draw", "page"), (".yaml", ".yml"))
        if study.entrance == "equations":
            yield from _of_equations(study, card, folder)
        else:
            yield from _of_trajectories(study, card, kept)
    else:
        yield "open", Remark("workflow.not_derived", {"what": "the numbers: the files are not as they were"})
    yield "open", Remark("workflow.page_by_digest")
    yield "open", Remark("workflow.source_gone_on")


def _stopped(found: list[Finding]) -> bool:
    return any(kind == "differs" for kind, _ in found)


def _files(kept: Provenance) -> Iterator[Finding]:
    """The files against their digests, and every digest that a step read against the one that was made."""
    before = True
    if kept.broken:
        before = False
        yield "differs", Remark("workflow.broken_lines", {"count": kept.broken, "file": str(kept.file)})
    for path in kept.changed():
        before = False
        yield "differs", Remark("workflow.file_changed", {"file": str(kept.folder / path)})
    folders = {path for path in kept.made if (kept.folder / path).is_dir()}
    for file in sorted(kept.folder.rglob("*")):
        place = file.relative_to(kept.folder)
        inside = folders & {each.as_posix() for each in place.parents}
        known = inside or place.as_posix() in kept.made or file.name in UNRECORDED
        if file.is_file() and not known and place.parts[0] not in ("logs", "benchmarks"):
            before = False
            yield "differs", Remark("workflow.file_unknown", {"file": str(file)})
    outside: dict[str, str] = {}
    for path, job in kept.made.items():
        for source, digest in job["inputs"].items():
            if source not in kept.made:
                outside[source] = digest
            elif kept.made[source]["outputs"][source] != digest:
                before = False
                yield "differs", Remark("workflow.file_older", {"file": path, "source": source})
    for source, digest in outside.items():
        place = kept.folder / source
        now = kept.digest_of(place)
        if now != digest:
            before = False
            code = "workflow.source_missing" if now is None else "workflow.source_changed"
            yield "differs" if now else "open", Remark(code, {"file": str(place.resolve())})
    if before:
        yield "agrees", Remark("workflow.files_as_made", {"count": len(kept.made)})


def _source(kept: Provenance, tasks: tuple[str, ...], suffixes: tuple[str, ...] | None) -> Path | None:
    """A file from outside that a step of these names has read."""
    for task in tasks:
        for job in kept.made.values():
            if job["task"] == task:
                for source in job["inputs"]:
                    if source not in kept.made and (suffixes is None or source.endswith(suffixes)):
                        return kept.folder / source
    return None


def _of_trajectories(study: Study, card: Path | None, kept: Provenance) -> Iterator[Finding]:
    """Trajectories, f, formulas, verdict and barrier of a run that has them."""
    system = None if study.system is None or card is None else load_system(card)
    settings = settings_of(study, system)
    run = next((run for run in range(study.runs) if _any_formula(kept.folder, run)), 0)
    place = kept.folder / "runs" / f"{run:03d}"
    file = card if study.recordings is None else _source(kept, ("draw",), None)
    recordings = read_recordings(place / "recordings.parquet")
    if file is None or not file.exists():
        yield "open", Remark("workflow.not_derived", {"what": "the trajectories: their source is not there"})
    else:
        drawn = draw_run(settings, source_of(file, settings), number=run).result
        same = drawn is not None and _same_trajectories(drawn, recordings)
        values = {"run": run, "source": file.name}
        code = "workflow.recordings_drawn" if same else "workflow.recordings_differ"
        yield "agrees" if same else "differs", Remark(code, values)
    record = read_field(place / "vector_field.json")
    again = identify_run(settings, recordings, number=run)
    if record is None or again.result is None:
        yield "open", Remark("workflow.not_derived", {"what": "f: none was identified"})
        return
    error = _difference(record.dynamics, again.result.dynamics, recordings)
    code = "workflow.field_derived" if error < SAME_FIELD else "workflow.field_differs"
    yield "agrees" if error < SAME_FIELD else "differs", Remark(code, {"error": error})
    formulas, certificates = read_model(place / "model.json")
    if study.training is not None:
        yield (
            "open",
            Remark("workflow.not_derived", {"what": "networks, and the certificate that they are part of"}),
        )
    else:
        identified = StepResult(record, Outcome(run, Step.IDENTIFY))
        refined = refine_run(settings, recordings, identified, not_trained(run))
        yield from _verdict(certificates, refined.certificates)
    yield from _formulas(formulas, record.dynamics, recordings)
    stored = place / "quasipotential.json"
    if stored.is_file() and stored.stat().st_size:
        yield from _barrier(read_landscape(stored, dynamics=record.dynamics), recordings)


def _any_formula(folder: Path, run: int) -> bool:
    file = folder / "runs" / f"{run:03d}" / "model.json"
    return file.is_file() and bool(read_model(file)[0])


def _same_trajectories(one: Recordings, other: Recordings) -> bool:
    return (
        one.names == other.names
        and np.array_equal(one.t, other.t)
        and np.array_equal(one.values, other.values)
    )


def _difference(one: Dynamics, other: Dynamics, recordings: Recordings) -> float:
    """The largest difference of f and of D at recorded states, as a share of the largest there."""
    x = recordings.values[:: max(1, len(recordings.values) // STATES)]
    if x.shape[1] != one.dimension or one.dimension != other.dimension:
        return 0.0 if [str(f) for f in one.formulas] == [str(f) for f in other.formulas] else np.inf
    pairs = [(one.drift(x), other.drift(x)), (one.diffusion.at(x), other.diffusion.at(x))]
    return max(float(np.abs(a - b).max() / max(np.abs(a).max(), 1e-300)) for a, b in pairs)


def _verdict(stored: dict[str, Any], again: Any) -> Iterator[Finding]:
    """The certificate of the refined formula, and each of its tests."""
    if Method.REFINED not in stored or Method.REFINED not in again:
        yield "open", Remark("workflow.not_derived", {"what": "the certificate: there is no refined formula"})
        return
    one, other = stored[Method.REFINED], again[Method.REFINED]
    tests = [
        name for name in sorted({*one["tests"], *other["tests"]})
        if one["tests"].get(name, {}).get("passed") != other["tests"].get(name, {}).get("passed")
    ]  # fmt: skip
    if one["certified"] == other["certified"] and not tests:
        yield "agrees", Remark("workflow.verdict_derived", {"certified": one["certified"]})
    else:
        values = {"certified": one["certified"], "again": other["certified"], "tests": ", ".join(tests)}
        yield "differs", Remark("workflow.verdict_differs", values)


def _formulas(formulas: dict[str, Any], dynamics: Dynamics, recordings: Recordings) -> Iterator[Finding]:
    """Residual and branch of V of every refined formula, by derivatives of what is stored."""
    refined = formulas.get(Method.REFINED)
    if refined is None:
        yield (
            "open",
            Remark("workflow.not_derived", {"what": "residual and branch: there is no refined formula"}),
        )
        return
    x = recordings.values[:: max(1, len(recordings.values) // STATES)]
    for number, well in enumerate(refined.wells):
        yield from _formula(f"well {number}", well.to_sympy(), well, dynamics, x)


def _formula(
    of: str, potential: sympy.Expr, well: Any, dynamics: Dynamics, x: np.ndarray
) -> Iterator[Finding]:
    gradient = [potential.diff(each) for each in dynamics.symbols]
    values = compile_formulas([potential, *gradient], dynamics.symbols)
    if x.shape[1] != dynamics.dimension:
        yield (
            "open",
            Remark("workflow.not_derived", {"what": f"residual of {of}: not all states are recorded"}),
        )
        return
    # About the attractor to the level, where V rises along every ray: recorded states of other wells are out.
    at = values(np.ascontiguousarray(x.T))
    rays = [
        values(np.ascontiguousarray((well.attractor + s * (x - well.attractor)).T))[0]
        for s in (0.25, 0.5, 0.75)
    ]
    rising = np.all(np.diff([0 * at[0], *rays, at[0]], axis=0) > 0, axis=0)
    near = rising & (at[0] < 0.9 * well.level)
    if near.any():
        y, p = x[near], at[1:, near].T
        pushed = np.einsum("ni,nij,nj->n", p, dynamics.diffusion.at(y), p)
        along = np.einsum("ni,ni->n", dynamics.drift(y), p)
        residual = float(np.quantile(np.abs(along + pushed) / (np.abs(along) + pushed), 0.95))
        values_of = {"of": of, "residual": residual, "points": int(near.sum()), "tolerance": well.tolerance}
        solves = residual <= well.tolerance
        yield (
            "agrees" if solves else "differs",
            Remark("workflow.formula_solves" if solves else "workflow.formula_fails", values_of),
        )
    at_rest = dict(zip(dynamics.symbols, well.attractor, strict=True))
    curvature = np.array(sympy.hessian(potential, dynamics.symbols).xreplace(at_rest), dtype=float)
    place = well.attractor[None]
    flow = dynamics.jacobian(place)[0] + 2 * dynamics.diffusion.at(place)[0] @ curvature
    right = bool((np.linalg.eigvals(flow).real > 0).all())
    yield (
        "agrees" if right else "differs",
        Remark("workflow.branch_right" if right else "workflow.branch_wrong", {"of": of}),
    )


def _barrier(landscape: Landscape | None, recordings: Recordings | None) -> Iterator[Finding]:
    """The lowest barrier by another method: a quadrature, a mesh, or the action of the stored path."""
    ways = [] if landscape is None else [one for one in landscape.transitions if np.isfinite(one.barrier)]
    if landscape is None or not ways:
        yield "open", Remark("workflow.not_derived", {"what": "a barrier: none is claimed"})
        return
    way = min(ways, key=lambda one: one.barrier)
    dynamics = landscape.dynamics
    start = landscape.attractors[way.start].position if not way.from_cycle else None
    if start is None or not dynamics.diffusion.regular:
        what = "a barrier: from a cycle, or with a singular D, there is no second method"
        yield "open", Remark("workflow.not_derived", {"what": what})
        return
    if dynamics.dimension == 1:
        other, method = _by_quadrature(dynamics, start, way.place), "by a quadrature of -2f/D"
    elif dynamics.dimension == 2:
        region = dynamics.box if recordings is None else _box(recordings.values, way.place)
        other, method = _by_mesh(dynamics, start, way.place, region), "on a mesh"
    elif way.path is not None:
        other, method = _action(dynamics, way.path.points), "by the action of its path"
    else:
        yield "open", Remark("workflow.not_derived", {"what": "a barrier: its path is not stored"})
        return
    values = {"start": way.start, "barrier": way.barrier, "other": other, "method": method}
    agrees = abs(other - way.barrier) <= AGREEMENT * abs(way.barrier)
    yield (
        "agrees" if agrees else "differs",
        Remark("workflow.barrier_agrees" if agrees else "workflow.barrier_differs", values),
    )


def _box(x: np.ndarray, place: np.ndarray) -> np.ndarray:
    low, high = np.minimum(x.min(axis=0), place), np.maximum(x.max(axis=0), place)
    return np.stack([low - 0.1 * (high - low), high + 0.1 * (high - low)], axis=1)


def _by_quadrature(dynamics: Dynamics, start: np.ndarray, end: np.ndarray) -> float:
    """``∫ -2f/D dx`` of one state, by Gauss's rule."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    half = (end - start) / 2
    x = (start + end) / 2 + half * nodes[:, None]
    return float(-2 * half[0] * weights @ (dynamics.drift(x)[:, 0] / dynamics.diffusion.at(x)[:, 0, 0]))


def _by_mesh(dynamics: Dynamics, start: np.ndarray, end: np.ndarray, box: np.ndarray) -> float:
    """U of a state by ordered line integrals, see `siq.validation.mesh`; NaN where it ends before."""
    try:
        mesh = mesh_quasipotential(
            dynamics.drift, start, hessian=hessian_at(dynamics, start), box=box, shape=(NODES, NODES),
            diffusion=dynamics.diffusion, stop_at_boundary=False,
        )  # fmt: skip
    except (ValueError, NumericalFailure):
        return np.nan
    return float(2 * mesh.evaluate(end[None])[0])


def _action(dynamics: Dynamics, points: np.ndarray) -> float:
    """The geometric action ``∫ (|f| |dx| - f·dx)`` of U of a chain of states, in the metric of D⁻¹."""
    middle, step = (points[1:] + points[:-1]) / 2, np.diff(points, axis=0)
    inverse, f = np.linalg.inv(dynamics.diffusion.at(middle)), dynamics.drift(middle)

    def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.einsum("ni,nij,nj->n", one, inverse, other)

    return float((np.sqrt(product(f, f) * product(step, step)) - product(f, step)).sum())


def _of_equations(study: Study, card: Path | None, folder: Path) -> Iterator[Finding]:
    """The landscape of the equations found again, and a barrier by another method."""
    if card is None or not card.is_file():
        yield "open", Remark("workflow.not_derived", {"what": "the landscape: the card is not there"})
        return
    system = load_system(card)
    settings: PipelineSettings = settings_of(study, system)
    stored = read_landscape(folder / "quasipotential.json", dynamics=system)
    if stored is None or settings.landscape is None:
        yield "open", Remark("workflow.not_derived", {"what": "the landscape: none was found"})
        return
    own = EquationSettings(settings.seed, settings.refinement, settings.certificate, settings.landscape)
    again = landscape_from_equations(system, own)
    pairs = [(one.certificate.as_data() if one.certificate else None) for one in (stored, again)]
    if None not in pairs:
        yield from _verdict({Method.REFINED: pairs[0]}, {Method.REFINED: pairs[1]})
    for number, well in enumerate(stored.wells):
        if well is not None:
            yield from _formula(f"well {number}", well.to_sympy(), well, system, well.points)
    yield from _barrier(stored, None)
