"""The estimator of scikit-learn: it finds what siq finds, and does what scikit-learn asks of estimators."""

from __future__ import annotations

import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from siq.data.recordings import Recordings
from siq.errors import Fault, NumericalFailure
from siq.sklearn import LandscapeRegressor

ONE_TARGET = "it gives one number a row for several states: no velocities"
# Of scikit-learn's checks, those that fit several states to one target, and one to a target of chance.
NO_VELOCITIES = dict.fromkeys(
    [
        "check_dict_unchanged", "check_dont_overwrite_parameters", "check_dtype_object",
        "check_estimators_dtypes", "check_estimators_fit_returns_self", "check_estimators_nan_inf",
        "check_estimators_overwrite_params", "check_estimators_pickle", "check_f_contiguous_array_estimator",
        "check_fit2d_1sample", "check_fit2d_predict1d", "check_fit_check_is_fitted", "check_fit_idempotent",
        "check_fit_score_takes_y", "check_methods_sample_order_invariance", "check_methods_subset_invariance",
        "check_n_features_in", "check_n_features_in_after_fitting", "check_pipeline_consistency",
        "check_positive_only_tag_during_fit", "check_readonly_memmap_input",
        "check_regressor_data_not_an_array", "check_regressor_multioutput", "check_regressors_int",
        "check_regressors_no_decision_function", "check_regressors_train", "check_supervised_y_2d",
    ],
    ONE_TARGET,
)  # fmt: skip


def states() -> tuple[np.ndarray, np.ndarray]:
    """States of a double well in x, a single one in y, and their velocities with errors."""
    draw = np.random.default_rng(0)
    x = draw.uniform(-1.6, 1.6, (600, 2))
    return x, np.stack([x[:, 0] - x[:, 0] ** 3, -x[:, 1]], axis=1) + draw.normal(0, 0.1, (600, 2))


def test_check_estimator() -> None:
    from sklearn.utils.estimator_checks import check_estimator

    done = check_estimator(
        LandscapeRegressor(degree=1), expected_failed_checks=NO_VELOCITIES, on_fail=None, on_skip=None
    )
    assert {one["check_name"] for one in done if one["status"] == "failed"} == set()
    # Those excused do fail: what passes is not excused.
    excused = {one["check_name"] for one in done if one["status"] == "xfail"}
    assert excused == set(NO_VELOCITIES)


@pytest.mark.slow
def test_velocities_give_a_landscape() -> None:
    x, velocities = states()
    regressor = LandscapeRegressor(degree=3).fit(x, velocities)
    assert regressor.predict([[0.5, 1.0]])[0] == pytest.approx([0.375, -1.0], abs=0.05)
    assert regressor.score(x, velocities) > 0.97
    landscape = regressor.landscape()
    barriers = landscape.barriers()
    assert (np.abs(barriers["barrier"] - 0.5) < 3 * barriers["standard_error"]).all()
    assert landscape.noise is None  # errors of velocities make no hops
    with pytest.raises(ValueError, match="one for each"):
        LandscapeRegressor().fit(x, velocities[:, 0])


def test_recordings_and_arrays_give_the_same() -> None:
    draw = np.random.default_rng(0)
    x = np.zeros((10_000, 1))
    kicks = np.sqrt(0.25 * 0.02) * draw.normal(size=len(x))
    for k in range(len(x) - 1):
        x[k + 1] = x[k] + 0.02 * (x[k] - x[k] ** 3) + kicks[k]
    by_array = LandscapeRegressor(degree=3, time_step=0.02).fit(x)
    recorded = Recordings.from_arrays(0.02 * np.arange(len(x)), x, names=["x0"])
    again = LandscapeRegressor(degree=3).fit(recorded)
    assert np.array_equal(by_array.field_.coefficients, again.field_.coefficients)
    assert np.array_equal(by_array.predict(x[:9]), again.predict(recorded)[:9])
    assert by_array.score(x) == pytest.approx(again.score(recorded))
    assert 0 < by_array.score(x) < 0.05


def test_what_estimators_do() -> None:
    from sklearn.base import clone, is_regressor
    from sklearn.exceptions import NotFittedError
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import FunctionTransformer

    x, velocities = states()
    before = x.copy()
    regressor = LandscapeRegressor(degree=3, false_terms=0.01)
    with pytest.raises(NotFittedError):
        regressor.predict(x)
    fitted = clone(regressor).fit(x, velocities)
    assert is_regressor(regressor) and np.array_equal(x, before)
    assert fitted.get_params() == regressor.get_params() and not hasattr(regressor, "field_")
    copy = pickle.loads(pickle.dumps(fitted))
    assert np.array_equal(copy.predict(x), fitted.predict(x))
    assert np.array_equal(fitted.predict(x[::-1]), fitted.predict(x)[::-1])
    assert np.array_equal(fitted.fit(x, velocities).predict(x), copy.predict(x))
    piped = make_pipeline(FunctionTransformer(), regressor).fit(x, velocities)
    assert np.array_equal(piped.predict(x), copy.predict(x))
    with pytest.raises(ValueError, match="NaN"):
        regressor.fit(np.where(x > 1.5, np.nan, x), velocities)
    with pytest.raises(ValueError, match="2 features"):
        fitted.predict(x[:, :1])
    with pytest.raises(NumericalFailure, match="significant"):
        LandscapeRegressor(degree=1).fit(x, np.random.default_rng(3).normal(size=x.shape))


def test_velocities_of_cells() -> None:
    x, velocities = states()
    draw = np.random.default_rng(2)
    components = np.linalg.qr(draw.normal(size=(5, 2)))[0]
    layer = velocities @ components.T
    cells = SimpleNamespace(obsm={"X_pca": x}, varm={"PCs": components}, layers={"velocity": layer})
    found = LandscapeRegressor.of_cells(cells, components=2)
    assert found[0] is not None and np.allclose(found[1], velocities)
    cells.obsm["velocity_pca"] = 2 * velocities
    assert np.array_equal(LandscapeRegressor.of_cells(cells)[1], 2 * velocities)
    assert LandscapeRegressor.of_cells(cells, components=1)[0].shape == (600, 1)
    del cells.obsm["velocity_pca"]
    for part, missing in ((cells.obsm, "X_pca"), (cells.varm, "PCs"), (cells.layers, "velocity")):
        del part[missing]
        with pytest.raises(Fault, match=f"the cells have no '{missing}'; run scanpy.pp.pca"):
            LandscapeRegressor.of_cells(cells)
