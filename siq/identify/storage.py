"""The identified vector field as a file, with its uncertainty and what its residuals say."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from siq.dynamics.state_noise import diffusion_of_rows, diffusion_rows_of
from siq.errors import InputError
from siq.files.whole import whole_file
from siq.identify.diffusion import DiffusionSource
from siq.identify.flow import FlowMap
from siq.identify.identification import IdentificationOptions
from siq.identify.identified_field import IdentifiedField
from siq.identify.library import CandidateLibrary, candidate_library
from siq.identify.noise_formula import NoiseFormula
from siq.identify.rival_terms import RivalTerms


@dataclass(frozen=True)
class FieldRecord:
    """What is kept of an identification.

    Attributes
    ----------
    found
        The field.
    prediction
        The certificate's test of it, see `siq.certificate.tests.Verdict.as_data`.
    noise
        Kind, intensity and correlations of the residuals, see `siq.identify.residuals.NoiseDiagnosis`; and
        where D is from. Of recordings that remember also `lag`, in steps, and `lost_time`, see
        `siq.identify.lagged_pairs`.
    """

    found: IdentifiedField
    prediction: Mapping[str, Any]
    noise: Mapping[str, Any]

    @property
    def diffusion_source(self) -> DiffusionSource:
        """Where D is from."""
        return DiffusionSource(self.noise.get("diffusion", DiffusionSource.GIVEN))

    @property
    def memory(self) -> tuple[int, float] | None:
        """The lag from which on the recordings are Markovian, and the time lost; None of those that are."""
        lag = self.noise.get("lag")
        return None if lag is None else (int(lag), float(self.noise.get("lost_time", 0.0)))

    @property
    def sensor_variance(self) -> np.ndarray | None:
        """Variance of each state's sensor noise, shape ``(d,)``; None where f was found without any."""
        deviations = np.array(self.noise.get("measurement", []), dtype=float)
        if self.noise.get("kind") not in ("process", "sensor") or not (deviations > 0).any():
            return None
        return deviations**2

    @property
    def hidden_velocities(self) -> bool:
        """Whether half of the states are velocities that were not recorded."""
        return len(self.noise.get("measurement", ())) * 2 == self.found.library.dimension

    @property
    def exposure(self) -> float | None:
        """The step over which each sample was taken as a mean; None where as the state itself."""
        given = self.noise.get("exposure")
        return None if given is None else float(given)

    @property
    def noise_strength(self) -> tuple[float, float] | None:
        """ε and its standard error, None where the recordings show no white noise.

        The variance of n residuals of d states has the relative standard error ``√(2/nd)``. Beside sensor
        noise it is larger, and stands in the record.
        """
        intensity = float(self.noise.get("intensity", 0.0))
        if self.noise.get("kind") not in ("process", "sensor") or not intensity > 0:
            return None
        known = self.noise.get("intensity_error")
        if known is not None:
            return intensity, float(known)
        samples = int(self.noise.get("pairs", 0)) * self.found.library.dimension
        return intensity, intensity * (2 / samples) ** 0.5 if samples else 0.0


def field_library(states: Sequence[str], options: IdentificationOptions) -> CandidateLibrary:
    """The functions in which f is sought."""
    return candidate_library(states, degree=options.degree, further=options.functions)


def write_field(path: str | Path, record: FieldRecord, options: IdentificationOptions) -> None:
    """Write an identified field whole or not at all."""
    found = record.found
    data = {
        "states": list(found.library.states),
        "degree": options.degree,
        "functions": list(options.functions),
        "terms": [
            {
                "component": found.library.states[i],
                "term": found.library.names[k],
                "coefficient": float(found.coefficients[k, i]),
                "standard_error": float(found.standard_errors[k, i]),
                "stability": None if found.stability is None else float(found.stability[place]),
            }
            for place, (i, k) in enumerate(found.support)
        ],
        "covariance": found.covariance.tolist(),
        "rivals": None
        if found.rivals is None
        else {"mean_change": found.rivals.mean_change.tolist(), "spread": found.rivals.spread.tolist()},
        "noise_rate": found.noise_rate.tolist(),
        "residual_ratio": found.residual_ratio,
        "diffusion": diffusion_rows_of(found.diffusion),
        "noise_formula": None if found.noise is None else found.noise.as_data(),
        "constant_noise": None if found.constant_noise is None else found.constant_noise.as_data(),
        "flow": {"steps": found.flow.steps, "euler": found.flow.euler},
        "noise": dict(record.noise),
        "prediction": dict(record.prediction),
    }
    with whole_file(path) as partial:
        partial.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _rivals(written: Mapping[str, Any] | None, library: CandidateLibrary) -> RivalTerms | None:
    if written is None:
        return None
    shape = (library.size, library.dimension)
    return RivalTerms(
        np.array(written["mean_change"]).reshape(shape), np.array(written["spread"]).reshape(-1, *shape)
    )


def _noise(written: Any, library: CandidateLibrary) -> NoiseFormula | None:
    return None if written is None else NoiseFormula.from_data(written, library.symbols)


def _stability(terms: Sequence[Mapping[str, Any]]) -> np.ndarray | None:
    shares = [row.get("stability") for row in terms]
    return None if None in shares else np.array(shares, dtype=float)


def read_field(path: str | Path) -> FieldRecord | None:
    """Read what `write_field` wrote; None where the file is empty since nothing was identified.

    Raises
    ------
    InputError
        When the file is no such record.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        if not text:
            return None
        data = json.loads(text)
        options = IdentificationOptions(degree=data["degree"], functions=tuple(data["functions"]))
        library = field_library(data["states"], options)
        component = {name: index for index, name in enumerate(library.states)}
        term = {name: index for index, name in enumerate(library.names)}
        support = np.array([[component[row["component"]], term[row["term"]]] for row in data["terms"]])
        coefficients = np.zeros((library.size, library.dimension))
        for (i, k), row in zip(support, data["terms"], strict=True):
            coefficients[k, i] = row["coefficient"]
        found = IdentifiedField(
            library, coefficients, support, np.array(data["covariance"]), np.array(data["noise_rate"]),
            float(data["residual_ratio"]), FlowMap(**data["flow"]),
            diffusion_of_rows(library.symbols, data["diffusion"]),
            rivals=_rivals(data.get("rivals"), library), stability=_stability(data["terms"]),
            noise=_noise(data.get("noise_formula"), library),  # older files have neither
            constant_noise=_noise(data.get("constant_noise"), library),
        )  # fmt: skip
        p, d = len(support), library.dimension
        if found.covariance.shape != (p, p) or found.noise_rate.shape != (d, d):
            raise ValueError("covariances do not fit the terms")
        if found.diffusion.dimension != d:
            raise ValueError("D does not fit the states")
        return FieldRecord(found, data["prediction"], data["noise"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            path, "", f"it is no vector field ({type(error).__name__})", "make it again"
        ) from None
