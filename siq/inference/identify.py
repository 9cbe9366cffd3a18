"""Identification: f and D of recordings, by the method that their noise asks for.

Recordings without noise, and those with white process noise alone, are a regression of pairs of samples
(`siq.inference.regression`). Where the sensors are noisy, samples are means over an exposure, or velocities
were not recorded, f is that of the largest likelihood of whole recordings
(`siq.inference.kalman_identification`). Where they are correlated for another reason, states some steps
earlier are the instruments of the regression. Which of it is the case the residuals of a first f show, and
from which lag on the recordings are Markovian.

D is as given; else as the process noise shows it, of the determinant 1, as a formula of the state where a
constant one cannot be held; else the unit matrix. Last, f is tested on held-out recordings.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy.special

from siq.data.correlation import MarkovLag, markov_lag
from siq.data.preparation import joined, repetitions, turns_back
from siq.data.recordings import Recordings, SnapshotPairs, snapshot_pairs
from siq.data.stationarity import usual_step
from siq.errors import NumericalFailure
from siq.inference.checks import (
    STATE_BINS,
    UNDECIDED,
    PredictionLimits,
    bias_of_rounding,
    check_prediction,
    mean_residual_probability,
    neighbour_correlations,
    prediction_errors,
    residual_noise,
    rounding_text,
    sensor_law,
    simulation_step,
    unexplained_probability,
)
from siq.inference.claims import check_claims
from siq.inference.diffusion_model import (
    ResidualLikelihood,
    check_units,
    constant_noise,
    estimated_diffusion,
    process_noise_increments,
    with_process_noise_rate,
)
from siq.inference.field_estimate import (
    HARMLESS_BIAS,
    HARMLESS_CORRELATION,
    DiffusionSource,
    FieldEstimate,
    NoiseDiagnosis,
)
from siq.inference.kalman_filter import Noise
from siq.inference.kalman_identification import (
    filtered_recordings,
    held_out_innovations,
    identify_by_likelihood,
)
from siq.inference.library import CandidateLibrary, IdentificationOptions, field_library
from siq.inference.measurements import Measurements
from siq.inference.observation import INTERVAL, ObservationModel, inertia_test, moved_by, velocity_names
from siq.inference.regression import (
    carries_noise,
    identify_vector_field,
    lagged_pairs,
    lost_time,
    refit,
    residuals,
    with_noise_formula,
    with_stability,
)
from siq.inference.transition_densities import Transitions
from siq.numerics.randomness import Purpose, positive
from siq.remarks import Remark, sentence
from siq.systems.diffusion import Diffusion
from siq.systems.formulas import compile_formulas

SUSPECT_SCORE = -1.0  # standard errors of the correlation of neighbouring residuals
SENSOR_SHARE = 0.1  # of what means move by: a search finds its way down to no sensor noise, but not up
MIN_SHARE, MAX_SHARE = 1e-3, 0.45  # of the residuals' variance: a sensor's share that a fit begins with
WHOLE_STEP_TOLERANCE = 0.05  # of an exposure, as exactly as residuals show it of some thousand samples
SINGULAR = "the recordings do not determine f; record more, or more often"
PREDICTED_RECORDINGS = 200  # held-out ones that are predicted: enough for a median
THINNED = (2, 4, 8, 16)  # of how many samples one is used, where neighbours share more than the state
MAX_STEP_RATE = 0.4  # of hidden velocities, times the step; there Duffing's noise is found 2 % too strong
BLURRED = 0.6  # the same at most: at 0.85 Duffing's barrier was 11 % too low, 3.6 errors of 20,000 samples
OF_SENSOR = ("measurement", "measurement_error", "sensor_evidence", "exposure", "sensor_law")


def identify(
    recordings: Recordings, *, options: IdentificationOptions,
    draw: Callable[[Purpose], np.random.Generator], diffusion: Diffusion | None = None,
    units: Sequence[str | None] = (), pair_step: float | None = None, integrator_step: float | None = None,
    limits: PredictionLimits | None = None,
) -> FieldEstimate:  # fmt: skip
    """f and D of recordings, with their errors, the noise that is in the recordings, and the test of f.

    Parameters
    ----------
    recordings, options
        Whole trajectories; and the candidate functions of f, what makes a term significant, and whether
        velocities are hidden. Where that is left open they are if f of the position alone is refuted by its
        inertia. How else samples show the states, measurement noise and correlations in them say.
    draw
        Gives the generator for a purpose: for held-out recordings, and for resampling.
    diffusion, units
        D, where it is given; and the states' units, None where unknown, by default those of the recordings.
    pair_step, integrator_step
        Longest time between samples that belong together; step of an Euler–Maruyama simulation, else None.
    limits
        Of the test of f.

    Raises
    ------
    NumericalFailure
        When there is no f, with the reason, and what would help.
    """
    hidden, names = options.hidden_velocities is True, recordings.names
    library = field_library((*names, *velocity_names(names)) if hidden else names, options)
    case = _Case(
        recordings, library, options, draw, diffusion, units or recordings.units, pair_step, integrator_step,
        limits or PredictionLimits(),
    )  # fmt: skip
    # Without a velocity what turns back is moved by noise that a sensor's hides from sample to sample.
    turning = options.hidden_velocities == "auto" and diffusion is None and turns_back(recordings)
    if turning and (by_velocities := case.with_velocities()) is not None:
        return by_velocities
    try:
        if not hidden:
            found = case.identified()
        elif diffusion is None:
            found = case.with_hidden_states()
        else:
            raise NumericalFailure(
                "D is given for the positions, and noise drives the hidden velocities; leave the"
                " diffusion out, it is found"
            )
        assert found.prediction is not None
        if not hidden and (found.memory is not None or not found.prediction.passed):
            # A position alone is refused where its recordings are correlated since it has inertia.
            advice = case.advice(hidden=False)
            if advice is not None:
                if (by_velocities := case.with_velocities()) is not None:
                    return by_velocities
                reason = "; ".join(one for one in (found.prediction.reason, advice) if one)
                found = replace(found, prediction=replace(found.prediction, passed=False, reason=reason))
        asked = not hidden and len(names) == 1 and not found.slow_sensor and not case.complete(found)
        by_slow_noise = case.with_slow_noise() if asked else None
        return by_slow_noise or (found if hidden else case.with_parts(found))
    except (NumericalFailure, np.linalg.LinAlgError) as error:
        reason, claim = (str(error), error.claim) if isinstance(error, NumericalFailure) else (SINGULAR, "")
        rounding = rounding_text(recordings, coarse=True)
        reason = reason if rounding is None else f"{reason}; mind that {rounding}"
        for column, name in enumerate(() if claim else recordings.titles):
            chance, kind, share = min(repetitions(recordings, column), default=(1.0, "", 0.0))
            if chance < case.limits.each:  # a cause, and what follows
                values = {"kind": kind, "value": share, "state": name}
                reason = f"{sentence(Remark('inference.repeated', values))}; {reason}"
                claim = "gaussian_increments"
                break
        advice = case.advice(hidden=hidden)
        if not hidden and advice is not None and (by_velocities := case.with_velocities()) is not None:
            return by_velocities
        untried = not hidden and not claim and case.memory.remembers
        if untried and (by_slow_noise := case.with_slow_noise()) is not None:
            return by_slow_noise
        raise NumericalFailure(reason if advice is None else f"{reason}; {advice}", claim=claim) from error


@dataclass
class _Case:
    """An identification of recordings; the arguments are those of `identify`."""

    recordings: Recordings
    library: CandidateLibrary
    options: IdentificationOptions
    draw: Callable[[Purpose], np.random.Generator]
    given: Diffusion | None
    units: Sequence[str | None]
    pair_step: float | None
    integrator_step: float | None
    limits: PredictionLimits

    def __post_init__(self) -> None:
        held = self.recordings.held_out(generator=self.draw(Purpose.HOLD_OUT))
        self.training = self.recordings.select(np.flatnonzero(~held))
        self.held_out = self.recordings.select(np.flatnonzero(held))

    @cached_property
    def memory(self) -> MarkovLag:
        """What the recordings remember from sample to sample."""
        return markov_lag(joined(self.recordings), angles=self.options.angles)

    def identified(self) -> FieldEstimate:
        """By the method that noise and correlations of the recordings ask for."""
        self.library.check_origin(self.recordings.values, names=self.recordings.titles)
        training, step = self._pairs(self.training), self.integrator_step
        regress = partial(identify_vector_field, self.library, options=self.options, integrator_step=step)
        if not carries_noise(self.library, training, options=self.options, integrator_step=step):
            return self._finished_by_pairs(regress(training))
        # Under noise every recording counts: all give the result, a part of them its test.
        pairs = self._pairs(self.recordings)
        if step is None and (memory := self.memory).remembers:
            exposures = _possible_exposures(memory)
            with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
                plain = regress(pairs)
                for exposure in (*exposures, None):
                    found = self.by_density(plain, pairs, exposure)
                    if found is not None and self.complete(found):
                        return found
            # A sensor's white noise was taken for an exposure, or a memory, in 2 of 36 records.
            unit, fits = Diffusion.identity(self.library.dimension), list[FieldEstimate]()
            for exposure in (*exposures, None) if memory.sensor.any() else exposures:
                found = self.by_exposure(ObservationModel(self.library, unit, exposure))
                if found is not None and self.complete(found):
                    return found
                fits += [found] if found is not None and exposure is not None else []
            return fits[0] if fits else self.by_instruments(memory)
        found = with_process_noise_rate(regress(pairs), pairs)
        by_state = None
        if found.flow.by_density and self.given is None:  # a wrong D would look like a noisy sensor
            by_state = with_noise_formula(found, pairs, false_terms=self.options.false_terms)
        if step is None and (simulated := self.as_simulated(found, by_state, pairs)) is not None:
            return simulated
        found = by_state or found
        return self.with_sensor_noise(found) or self._finished_by_pairs(found)

    def as_simulated(
        self, found: FieldEstimate, by_state: FieldEstimate | None, pairs: SnapshotPairs
    ) -> FieldEstimate | None:
        """By Euler's rule, where samples are steps of its simulation, or every second; None elsewhere."""
        asked = None
        if self.given is None and estimated_diffusion(found, pairs=len(pairs.h)) is not None:
            with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
                asked = simulation_step(found, by_state, pairs, options=self.options)
        if asked is None:
            return None
        found = replace(self, integrator_step=asked[0]).identified()
        assert found.diagnosis is not None
        values = {"step": asked[0], "unit": self.recordings.time_unit or "", "probability": asked[1]}
        values |= {"by_state": found.noise is not None}
        remarks = (*found.diagnosis.remarks, Remark("inference.simulated", values))
        return replace(found, diagnosis=replace(found.diagnosis, remarks=remarks))

    def with_sensor_noise(self, found: FieldEstimate) -> FieldEstimate | None:
        """By likelihood, where the sensors are noisy; None where they are not.

        What could be sensor noise is asked of the likelihood from one standard error on: it would bias f long
        before it is significant; of one state over coarse steps it is asked always. It is the answer where
        it is likelier than none, the share of each sensor in the variance of n residuals being uniform from 0
        to ½ beforehand, and known to ``1/√n`` (Laplace). The other answer counts in the errors, as likely as
        it is.
        """
        pairs = self._pairs(self.recordings)
        correlation, score = neighbour_correlations(found, pairs)
        rate, least = np.diag(found.noise_rate), float(correlation.min())
        variance = rate * float(np.median(pairs.h))
        measured = np.sqrt(np.maximum(-correlation, 0.0) * variance)
        suspect, count = int((score < SUSPECT_SCORE).sum()), len(pairs.h)

        def probability(again: FieldEstimate, sensors: int) -> float:
            assert again.diagnosis is not None and again.diagnosis.sensor_evidence is not None
            odds = again.diagnosis.sensor_evidence + sensors * np.log(8 * np.pi / count)
            return float(scipy.special.expit(odds / 2))

        if suspect:
            bias = bias_of_rounding(found, pairs, self.recordings, measured, correlation=least)
            if bias is not None and bias <= HARMLESS_BIAS:
                return None
        if found.flow.coarse and self.given is None:
            with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
                given = Transitions(found, pairs)
                behind = given.identified_behind_sensor(false_terms=self.options.false_terms)
                if behind is None:
                    return None
                behind = self.with_sensor_law(behind) or behind
                noisy = probability(behind, 1)
                one, other = (behind, found) if noisy > 0.5 else (found, behind)
                return self._finished_by_pairs(one).with_rival(other, min(noisy, 1 - noisy))
        if not suspect:
            return None
        # Over long steps f hides most of the correlation, and a search that begins low finds no way up.
        fault, unit = "", Diffusion.identity(self.library.dimension)
        for share in (np.clip(-correlation, MIN_SHARE, MAX_SHARE), np.full(len(rate), MAX_SHARE)):
            noise = Noise(share * variance, rate * (1 - 2 * share))
            try:
                again = self.by_likelihood(ObservationModel(self.library, unit), noise)
                noisy = probability(again, suspect)
                if noisy > 0.5:
                    again = self.with_sensor_law(again) or again
                    slow = None if again.flow.by_density else self.with_slow_noise(again)
                    return slow or self.finished(again).with_rival(found, 1 - noisy)
            except (NumericalFailure, np.linalg.LinAlgError) as error:
                fault = fault or str(error)
            else:  # a fault of the pairs is none of the sensor
                return self._finished_by_pairs(found).with_rival(again, noisy)
        chance = scipy.special.ndtr(score) * len(score)
        if not ((chance < self.limits.each) & (correlation < -HARMLESS_CORRELATION)).any():
            return None
        reason, claim = f"the sensor is noisy, and f with it is not found: {fault}", "gaussian_increments"
        tests = check_claims(found, self.recordings, self.recordings, false_alarms=self.limits.each)
        if claim not in tests or tests[claim].passed:  # of what shows no noise there are no claims
            if (slow := self.with_slow_noise()) is not None:
                return slow
            raise NumericalFailure(reason)
        raise NumericalFailure(f"{tests[claim].reason}; {reason}", claim=claim)

    def with_sensor_law(self, found: FieldEstimate) -> FieldEstimate | None:
        """An estimate whose sensors have noise that depends on what they show; None where it does not.

        It does where the recordings are likelier so, at Schwarz's price of the further parameters. Of one
        state by densities: what the size of the noise tells of the state is not linear.
        """
        pairs, known, again, gain = self._pairs(self.recordings), found.diagnosis, found, 0.0
        law = None if known is None or known.exposure is not None else sensor_law(found, pairs)
        if known is None or law is None:
            return None
        price = np.count_nonzero(law[:, 1:]) * np.log(len(pairs.h))
        with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
            if not found.flow.by_density:
                view, unit = ObservationModel.of(found), Diffusion.identity(self.library.dimension)
                noise = Noise(known.measurement**2, np.diag(found.noise_rate))
                again = self.by_likelihood(replace(view, diffusion=unit, sensor_law=law), noise)
                gain = 2 * (self._likelihood(again) - self._likelihood(found))
        plain = self.library.dimension == 1 and not self.library.angles and self.given is None
        if plain and (gain > price or found.flow.by_density):
            with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
                given, false_terms = Transitions(again, pairs), self.options.false_terms
                finer = given.identified_behind_sensor(law=law, false_terms=false_terms)
                if finer is not None and finer.diagnosis is not None:
                    gain += finer.diagnosis.sensor_evidence or 0.0
                    evidence = (known.sensor_evidence or 0.0) + gain
                    again = replace(finer, diagnosis=replace(finer.diagnosis, sensor_evidence=evidence))
        return again if gain > price else None

    def _likelihood(self, found: FieldEstimate) -> float:
        view = ObservationModel.of(found)
        data, noise = view.measured(self.recordings, self.pair_step), view.noise_of(found)
        model = view.model(*view.unknown(found))
        return view.followed(data, model, noise=noise, substeps=found.flow.steps).restricted_likelihood(data)

    def by_density(
        self, found: FieldEstimate, pairs: SnapshotPairs, exposure: float | None
    ) -> FieldEstimate | None:
        """By the densities of noisy samples, or of means over an exposure; None where that does not do.

        Of one state over coarse steps, from an estimate that takes samples for states.
        """
        if not found.flow.coarse or self.given is not None:
            return None
        with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
            given = Transitions(found, pairs)
            behind = given.identified_behind_sensor(exposure=exposure, false_terms=self.options.false_terms)
            return None if behind is None else self.finished(self.with_sensor_law(behind) or behind)
        return None

    def by_exposure(self, observation: ObservationModel) -> FieldEstimate | None:
        """By the likelihood of samples that are means over an exposure; None where they are no such means.

        They are such means if nothing is left in the innovations that neighbours share. Without an exposure
        they show the state behind measurement noise alone.
        """
        share = MAX_SHARE / 2 if observation.exposure is None else SENSOR_SHARE
        try:
            moved, step = moved_by(observation.measured(self.recordings, self.pair_step))
            found = self.by_likelihood(observation, Noise(share * moved, moved / step))
            if observation.exposure is None:
                found = self.with_sensor_law(found) or found
        except (NumericalFailure, np.linalg.LinAlgError):
            return None
        assert found.diagnosis is not None
        return None if found.diagnosis.correlated or not found.noise_rate.any() else self.finished(found)

    def by_likelihood(self, observation: ObservationModel, noise: Noise | None = None) -> FieldEstimate:
        """By the likelihood of whole recordings, beginning with a noise; of positions without any."""
        return identify_by_likelihood(
            observation, self.recordings, noise, false_terms=self.options.false_terms,
            generator=self.draw(Purpose.STABILITY), pair_step=self.pair_step,
        )  # fmt: skip

    def _pairs(self, recordings: Recordings) -> SnapshotPairs:
        return snapshot_pairs(recordings, pair_step=self.pair_step)

    def finished(self, found: FieldEstimate) -> FieldEstimate:
        """An estimate behind sensors with its D, its strength, and its test."""
        if found.flow.by_density:
            return self._finished_by_pairs(found)
        noise, pairs = found.diagnosis, len(self._pairs(self.recordings).h)
        assert noise is not None and noise.measurement_error is not None
        forced = bool(found.noise_rate.any())
        if found.hidden_states and not forced and len({unit for unit in self.units if unit}) > 1:
            raise NumericalFailure(
                "no process noise is seen that would show D, and the positions have different units, so that"
                " no unit matrix can stand for it; scale them to one unit"
            )
        remarks = [of_sensors := self._of_sensors(noise)]
        sensors = of_sensors.values["sensors"]
        if found.slow_force:
            time, slope = float(-1 / found.values[-1]), float(np.sqrt(found.covariance[-1, -1]))
            values = {
                "state": self.recordings.titles[0], "name": found.library.states[1], "time": time,
                "error": slope * time**2, "unit": self.recordings.time_unit or "", "sensors": sensors,
                "noise": bool(found.noise_rate[1, 1]),
            }  # fmt: skip
            remarks, source = [Remark("inference.slow_force", values)], DiffusionSource.ESTIMATED
        elif found.hidden_states:
            values = {"sensors": sensors, "process_noise": forced, "every": noise.thinned}
            remarks = [Remark("inference.hidden_velocities", values)]
            source = DiffusionSource.OF_VELOCITIES if forced else DiffusionSource.UNIT_OF_VELOCITIES
        else:
            first, error = found, noise.intensity_error
            found, source = self._with_diffusion(found, pairs)
            strength = found.intensity if found.noise is not None else self._strength(first, found.diffusion)
            if error is not None and noise.intensity > 0:
                error *= strength / noise.intensity
            covariance = found.noise_rate / strength if forced else noise.covariance
            noise = replace(noise, intensity=strength, intensity_error=error, covariance=covariance)
            if noise.exposure is not None:
                every = ObservationModel.of(first).every(self.recordings)
                remarks.append(self._of_exposure(noise.exposure, every))
            if first.slow_sensor is not None:
                values = dict(zip(("size", "time", "error"), first.slow_sensor, strict=True))
                values |= {"state": self.recordings.titles[0], "unit": self.recordings.time_unit or ""}
                remarks = [Remark("inference.slow_sensor", values)]
            if first.noise is not None and self.given is not None and self.given.constant:
                remarks.append(Remark("inference.noise_depends_on_state"))
        noise = replace(noise, diffusion=source, pairs=pairs, remarks=tuple(remarks))
        found = replace(found, diagnosis=noise)
        held_out = held_out_innovations(found, self.training, self.held_out, pair_step=self.pair_step)
        return self._tested(found, mean_probability=held_out[0], held_out_ratio=held_out[1])

    def _of_sensors(self, noise: NoiseDiagnosis) -> Remark:
        sizes = zip(noise.measurement, self.recordings.titles, strict=True)
        sensors = [{"size": float(size), "state": name, "along": []} for size, name in sizes]
        if noise.sensor_law is not None:
            levels = np.quantile(self.recordings.values, [0.05, 0.95], axis=0)
            along = noise.measurement * np.sqrt(Measurements.relative_variance(noise.sensor_law, levels))
            for place in np.flatnonzero(noise.sensor_law[:, 1:].any(axis=1)):
                sensors[place]["along"] = np.stack([levels, along], axis=2)[:, place].tolist()
        return Remark("inference.measurement_noise", {"sensors": sensors})

    def _of_exposure(self, exposure: float, every: int) -> Remark:
        values = {"exposure": exposure, "unit": self.recordings.time_unit or "", "every": every}
        return Remark("inference.exposure", values)

    def _strength(self, found: FieldEstimate, diffusion: Diffusion) -> float:
        """ε of another D than was found: the mean of ``tr D⁻¹(x) εD(x) / d`` over the states."""
        if diffusion.constant:
            return diffusion.intensity(found.noise_rate)
        states = filtered_recordings(found, self.recordings, pair_step=self.pair_step).values
        forces = found.noise_rate if found.noise is None else found.noise.diffusion(1.0).at(states)
        return float((diffusion.precision_at(states) * forces).sum(axis=(1, 2)).mean() / states.shape[1])

    def _with_diffusion(self, found: FieldEstimate, samples: int) -> tuple[FieldEstimate, DiffusionSource]:
        """The estimate with D, and where that is from: given, estimated of so many samples, or the unit."""
        if self.given is not None:
            given = replace(found, diffusion=self.given, noise=None, constant_noise=None)
            return given, DiffusionSource.GIVEN
        if found.noise is not None:
            return found, DiffusionSource.ESTIMATED
        estimated = estimated_diffusion(found, pairs=samples) if found.noise_rate.any() else None
        if estimated is None:
            check_units(self.recordings.names, self.units)
            return replace(found, constant_noise=None), DiffusionSource.UNIT
        own = found.constant_noise
        if own is None:
            own = constant_noise(self.library.symbols, found.noise_rate, samples=samples)
        return replace(found, diffusion=estimated, constant_noise=own), DiffusionSource.ESTIMATED

    def by_instruments(self, memory: MarkovLag) -> FieldEstimate:
        """By instruments, of recordings that are Markovian from a lag on."""
        assert memory.lag is not None
        if self.given is not None and not self.given.constant:
            raise NumericalFailure(
                "the recordings are correlated, and D is given as a function of the state: how strong"
                " correlated noise is here and there is not known; give a constant D, or leave it out"
            )
        pairs, training, unseen = (
            lagged_pairs(part, memory.lag) for part in (self.recordings, self.training, self.held_out)
        )
        found = identify_vector_field(self.library, pairs, options=self.options)
        independent = int(pairs.independent)
        found, source = self._with_diffusion(with_process_noise_rate(found, pairs), independent)
        intensity = found.diffusion.intensity(found.noise_rate)
        covariance = found.noise_rate / intensity
        whitening = found.diffusion.whitening
        state = int(np.argmax(np.abs(memory.correlations[0])))
        correlation = float(memory.correlations[0, state])
        values = {
            "kind": memory.kind, "memory": float(memory.memory), "lag": int(memory.lag),
            "time": float(memory.time), "unit": self.recordings.time_unit or "",
        }  # fmt: skip
        lost, error = lost_time(found, pairs)
        # Forces with a memory, and exposures, delay what noise does; what adds to it at once does not.
        if lost < -INTERVAL * error:
            raise NumericalFailure(
                f"the record takes back within {memory.lag} steps a part of what it moved, as where errors of"
                " its sensor last so long, and f and D of such samples are too large; keep one sample of"
                f" every {memory.lag}, so that the errors of any two are independent"
            )
        noise = NoiseDiagnosis(
            "process", intensity, covariance, correlation, correlation / float(memory.errors[0, state]),
            np.zeros(len(covariance)), pairs=independent, diffusion=source, lag=memory.lag,
            lost_time=max(lost, 0.0), remarks=(Remark("inference.correlated", values),),
        ).with_deviation(whitening @ covariance @ whitening.T, independent)  # fmt: skip
        return self._tested_by_pairs(replace(found, diagnosis=noise), training, unseen)

    def _finished_by_pairs(self, found: FieldEstimate) -> FieldEstimate:
        """An estimate by pairs with its D, the noise of its residuals, and its test.

        f does not depend on D, and whether noise is white does not either: so D can come last.
        """
        everything, training, unseen = map(self._pairs, (self.recordings, self.training, self.held_out))
        count, false_terms = len(training.h) + len(unseen.h), self.options.false_terms

        def diagnosed(found: FieldEstimate, source: DiffusionSource) -> FieldEstimate:
            noise = residual_noise(found, self.recordings, pair_step=self.pair_step)
            noise = replace(noise, diffusion=source, pairs=count)
            if (seen := found.diagnosis) is not None and noise.kind == "process":
                remarks = list(noise.remarks)
                if found.sensor_variance is not None:
                    remarks.append(self._of_sensors(seen))
                if seen.exposure is not None:
                    remarks.append(self._of_exposure(seen.exposure, 1))
                known = {name: getattr(seen, name) for name in OF_SENSOR}
                noise = replace(noise, remarks=tuple(remarks), **known)
            if noise.kind == "process":
                share = found.error_of_strength(everything.x0, everything.h)
                noise = replace(noise, intensity_error=noise.intensity * share)
            return replace(found, diagnosis=noise)

        if self.given is not None:
            given = with_noise_formula(found, everything, false_terms=false_terms, given=self.given)
            found = diagnosed(given or found, DiffusionSource.GIVEN)
        else:
            estimated = None if found.noise_free else estimated_diffusion(found, pairs=count)
            whole = None if estimated is None else diagnosed(*self._with_diffusion(found, count))
            if whole is None or whole.diagnosis is None or whole.diagnosis.kind != "process":
                check_units(self.recordings.names, self.units)
                found = diagnosed(found, DiffusionSource.UNIT)
            else:
                # Behind a sensor it was asked for together with that.
                constant = whole.noise is None and whole.diagnosis.measurement_error is None
                formula = constant and with_noise_formula(whole, everything, false_terms=false_terms)
                found = diagnosed(formula, DiffusionSource.ESTIMATED) if formula else whole
        noise = found.diagnosis
        assert noise is not None
        if self.given is not None and noise.kind == "process" and found.diffusion.constant:
            # A constant D that was given, where the recordings speak for another.
            likelihood = ResidualLikelihood(found, everything, residuals(found, everything))
            if likelihood.constant_probability() < false_terms:
                remarks = (*noise.remarks, Remark("inference.noise_depends_on_state"))
                found = replace(found, diagnosis=replace(noise, remarks=remarks))
        if found.noise_free:
            chosen = np.arange(min(len(self.held_out.labels), PREDICTED_RECORDINGS))
            return self._tested(found, errors=prediction_errors(found.dynamics, self.held_out.select(chosen)))
        if found.diffusion.constant:
            generator = self.draw(Purpose.STABILITY)
            found = with_stability(found, everything, options=self.options, generator=generator)
        return self._tested_by_pairs(found, training, unseen)

    def _tested_by_pairs(
        self, found: FieldEstimate, training: SnapshotPairs, unseen: SnapshotPairs
    ) -> FieldEstimate:
        """With the test on the residuals of pairs that its terms, fitted to the others, leave."""
        fitted = refit(found, training)

        def mean_square(pairs: SnapshotPairs) -> float:
            rest, h = residuals(fitted, pairs), pairs.h[:, None]
            if fitted.diffusion.constant:
                return float((rest**2 / h).mean())
            return float(fitted.diffusion.squared_speed(fitted.on_the_way(pairs), rest / np.sqrt(h)).mean())

        probability = mean_residual_probability(fitted, unseen, seen=len(training.h))
        ratio = mean_square(unseen) / mean_square(training)
        return self._tested(found, held_out_ratio=ratio, mean_probability=probability)

    def _tested(self, found: FieldEstimate, **figures: Any) -> FieldEstimate:
        """The estimate with the verdict of `check_prediction` on its figures."""
        assert found.diagnosis is not None
        figures |= {"noise_fault": found.diagnosis.fault(self.recordings.names), "limits": self.limits}
        return replace(
            found, prediction=check_prediction(held_out_values=self.held_out.values.size, **figures)
        )

    def with_hidden_states(self) -> FieldEstimate:
        """f, tested, where the second half of the library's states are velocities that were not recorded.

        Steps of a simulation are no motion under white noise from one to the next, and neither is what a
        filter lets through of one: where innovations show that, fewer samples do.
        """
        hidden = ObservationModel(self.library, Diffusion.identity(self.library.dimension), hidden=True)
        found = first = self.finished(self.by_likelihood(hidden))
        resting = np.concatenate([self.recordings.values, 0 * self.recordings.values], axis=1)
        turned = 0.0  # within a step
        with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
            rates = np.abs(np.linalg.eigvals(found.dynamics.jacobian(resting))).max(axis=1)
            turned = float(np.median(rates)) * usual_step(self.recordings)
            for thinned in THINNED:
                resolved = turned * thinned < MAX_STEP_RATE
                if found.diagnosis is None or not found.diagnosis.correlated or not resolved:
                    break
                found = self.finished(self.by_likelihood(replace(hidden, thinned=thinned)))
        if first.noise_rate.any() and turned > BLURRED:
            longest = usual_step(self.recordings) * BLURRED / turned
            reason = "samples are too far apart for velocities that were not recorded; record with a step of"
            raise NumericalFailure(f"{reason} at most {longest:.2g}")
        return found if found.prediction is not None and found.prediction.passed else first

    def with_velocities(self) -> FieldEstimate | None:
        """f with the velocity as a further state; None where it was not to be tried, or fails its test."""
        if self.options.hidden_velocities != "auto" or self.given is not None:
            return None
        options, names = replace(self.options, hidden_velocities=True), self.recordings.names
        try:
            library = field_library((*names, *velocity_names(names)), options)
            found = replace(self, library=library, options=options).with_hidden_states()
        except (NumericalFailure, np.linalg.LinAlgError):
            return None
        return found if found.prediction is not None and found.prediction.passed else None

    def _fits(self, *views: ObservationModel) -> list[FieldEstimate]:
        """By likelihood, those of some views of the recordings that settle."""
        found = list[FieldEstimate]()
        for view in views:
            with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
                found.append(self.by_likelihood(view))
        return found

    @cached_property
    def slow_sensor(self) -> list[FieldEstimate]:
        """f with slow measurement noise, if it is found; it may be asked for twice."""
        begin = usual_step(self.recordings)
        return self._fits(ObservationModel(self.library, Diffusion.identity(1), sensor_time=begin))

    @cached_property
    def slow_forces(self) -> list[FieldEstimate]:
        """f with a slow force that has noise alone, and with one that follows the state, if found."""
        library = field_library((*self.recordings.names, f"force_{self.recordings.names[0]}"), self.options)
        force = ObservationModel(library, Diffusion.identity(2), hidden=True, slow_force=1.0)
        return self._fits(force, replace(force, follows=True))

    def with_slow_noise(self, rival: FieldEstimate | None = None) -> FieldEstimate | None:
        """f with slow noise about the one recorded state; None where that does not do.

        The sensor has it, or it is a force, which has noise alone or else follows the state; of the sensor
        alone it is asked where f with white measurement noise is a rival. What gains most is tested first; it
        has to be worth its parameters, to pass the test of f, and the past may tell nothing more. Where the
        sensor's noise may as well be white as slow the answer is that of slow noise, refused.
        """
        free = self.options.hidden_velocities == "auto" and self.given is None and not self.integrator_step
        if not free or len(self.recordings.names) != 1:
            return None
        tried = list[tuple[float, FieldEstimate]]()
        for found in self.slow_sensor if rival else [*self.slow_sensor, *self.slow_forces]:
            with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
                asked = ObservationModel.of(found)
                gain = asked.gain(found, self.recordings, rival, pair_step=self.pair_step)
                tried.append((gain, found))
        for gain, found in sorted(tried, key=lambda one: -one[0]):
            with contextlib.suppress(NumericalFailure, np.linalg.LinAlgError):
                if rival is not None and abs(gain) < UNDECIDED:
                    slow = self.finished(found)
                    assert slow.prediction is not None and slow.slow_sensor is not None
                    time, unit = slow.slow_sensor[1], self.recordings.time_unit or ""
                    values = {"time": time, "unit": unit, "by_state": rival.noise is not None}
                    reason = sentence(Remark("inference.slow_or_white", values))
                    return replace(slow, prediction=replace(slow.prediction, passed=False, reason=reason))
                if gain > 0 and self.complete(found := self.finished(found)):
                    return found
        return None

    def with_parts(self, found: FieldEstimate) -> FieldEstimate:
        """f, tested: parts of each state may explain no more of its residuals than chance.

        Of several states; or of one over coarse steps, where parts may explain no more of the squares either.
        Of one over short steps paths of least action are asked (`siq.quasipotential.transitions`).
        """
        coarse = found.flow.by_density
        regular = found.diffusion.regular and (found.library.dimension > 1 or coarse)
        if found.noise_free or found.memory is not None or not regular or found.prediction is None:
            return found
        pairs = found.wrapped(self._pairs(self._states(found)))
        rest = process_noise_increments(found, pairs, residuals(found, pairs))
        rest = np.einsum("nij,nj->ni", found.diffusion.whitening_at(found.on_the_way(pairs)), rest)
        weight, terms = np.sqrt(pairs.h)[:, None], np.unique(found.support[:, 1])
        known = np.column_stack([np.ones(len(rest)), found.library.evaluate(pairs.x0)[:, terms]])
        asked = [(known * weight, pairs.equal_parts(STATE_BINS) * weight, rest)]
        if coarse:
            shapes = compile_formulas(() if found.noise is None else found.noise.terms, found.library.symbols)
            strength = np.column_stack([np.ones(len(rest)), *shapes(pairs.x0.T)])
            asked.append((strength, pairs.equal_parts(STATE_BINS) * 1.0, rest**2 / (rest**2).mean() - 1))
        chances = []
        for known, columns, values in asked:
            known = np.linalg.qr(known / positive(np.linalg.norm(known, axis=0)))[0]
            columns = columns - known @ (known.T @ columns)
            freedom = len(rest) - known.shape[1]
            chances.append(unexplained_probability(columns, values, freedom=freedom, inflation=pairs.copies))
        chance = min(min(chances) * len(chances), 1.0)
        return found.with_shape_tested(chance, limit=self.limits.each, along="state")

    def _states(self, found: FieldEstimate) -> Recordings:
        """The states as recorded, or as a filter knows them behind a sensor.

        Of densities as recorded: what the filter knows is in them.
        """
        if found.flow.by_density or (found.sensor_variance is None and not found.hidden_states):
            return self.recordings
        return filtered_recordings(found, self.recordings, pair_step=self.pair_step)

    def complete(self, found: FieldEstimate) -> bool:
        """Whether f passed its test, and the past tells no more of the next sample than the state does."""
        if found.noise_free:  # of that nobody asks
            return True
        if found.prediction is None or not found.prediction.passed:
            return False
        states, limit = self._states(found), self.limits.each
        claims = check_claims(found, states, self.recordings, pair_step=self.pair_step, false_alarms=limit)
        return "state_complete" not in claims or claims["state_complete"].passed

    def advice(self, *, hidden: bool) -> str | None:
        """Advice where a recorded position has inertia, or hidden velocities are not needed."""
        if len(self.recordings.names) != 1 or self.library.angles:  # the test knows polynomials alone
            return None
        try:
            test = inertia_test(self.recordings, pair_step=self.pair_step, limit=hidden)
        except (NumericalFailure, np.linalg.LinAlgError):
            return None
        if test.needs_velocity == hidden:
            return None
        said = test.sentence(self.recordings.time_unit or "")
        if hidden:
            out = ": leave 'identification.hidden_velocities' out, the position alone is the state"
            return said + out if test.seen or test.overdamped else said
        if self.options.hidden_velocities == "auto" and self.given is None:
            return (
                f"{said}: with the velocity as a state f does not pass its test either; record the velocity"
            )
        return (
            f"{said}: set 'identification.hidden_velocities: true', in Python hidden_velocities=True, and the"
            " velocity is a state that was not recorded"
        )


def _possible_exposures(found: MarkovLag) -> list[float]:
    """Exposures that samples may be means over, the likeliest first; none where they are no such means.

    A camera is mostly exposed for a whole number of steps: where the correlation time is near one, that is
    tried first. One that may be as well that of coloured noise says no more than that; only a whole step is
    tried then.
    """
    if found.kind == "either":
        return [found.step]
    if found.kind != "blur":
        return []
    steps = found.memory / found.step
    whole = round(steps)
    near = [whole * found.step] if abs(steps - whole) < WHOLE_STEP_TOLERANCE * steps else []
    return [*near, found.memory]
