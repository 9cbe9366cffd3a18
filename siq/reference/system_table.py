"""What is known of the reference systems, as a table that other codes can read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import scipy.stats.qmc

from siq.dynamics.formulas import compile_formulas
from siq.reference.systems import reference_systems


def reference_table(*, points: int = 100) -> pd.DataFrame:
    """What is known of the reference systems, as a table that other codes can read.

    Parameters
    ----------
    points
        In the domain of each system whose U is a formula.

    Returns
    -------
    pandas.DataFrame
        A row for every number: ``system``; ``quantity`` (``U``, ``barrier``, ``prefactor``); ``at``, the
        state, or the attractor that is left; ``by`` and ``to``, the saddle and the attractor behind it;
        ``value``, ``error`` and ``how``. States are lists, in the order of ``states``.

    Examples
    --------
    >>> import siq
    >>> table = siq.reference_table()
    >>> table.to_parquet("references.parquet")  # doctest: +SKIP
    """
    rows: list[dict[str, Any]] = []
    for each in reference_systems().values():
        own: dict[str, Any] = {
            "system": each.name,
            "states": list(each.dynamics.states),
            "by": None,
            "to": None,
        }
        if each.quasipotential is not None:
            lower, upper = each.dynamics.box.T
            drawn = scipy.stats.qmc.Halton(len(lower), scramble=False).random(points)
            at = lower + (upper - lower) * drawn
            values = compile_formulas([each.quasipotential], each.dynamics.symbols)(at.T)[0]
            rows += [
                own | {"quantity": "U", "at": list(x), "value": value, "error": 0.0, "how": "exact"}
                for x, value in zip(at, values, strict=True)
            ]
        for barrier in each.barriers:
            way = {
                "at": list(barrier.start),
                "by": list(barrier.saddle),
                "to": list(barrier.end),
                "how": barrier.how,
            }
            rows.append(own | way | {"quantity": "barrier", "value": barrier.value, "error": barrier.error})
            if np.isfinite(barrier.prefactor):
                rows.append(own | way | {"quantity": "prefactor", "value": barrier.prefactor, "error": 0.0})
    columns = ["system", "states", "quantity", "at", "by", "to", "value", "error", "how"]
    return pd.DataFrame(rows, columns=columns)
