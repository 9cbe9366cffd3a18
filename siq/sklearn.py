"""A landscape as an estimator of scikit-learn: f of recordings or velocities, with fit, predict and score.

A velocity is what two samples show that are one short step of Euler's rule apart. So states with their
velocities are recordings of two samples each. Only what scatters there is no noise that drives the states: D
is given, and of ε nothing is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from siq.data.preparation import in_stretches
from siq.data.recordings import Recordings, snapshot_pairs
from siq.errors import Fault, NumericalFailure, needs_extra
from siq.inference.library import IdentificationOptions
from siq.inference.regression import residuals
from siq.systems.diffusion import Diffusion
from siq.workflow.pipeline import identify_run, landscape_from_recordings
from siq.workflow.study import PipelineSettings, Sampling, StateSpace

with needs_extra("sklearn"):
    from sklearn.base import BaseEstimator, RegressorMixin
    from sklearn.utils import Tags
    from sklearn.utils.validation import check_is_fitted, validate_data

if TYPE_CHECKING:
    import pandas as pd
    from anndata import AnnData

    from siq.quasipotential.landscape import Landscape
    from siq.systems.cards import DiffusionEntry


class LandscapeRegressor(RegressorMixin, BaseEstimator):
    """f of ``dx/dt = f(x) + noise`` as a sparse formula, by recordings or by velocities.

    Parameters
    ----------
    degree, functions, false_terms
        In what f is sought, and what makes a term significant; see
        `siq.inference.library.IdentificationOptions`.
    diffusion
        D, as `siq.workflow.study.StateSpace` takes it. By default found in recordings; of velocities the unit
        matrix.
    time_step
        Of recordings that are arrays, between their samples.
    random_state
        Seed of what is drawn: held-out recordings, resampling.

    Attributes
    ----------
    field_
        f and D with their errors, `siq.inference.field_estimate.FieldEstimate`.
    recordings_
        What it was fitted to.
    n_features_in_
        Number of states, d.

    Examples
    --------
    >>> x = np.linspace(-1.5, 1.5, 200)[:, None]
    >>> regressor = LandscapeRegressor(degree=3).fit(x, x - x**3)
    >>> regressor.predict([[0.5]]).round(6)
    array([[0.375]])
    >>> regressor.landscape().barriers().round(3)[["start", "end", "barrier"]]
       start  end  barrier
    0      0    1      0.5
    1      1    0      0.5
    """

    def __init__(
        self, *, degree: int = 5, functions: Sequence[str] = (), false_terms: float = 0.02,
        diffusion: DiffusionEntry | None = None, time_step: float = 1.0, random_state: int = 0,
    ) -> None:  # fmt: skip
        self.degree = degree
        self.functions = functions
        self.false_terms = false_terms
        self.diffusion = diffusion
        self.time_step = time_step
        self.random_state = random_state

    def fit(
        self, X: Recordings | pd.DataFrame | np.ndarray | Sequence[np.ndarray], y: np.ndarray | None = None
    ) -> LandscapeRegressor:
        """Find f.

        Parameters
        ----------
        X
            Without `y` recordings: as `siq.Recordings.of` takes them, or arrays ``(n, d)`` of samples that
            are `time_step` apart, one or several. With `y` states, shape ``(n, d)``.
        y
            Their velocities, shape ``(n, d)``; ``(n,)`` of one state.

        Raises
        ------
        ValueError
            Where the velocities are not as many as the states.
        NumericalFailure
            Where there is no f, with the reason, and what would help.
        """
        if y is None:
            self._step, self._flat = None, False
            self.recordings_ = in_stretches(self._recordings(X), hidden_velocities=False)
            self.n_features_in_ = len(self.recordings_.names)
        else:
            x, velocities = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=float)
            self._flat = velocities.ndim == 1
            velocities = velocities.reshape(len(x), -1)
            if velocities.shape != x.shape:
                raise ValueError(
                    f"there are {velocities.shape[1]} velocities for {x.shape[1]} states; give one for each"
                )
            # As of a difference quotient: what rounding adds to a velocity is as little as the step allows.
            size, speed = np.abs(x).max(initial=0.0), np.abs(velocities).max(initial=0.0)
            self._step = float(np.sqrt(np.finfo(float).eps) * (size or 1.0) / (speed or 1.0))
            both = np.stack([x, x + self._step * velocities], axis=1)
            times = self._step * np.arange(2)
            names = [f"x{place}" for place in range(x.shape[1])]
            self.recordings_ = Recordings.from_arrays(times, both, names=names)
        found = identify_run(self._settings, self.recordings_, number=0)
        if found.result is None:
            raise NumericalFailure(found.outcome.reason)
        self.field_ = found.result
        return self

    @staticmethod
    def of_cells(cells: AnnData, *, components: int = 2) -> tuple[np.ndarray, np.ndarray]:
        """States and velocities of single cells in their first principal components, to be fitted.

        Parameters
        ----------
        cells
            With ``obsm["X_pca"]``, and either ``obsm["velocity_pca"]``, or the layer ``velocity`` of genes
            with their loadings ``varm["PCs"]``, on which it is projected. A velocity that is not a number
            counts as none.
        components
            How many.

        Returns
        -------
        states, velocities
            Shape ``(n, components)`` each.

        Raises
        ------
        Fault
            Where the cells lack one of these.
        """
        try:
            known = cells.obsm.get("velocity_pca")
            if known is None:
                genes = cells.layers["velocity"]
                known = np.nan_to_num(getattr(genes, "toarray", lambda: genes)()) @ cells.varm["PCs"]
            states, velocities = (np.asarray(each, dtype=float) for each in (cells.obsm["X_pca"], known))
        except KeyError as error:
            raise Fault(f"the cells have no {error}", "run scanpy.pp.pca and scvelo.tl.velocity") from None
        return states[:, :components], velocities[:, :components]

    def predict(self, X: Recordings | np.ndarray) -> np.ndarray:
        """f at states ``(n, d)``, or at all samples of recordings: the mean velocity there, ``(n, d)``."""
        check_is_fitted(self)
        x = X.values if isinstance(X, Recordings) else validate_data(self, X, reset=False, dtype=float)
        velocities = self.field_.library.evaluate(x) @ self.field_.coefficients
        return np.asarray(velocities[:, 0] if self._flat else velocities)

    def score(self, X: Any, y: np.ndarray | None = None) -> float:
        """R² of the velocities; of recordings, without `y`, of the increments from sample to sample.

        Under noise the last is small also of the true f: of the order of ``f² h`` over the noise rate.
        """
        check_is_fitted(self)
        if y is not None:
            return float(super().score(X, y))
        pairs = snapshot_pairs(self._recordings(X))
        increments, h = pairs.xh - pairs.x0, pairs.h[:, None]
        left = (residuals(self.field_, pairs) ** 2 / h).sum(axis=0)
        mean = increments.sum(axis=0) / h.sum()
        return float(1 - (left / ((increments - mean * h) ** 2 / h).sum(axis=0)).mean())

    def landscape(self) -> Landscape:
        """Wells, barriers and ways of what it was fitted to, with their certificate.

        The strength of the noise does not follow from velocities: give ε for times.

        Raises
        ------
        NoLandscape
            When f has none. It says why.
        """
        check_is_fitted(self)
        found = landscape_from_recordings(self.recordings_, self._settings)
        return found if self._step is None else replace(found, noise=None)

    def _recordings(self, X: Any) -> Recordings:
        """Recordings, whatever they are in; of arrays the samples are one step apart."""
        if not isinstance(X, np.ndarray | list | tuple):
            return Recordings.of(X)
        parts = [np.asarray(each, dtype=float) for each in ([X] if np.ndim(X[0]) < 2 else X)]
        times = [self.time_step * np.arange(len(each)) for each in parts]
        names = [f"x{place}" for place in range(parts[0].shape[-1])]
        return Recordings.from_arrays(times, parts, names=names)

    @property
    def _settings(self) -> PipelineSettings:
        options = IdentificationOptions(
            degree=self.degree, functions=tuple(self.functions), false_terms=self.false_terms,
            hidden_velocities=False,
        )  # fmt: skip
        diffusion = self.diffusion or (None if self._step is None else "identity")
        return PipelineSettings(
            seed=self.random_state, space=StateSpace(diffusion=diffusion), identification=options,
            sampling=Sampling(integrator_step=self._step),
        )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        """Without compiled functions, which processes cannot hand to each other."""
        state = dict(super().__getstate__())
        if "field_" in state:
            found = state["field_"]
            library = replace(found.library)
            diffusion = Diffusion.of_rows(library.symbols, found.diffusion.rows)
            state["field_"] = replace(found, library=library, diffusion=diffusion)
        return state

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.target_tags.required = False
        tags.target_tags.multi_output = True
        return tags
