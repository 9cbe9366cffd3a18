"""What does an f that was found beside sensor noise say of other recordings, and of the states in its own?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.special

from siq.data.recordings import Recordings
from siq.estimation.estimation import fit_by_filter
from siq.estimation.innovations import whiten
from siq.estimation.linearisation import Grid, linearise
from siq.identify.flow_regression import positive
from siq.identify.identified_field import IdentifiedField
from siq.identify.noisy_sensor import FilteredField
from siq.identify.seen_states import View, kept_rows, noise_of, settled
from siq.identify.storage import FieldRecord


def held_out_evidence(
    one: FilteredField, training: Recordings, unseen: Recordings, *, pair_step: float | None = None
) -> tuple[float, float]:
    """Does f hold for recordings that it was not fitted to?

    Parameters
    ----------
    one
        Fitted to all recordings; its terms are fitted to the training recordings again.
    training, unseen
        The two parts.
    pair_step
        As for `identify_by_likelihood`.

    Returns
    -------
    probability, ratio
        Of the unseen innovations having no part left that any function of the library explains, by an F test;
        and of their mean square to that of the training recordings.
    """
    view = View(one.found.library, one.found.diffusion, one.exposure)
    return evidence(view, one.found, one.sensor, training, unseen, pair_step=pair_step)


def evidence(
    view: View,
    found: IdentifiedField,
    sensor: np.ndarray,
    training: Recordings,
    unseen: Recordings,
    *,
    pair_step: float | None = None,
) -> tuple[float, float]:
    """The same of any view: f, and the variance of each sensor, as they were found of both parts."""
    noise = view.noise(noise_of(found, sensor))
    support, values = view.unknown(found)
    own = view.measured(training, pair_step)
    x = view.states(own)
    fit = settled(view, support, own, noise, values=values, x=x)
    other = view.measured(unseen, pair_step)
    still = tuple(replace(each, fixed=True) for each in fit.model.parameters)
    follow = fit_by_filter(
        replace(fit.model, parameters=still), other, x=view.states(other), noise=fit.noise,
        estimate_process=False, estimate_sensor=False, substeps=fit.substeps,
    )  # fmt: skip
    everything = view.everything
    values = np.zeros(len(everything))
    values[[everything.tolist().index(one) for one in support.tolist()]] = fit.model.values
    whole = view.model(everything, values)
    along = linearise(whole, Grid(other, fit.substeps), values, follow.linearised_at)
    # The innovations are those of the filter itself; the library's columns are along the same states.
    white = whiten(replace(along, gap=follow.linearisation.gap), other, follow.noise)
    basis = np.linalg.qr(white.columns / positive(np.linalg.norm(white.columns, axis=0)))[0]
    explained = float(((basis.T @ white.innovations) ** 2).sum())
    count, rest = basis.shape[1], white.degrees_of_freedom - basis.shape[1]
    total = float(white.innovations @ white.innovations)
    if rest <= 0:
        return 1.0, 1.0
    probability = float(scipy.special.fdtrc(count, rest, explained / count / ((total - explained) / rest)))
    usual = fit.sum_of_squares / fit.degrees_of_freedom
    return probability, total / white.degrees_of_freedom / usual


def of_all_states(recordings: Recordings, record: FieldRecord, *, pair_step: float | None) -> Recordings:
    """The recordings, with the velocities of an identified f that were not recorded among their states."""
    if not record.hidden_velocities:
        return recordings
    sensor = np.array(record.noise["measurement"]) ** 2
    return filtered_recordings(record.found, sensor, recordings, pair_step=pair_step)


def filtered_recordings(
    found: IdentifiedField,
    sensor: np.ndarray,
    recordings: Recordings,
    *,
    pair_step: float | None = None,
    exposure: float | None = None,
) -> Recordings:
    """The states as a filter knows them at each sample that it uses, from that and the earlier ones.

    Velocities that nobody measured are among them (`siq.identify.velocities`). Their increments have the
    mean of f, as those of the states do; those of the measured values do not.

    Parameters
    ----------
    found
        f and the random forces.
    sensor
        Variance of each state's sensor noise, shape ``(d,)``.
    recordings, pair_step, exposure
        As for `identify_by_likelihood`.
    """
    view = View(found.library, found.diffusion, exposure, hidden=len(sensor) < found.library.dimension)
    data = view.measured(recordings, pair_step)
    model = view.model(*view.unknown(found))
    still = replace(model, parameters=tuple(replace(each, fixed=True) for each in model.parameters))
    follow = fit_by_filter(
        still, data, x=view.states(data), noise=view.noise(noise_of(found, sensor)),
        estimate_process=False, estimate_sensor=False, substeps=found.flow.steps,
    )  # fmt: skip
    rows = np.concatenate(kept_rows(recordings, pair_step=pair_step, every=view.every(recordings)))
    measured = ~np.isnan(data.outputs).all(axis=1)
    seen = replace(
        recordings,
        recording=recordings.recording[rows],
        t=recordings.t[rows],
        values=follow.linearised_at[measured, : len(sensor)].copy(),
    )
    if not view.hidden:
        return seen
    per_time = [None if unit is None else _per(unit, seen.time_unit or "1") for unit in seen.units]
    return replace(
        seen,
        names=found.library.states,
        units=(*seen.units, *per_time),
        headings=(*seen.titles, *found.library.states[len(sensor) :]) if seen.headings else (),
        values=follow.linearised_at.copy(),
    )


def _per(unit: str, time: str) -> str:
    """The unit of a velocity; what is no single symbol stands in brackets."""
    one, other = (each if each.replace("²", "").isalnum() else f"({each})" for each in (unit, time))
    return f"{one}/{other}"
