"""The simulation that a diagnosis ends with: with the noise that was found, and where its states lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from siq.dynamics.diffusion import Diffusion
from siq.dynamics.dynamics import Dynamics


def completed(model: Dynamics, x: np.ndarray, *, process: np.ndarray | None = None) -> Dynamics:
    """A fitted simulation as a dynamics of its own.

    Parameters
    ----------
    model
        With the estimates as its parameters' values.
    x
        States along the recordings, shape ``(n, d)``: measured ones as they were measured or smoothed, hidden
        ones as the fit has them. A state without a domain, such as one that a mechanism brings, gets the
        range of these.
    process
        Intensity of random forces on each state, per time, shape ``(d,)``, where they are part of what was
        found. They become its D, with zeros for states that nothing drives.
    """
    limits = np.stack([x.min(axis=0), x.max(axis=0)], axis=1)
    limits[limits[:, 0] == limits[:, 1]] = np.nan  # of a state that rests nothing is known
    domain = np.where(np.isfinite(model.limits), model.limits, limits)
    noise = model.diffusion
    if process is not None and (process > 0).any():
        noise = Diffusion(np.diag(process))
    return replace(model, domain=domain, diffusion=noise)
