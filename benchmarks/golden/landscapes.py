"""What is written down of a landscape?"""

from __future__ import annotations

from typing import Any

import numpy as np

import siq

SHARES = (0.25, 0.5)  # of the way from an attractor to its saddle: where U is read
QUIET = 0.2  # of the lowest barrier: the noise for which mean times are asked


def landscape(found: siq.Landscape) -> dict[str, Any]:
    """Attractors, saddles, barriers with relative errors, U over the lowest barrier, times, and verdicts."""
    ways, table, certificate = found.transitions, found.barriers(), found.certificate
    barrier = table["barrier"].to_numpy(float)
    lowest = min(barrier[np.isfinite(barrier) & (barrier > 0)], default=np.nan)
    ends = [(_position(found.attractors[way.start]), _position(way.saddle)) for way in ways]
    between = [a + share * (b - a) for a, b in ends if a is not None and b is not None for share in SHARES]
    said: dict[str, Any] = {
        "certified": certificate is not None and certificate.certified,
        "equilibria": [one.kind for one in found.equilibria if one.kind != "degenerate"],
        "attractors": [
            _extent(one) if _position(one) is None else _position(one) for one in found.attractors
        ],
        "basins": found.basins,
        "degrees": [None if well is None else well.degree for well in found.wells],
        "curvature": [
            None if well is None or _position(one) is None else well.hessians(one.position[None])[0]
            for well, one in zip(found.wells, found.attractors, strict=True)
        ],
        "ways": [[way.start, way.end] for way in ways],
        "saddles": [_position(way.saddle) for way in ways],
        "barrier": barrier,
        "barrier_error": table["standard_error"].to_numpy(float) / barrier,
        "path_barrier": [None if way.path is None else way.path.uphill.action for way in ways],
        "heights": found.heights / lowest,
        "U_between": found.quasipotential(np.array(between)) / lowest if between else [],
    }
    if found.cycles or found.parting:
        said |= {
            "periods": [one.period for one in found.cycles],
            "multipliers": [one.multipliers for one in found.cycles],
            "parting_periods": [one.period for one in found.parting],
        }
    if certificate is not None:
        said |= {
            "tests": sorted(certificate.tests),
            "tests_failed": sorted(name for name, one in certificate.tests.items() if not one.passed),
            "scope": certificate.scope,
            "stated_error": certificate.error,
        }
    if np.isfinite(lowest):
        try:
            said["mean_time"] = found.escape_times(noise=QUIET * lowest)["mean_time"]
            said["dwell_time"] = found.dwell_times(noise=QUIET * lowest)["mean_time"]
        except ValueError as error:
            said["no_times"] = type(error).__name__
    return said


def _position(place: Any) -> Any:
    """Of a point; None of a cycle."""
    return getattr(place, "position", None)


def _extent(cycle: Any) -> list[np.ndarray]:
    """Its box, since the list of its points may begin anywhere."""
    return [cycle.points.min(axis=0), cycle.points.max(axis=0)]


def support_of(dynamics: siq.Dynamics) -> dict[str, Any]:
    """The terms of f and their coefficients, by state."""
    terms = [
        sorted((str(t), float(c)) for t, c in f.expand().as_coefficients_dict().items())
        for f in dynamics.formulas
    ]
    return {
        "support": [[term for term, _ in one] for one in terms],
        "coefficients": [[value for _, value in one] for one in terms],
    }
