"""What has a run to refine V by: f, states, held-out recordings, and the phase portrait?"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from siq.certificate.certificates import Certificate
from siq.certificate.certify import certify_formulas
from siq.certificate.certify_wells import certify_wells
from siq.certificate.characteristics import Reference, references_about
from siq.certificate.descent import FEWEST, MOST_PAIRS
from siq.certificate.held_out import HeldOut
from siq.certificate.regions import basin_region
from siq.certificate.tests import CertificateOptions, Verdict
from siq.data.held_out import held_out_recordings
from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.dynamics.phase_portrait import PhasePortrait, evenly_spread, phase_portrait
from siq.errors import NumericalFailure
from siq.identify.filtered_states import filtered_recordings, of_all_states
from siq.identify.identified_field import IdentifiedField
from siq.identify.lagged_pairs import coarse_pairs
from siq.identify.storage import FieldRecord
from siq.landscape.dwell_times import NoiseStrength
from siq.landscape.record_test import RecordTest, record_test
from siq.networks.trained import TrainedNetworks
from siq.numerics.randomness import Purpose, generator
from siq.potential.refinement import Refined, RefinementOptions
from siq.potential.symbolic import SymbolicDecomposition
from siq.steps.settings import Sampling


class Ground:
    """What a run has to go by: f, states, V of networks where there is one, and the phase portrait.

    Attributes
    ----------
    points, held_out
        States on which formulas are sought, of recordings that take part; and of those that are held out the
        states, and pairs of samples, on which they are tested.
    options
        How V is refined, with the routes that there are.
    limits
        Of the tests of V.
    portrait
        Attractors of f, saddles, and what leads to them.
    """

    def __init__(
        self,
        recordings: Recordings,
        record: FieldRecord,
        networks: TrainedNetworks | None,
        *,
        number: int,
        seed: int,
        sampling: Sampling,
        refinement: RefinementOptions,
        certificate: CertificateOptions,
    ) -> None:
        self.record, self.networks = record, networks
        self.found: IdentifiedField = record.found
        self.number, self.seed, self.limits = number, seed, certificate
        self.options = refinement.with_routes(networks=networks is not None)
        draw = generator(seed, number, Purpose.HOLD_OUT)
        mask = held_out_recordings(recordings, generator=draw)
        if (sensor := record.sensor_variance) is not None:
            # Of measured values the increments do not have the mean of f.
            recordings = filtered_recordings(
                self.found,
                sensor,
                recordings,
                pair_step=sampling.pair_step,
                exposure=record.exposure,
            )
        elif record.hidden_velocities:
            recordings = of_all_states(recordings, record, pair_step=sampling.pair_step)
        pairs = snapshot_pairs(recordings, pair_step=sampling.pair_step)
        held, x = mask[pairs.recording], pairs.x0
        draw = generator(seed, number, Purpose.REFINE)
        self.points = x[~held][evenly_spread(x[~held], generator=draw)]
        unseen = x[held][evenly_spread(x[held], generator=draw)]
        if (memory := record.memory) is not None:
            pairs = coarse_pairs(recordings, memory[0], lost=memory[1])
        self.portrait: PhasePortrait = phase_portrait(self.found.dynamics, self.points, seed=self.number)
        if not self.found.noise_free:
            mask = every_well_held_out(self.portrait, pairs, mask)
        self.held_out = HeldOut(unseen, pairs.take(mask[pairs.recording]))
        self.recordings, self.unseen = recordings, mask

    @cached_property
    def references(self) -> tuple[Reference, ...]:
        """V by characteristics about every attractor: the same for all formulas of the run."""
        return references_about(self.found.dynamics, self.portrait, seed=self.number)

    def network(self, x: np.ndarray) -> np.ndarray:
        """V_θ at points."""
        assert self.networks is not None
        return self.networks.evaluate(x).potential

    def certify(self, formulas: SymbolicDecomposition, **details: Any) -> Certificate:
        """Certificate of one formula for the region."""
        return certify_formulas(
            formulas,
            self.found,
            self.portrait,
            self.held_out,
            options=self.limits,
            prediction=self.prediction(),
            references=self.references,
            seed=self.number,
            **details,
        )

    def certify_wells(self, refined: Refined, *, compared: bool) -> Certificate:
        """Certificate of one formula for each attractor."""
        return certify_wells(
            refined,
            self.portrait,
            self.held_out,
            options=self.limits,
            prediction=self.prediction(),
            references=self.references,
            compared=compared,
            seed=self.number,
        )

    def record_test(self) -> RecordTest:
        """What f says of the record's own hops and histogram, beside what is counted on it."""
        shown = self.record.noise_strength
        noise = None if shown is None else NoiseStrength(*shown, source="estimated")
        variance = self.record.sensor_variance
        try:
            return record_test(
                self.found, self.portrait, noise, self.recordings, self.unseen,
                sensor=None if variance is None else np.sqrt(variance), seed=self.number,
            )  # fmt: skip
        except (NumericalFailure, np.linalg.LinAlgError) as error:
            return RecordTest(missing=str(error))

    def prediction(self) -> Verdict:
        """The verdict on f, from its identification."""
        kept = dict(self.record.prediction)
        kept["value"] = np.inf if kept["value"] is None else kept["value"]
        return Verdict(**kept)


def every_well_held_out(portrait: PhasePortrait, pairs: SnapshotPairs, mask: np.ndarray) -> np.ndarray:
    """Held-out recordings, more of them where those that there are never come into some well.

    Recordings under noise may stay in one well for good, and the test of motion in another would have nothing
    to go by. They are chosen by where they are, not by where they go: the fit of V knows no increments.

    Parameters
    ----------
    portrait
        Attractors with their basins.
    pairs
        Of all recordings.
    mask
        Which recordings are held out, shape ``(r,)``.
    """
    mask = mask.copy()
    some = pairs.take(np.arange(0, len(pairs.h), max(len(pairs.h) // MOST_PAIRS, 1)))
    for index in range(len(portrait.attractors)):
        there = some.recording[basin_region(portrait, index).recorded(some.x0)]
        counts = np.bincount(there, minlength=len(mask))
        while counts[mask].sum() < FEWEST and counts[~mask].any():
            mask[int(np.argmax(np.where(mask, -1, counts)))] = True
    return mask
