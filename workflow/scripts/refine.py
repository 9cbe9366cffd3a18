"""Refine the formulas of a run, and certify them beside those of the regression."""

from typing import Any

import numpy as np

from siq.certificate import CertificateOptions, Verdict
from siq.certification import (
    Certificate,
    caustic_notes,
    certify_formulas,
    certify_potential,
    certify_wells,
    uncertified,
)
from siq.decomposition.trained import load_networks, shuffled
from siq.errors import NumericalFailure
from siq.field_file import read_field
from siq.global_route import fit_values
from siq.held_out import held_out_recordings
from siq.library import joint_library
from siq.model import model_to_data, read_model, write_model
from siq.outline import Outline, evenly_spread, outline
from siq.randomness import generator
from siq.recordings import snapshot_pairs
from siq.refined_formulas import refined_decomposition, relative_error_of
from siq.refinement import RefinementOptions, refine
from siq.regression import RegressionOptions, points_below
from siq.symbolic import SymbolicDecomposition, term_coefficients
from siq.systems import diffusion_matrix
from step import CONTROL, job, outcome, pair_step, position_of, read_outcomes, read_run, write_outcomes


class Run:
    """What a run has to go by: states, networks, f, and the outline that follows."""

    def __init__(self, source: Any, position: int | None, run: int, study: dict[str, Any]) -> None:
        recordings = read_run(source.recordings)
        record = read_field(source.field)
        assert recordings is not None and record is not None  # checked by the steps before
        self.record, self.study, self.run = record, study, run
        self.diffusion = diffusion_matrix(study["metric"]["diffusion"], len(recordings.names))
        self.regression = RegressionOptions(**study["regression"])
        self.networks = None if position is None else load_networks(source.networks, run=position)
        self.names = recordings.names
        mask = held_out_recordings(recordings, generator=generator(study["seed"], run, "hold out"))
        pairs = snapshot_pairs(recordings, pair_step=pair_step(study))
        held, x = mask[pairs.recording], pairs.x0
        draw = generator(study["seed"], run, "refine")
        points = x[~held][evenly_spread(x[~held], generator=draw)]
        unseen = x[held][evenly_spread(x[held], generator=draw)]
        everywhere = points
        if self.networks is not None:  # the region in which the regression sought its formulas
            potential = self.network(points)
            below = points_below(potential, level=self.regression.level)
            lower = self.network(unseen) < potential.min() + self.regression.level
            # Networks that know nothing may leave too few for any formula: then every state is asked for.
            if below.sum() > 2 * record.found.library.size and lower.any():
                points, unseen = points[below], unseen[lower]
        self.below, self.unseen = points, unseen
        self.outline: Outline = outline(record.found.field, everywhere, diffusion=self.diffusion, seed=run)

    def network(self, x: np.ndarray) -> np.ndarray:
        """V_θ at points."""
        assert self.networks is not None
        return self.networks.evaluate(x).potential

    def certify(self, formulas: SymbolicDecomposition, **details: Any) -> Certificate:
        """Certificate of one formula for the region."""
        return certify_formulas(
            formulas,
            self.record.found,
            self.outline,
            self.unseen,
            diffusion=self.diffusion,
            options=CertificateOptions(**self.study["certificate"]),
            prediction=self.prediction(),
            seed=self.run,
            **details,
        )

    def prediction(self) -> Verdict:
        """The verdict on f, from its identification."""
        kept = dict(self.record.prediction)
        kept["value"] = np.inf if kept["value"] is None else kept["value"]
        return Verdict(**kept)


def refine_run(
    own: Run, regressed: SymbolicDecomposition | None
) -> tuple[SymbolicDecomposition, Certificate, tuple[str, ...]]:
    """Refined formulas of a run with their certificate, and what could not be done."""
    library = joint_library(
        own.record.found.library,
        degree=own.regression.degree,
        potential_degree=own.regression.potential_degree or own.regression.degree,
        further=own.regression.functions,
    )
    formula = None
    if regressed is not None and regressed.potential is not None:
        named = term_coefficients(regressed.potential)
        formula = np.array([named.get(name, 0.0) for name in library.names])
    options = RefinementOptions(**own.study["refinement"])
    refined = refine(
        own.record.found, own.outline, library=library, formula=formula,
        network=None if own.networks is None else own.network,
        points=own.below, diffusion=own.diffusion, options=options, seed=own.run,
    )  # fmt: skip
    formulas = refined_decomposition(refined, own.below)
    if formulas.potential is not None:
        certificate = own.certify(
            formulas,
            wells=refined.wells,
            relative_error=relative_error_of(refined, own.below),
            compared=len(options.routes) == 2,
        )
    else:
        certificate = certify_wells(
            refined, own.outline, options=CertificateOptions(**own.study["certificate"]),
            prediction=own.prediction(), compared=len(options.routes) == 2, seed=own.run,
        )  # fmt: skip
    caustics = caustic_notes(refined, own.outline, certificate.error, seed=own.run)
    return formulas, certificate, (*refined.notes, *caustics)


def control(own: Run) -> Certificate:
    """Certificate of the U of a randomised network: one that must be refused, or the tests are no tests."""
    assert own.networks is not None
    networks = shuffled(own.networks, generator=generator(own.study["seed"], own.run, "shuffle"))
    library = own.record.found.library
    coefficients = fit_values(library, own.below, networks.evaluate(own.below).potential)
    return certify_potential(
        coefficients, library, own.record.found, own.outline, own.unseen, diffusion=own.diffusion,
        options=CertificateOptions(**own.study["certificate"]), prediction=own.prediction(), seed=own.run,
    )  # fmt: skip


def main(snakemake: Any) -> None:
    """Run as a rule's script."""
    run, study, source = int(snakemake.wildcards.run), snakemake.params.study, snakemake.input
    models, _ = read_model(source.model)
    certificates = {}
    identified = read_outcomes(source.identified)[0]
    position, reason = position_of(run, source.outcome)
    if identified["status"] in ("failed", "skipped"):
        result = outcome(run, "refine", "skipped", f"no vector field was identified ({identified['reason']})")
    elif position is None and "local" not in study["refinement"]["routes"]:
        result = outcome(run, "refine", "skipped", f"the training gave no networks ({reason})")
    else:
        try:
            own = Run(source, position, run, study)
            if "regression" in models:
                certificates["regression"] = own.certify(models["regression"]).as_data()
            if own.networks is not None:
                certificates[CONTROL] = control(own).as_data()
            models["refined"], certificate, notes = refine_run(own, models.get("regression"))
            certificates["refined"] = certificate.as_data() | {"notes": list(notes)}
            status = "ok" if certificate.certified else "warning"
            reason = "" if certificate.certified else f"not certified: {certificate.reason}"
            result = outcome(run, "refine", status, reason)
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            result = outcome(run, "refine", "failed", str(error))
    for method in models.keys() - certificates.keys():
        certificates[method] = uncertified(f"no test was made: {result['reason']}")
    write_model(snakemake.output.model, model_to_data(models, certificates))
    write_outcomes(snakemake.output.outcome, [result])


if __name__ == "__main__":
    with job(snakemake):  # type: ignore[name-defined]  # noqa: F821 (Snakemake puts it here)
        main(snakemake)  # type: ignore[name-defined]  # noqa: F821
