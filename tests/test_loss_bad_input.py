"""Bad input of the losses: one clear error each."""

import numpy as np
import pytest
from loss_formulas import S

from lbsfit_np.errors import InputError
from lbsfit_np.losses import (
    PRESETS,
    LossWeights,
    chamfer,
    composite_chamfer,
    composite_structured_chamfer,
    cotangent_matrix,
    laplacian_offsets,
    laplacian_posed,
    loopback,
    objective,
    structured_chamfer,
)
from lbsfit_np.neighbors import PointIndex

_X, _V, _xl, _vl = S.X, S.V, S.x_labels, S.v_labels
_nan = np.where(np.arange(len(_X))[:, None] == 3, np.nan, _X)
_masked = {name: np.ma.masked_less(np.arange(37) + 0 * a, 2) for name, a in (("int", _xl), ("float", 1.0))}


class OnACard:
    """As a tensor that is not in the machine's memory."""

    def __init__(self, error=TypeError):
        self.error = error

    def __array__(self, dtype=None, copy=None):
        raise self.error("can't convert cuda:0. Use Tensor.cpu() to copy the tensor to host memory first.")


BAD = [
    (lambda: chamfer(_X.T, _V), ["X: got shape (3, 37)", "(k, 3)"]),
    (lambda: chamfer(_X, _V[:, :2]), ["V: got shape (30, 2)", "(k, 3)"]),
    (lambda: chamfer(_X[:0], _V), ["X: got an empty set", "at least one point"]),
    (lambda: chamfer(_X, _V[:0]), ["V: got an empty set"]),
    (lambda: chamfer("scan.ply", _V), ["X: got str", "numbers"]),
    (lambda: chamfer(_X + 1j, _V), ["X: got complex numbers", "numbers of shape (k, 3)"]),
    (lambda: chamfer(_X * 1e155, _V), ["X: got coordinates of up to", "below 1e+150"]),
    (lambda: structured_chamfer(_X, _V, [[0, 1], [2]], _vl), ["x_labels: got rows of different lengths"]),
    (lambda: cotangent_matrix(_V, [[0, 1, 2], [3]]), ["faces: got rows of different lengths"]),
    (lambda: laplacian_offsets(_V, S.K * np.nan), ["K: got a matrix whose product with offsets is not finite"]),
    (lambda: laplacian_offsets(_V, S.K * 1j), ["K: got complex numbers", "numbers of shape (30, 30)"]),
    (lambda: objective(_X, _V, _V, weights="default", offsets=_V[:5], K=S.K), ["offsets: got 5 points", "30, as many as in V"]),
    (lambda: chamfer(_nan, _V), ["X: got 1 point that is", "NaN", "row 3"]),
    (lambda: chamfer(_X, _V, x_weights=np.ones(37) + 1j), ["x_weights: got complex numbers", "numbers of shape (37,)"]),
    (lambda: loopback(S.V + 1j, S.V), ["predicted: got complex numbers", "numbers of shape (J, 3)"]),
    (lambda: loopback(S.V, S.V + 1j), ["theta: got complex numbers"]),
    (lambda: loopback([[10**400, 0, 0]], [[0, 0, 0]]), ["whole numbers beyond double precision"]),
    (lambda: chamfer(np.ma.masked_invalid(_nan), _V), ["X: got a masked array with 1 of 37 rows masked", "without a mask"]),
    (lambda: chamfer(_X, _V, x_weights=_masked["float"]), ["x_weights: got a masked array with 2 of 37 rows masked"]),
    (lambda: structured_chamfer(_X, _V, _masked["int"], _vl), ["x_labels: got a masked array with 2 of 37 rows masked"]),
    (lambda: loopback(np.ma.masked_less(S.V, S.V.max()), S.V), ["predicted: got a masked array with", "of 30 rows masked"]),
    (lambda: loopback(S.V, np.ma.masked_less(S.V, S.V.max())), ["theta: got a masked array with"]),
    (lambda: chamfer(_X, np.full_like(_V, np.inf)), ["V: got 30 points", "infinite", "row 0"]),
    (lambda: chamfer(_X, _V, x_weights=np.ones(5)), ["x_weights: got shape (5,)", "(37,)"]),
    (lambda: chamfer(_X, _V, x_weights=-np.ones(37)), ["x_weights", "negative"]),
    (lambda: chamfer(_X, _V, x_weights=np.zeros(37)), ["x_weights", "all 0"]),
    (lambda: chamfer(_X, _V, x_weights=np.full(37, np.nan)), ["x_weights", "not finite"]),
    (lambda: chamfer(_X, _V, x_index=PointIndex(_V)), ["x_index", "30 points", "37 points"]),
    (lambda: chamfer(_X, _V, x_index=PointIndex(_X, _xl)), ["x_index", "with labels", "without labels"]),
    (lambda: structured_chamfer(_X, _V, _xl, _vl, x_index=PointIndex(_X)), ["x_index", "without labels", "with labels"]),
    (lambda: chamfer(_X, _V, x_index=PointIndex(_X[::-1])), ["x_index: got a PointIndex over other points", "Build it again"]),
    (lambda: structured_chamfer(_X, _V, _xl, _vl, x_index=PointIndex(_X, _xl[::-1])), ["x_index", "over other labels"]),
    (lambda: chamfer(_X, _V, x_index=_X), ["x_index: got a ndarray", "PointIndex over X"]),
    (lambda: composite_chamfer(_X, _V * np.nan, _V), ["Vd: got 30 points that are NaN"]),
    (lambda: composite_structured_chamfer(_X, _V[:, :2], _V, _xl, _vl), ["Vd: got shape (30, 2)"]),
    (
        lambda: objective(_X, _V, _V, weights="default", x_labels=_xl, v_labels=_vl, x_part_index=PointIndex(_X)),
        ["x_part_index: got a PointIndex without labels"],
    ),
    (lambda: PointIndex(_X, _xl - 1), ["labels: got -1 at index", "len(rig.parts)"]),
    (lambda: PointIndex(_X, _xl[:5]), ["labels: got", "values of shape (5,)", "(37,), one for each point"]),
    (lambda: PointIndex(_X, _xl + 0.5), ["labels: got float64 values"]),
    (lambda: cotangent_matrix(_V, np.ma.masked_equal(np.arange(6).reshape(2, 3), 3)), ["faces: got a masked array with 1 of 2"]),
    (lambda: LossWeights(lam=1e308), ["lam: got 1e+308", "at most 1e+100"]),
    (lambda: loopback(np.full_like(S.V, np.nan), S.V), ["predicted", "NaN", "finite numbers"]),
    (lambda: PRESETS["paper"].replace(lam_lab=0.1), ["lam_lab: got an unknown weight", "Did you mean 'lam_lap'"]),
    (lambda: loopback(np.full_like(S.V, 1e200), S.V), ["predicted: got angles of up to 1e+200", "angles below 1e+150"]),
    (lambda: loopback(S.V, np.full_like(S.V, np.inf)), ["theta", "infinite", "finite numbers"]),
    (lambda: structured_chamfer(_X, _V, _xl[:-1], _vl), ["x_labels: got shape (36,)", "(37,)"]),
    (lambda: structured_chamfer(_X, _V, _xl, _xl), ["v_labels: got shape (37,)", "(30,)"]),
    (lambda: structured_chamfer(_X, _V, _xl.astype(float), _vl), ["x_labels", "float64", "integers"]),
    (lambda: structured_chamfer(_X, _V, _xl - 1, _vl), ["x_labels: got -1 at index", "at least 0"]),
    (lambda: structured_chamfer(_X, _V, _xl + 4 * 10**12, _vl), ["x_labels: got 4000000000003 at index 3", "below 65536"]),
    (lambda: structured_chamfer(_X, _V, _xl, _vl.astype(np.uint64) + np.uint64(2**63)), ["v_labels: got 92233720368547758"]),
    (lambda: chamfer([[10**400, 0, 0]], _V), ["X: got whole numbers beyond double precision"]),
    (lambda: chamfer(_X, _V, x_weights=[10**400] * 37), ["x_weights: got whole numbers beyond double precision"]),
    (lambda: composite_chamfer(_X, _V, _V[:-1]), ["V: got 29 points", "30", "Vd"]),
    (lambda: composite_chamfer(_X, _V, _V[:-1], lam=0.0), ["V: got 29 points"]),
    (lambda: composite_chamfer(_X, _V, _V, lam=-0.5), ["lam: got -0.5", "at least 0"]),
    (lambda: composite_structured_chamfer(_X, _V, _V, _xl, _vl, lam="0.5"), ["lam: got '0.5'"]),
    (lambda: laplacian_posed(_V[:-1], S.K), ["K: got shape (30, 30)", "(29, 29)", "Vd"]),
    (lambda: laplacian_offsets(_V[:, 0], S.K), ["offsets: got shape (30,)"]),
    (lambda: laplacian_offsets(_V, None), ["K: got NoneType", "(30, 30)"]),
    (lambda: cotangent_matrix(_V, np.array([[0, 1, 30]])), ["faces: got rows from 0 to 30", "0 to 29"]),
    (lambda: cotangent_matrix(_V, np.array([[0, 1, -1]])), ["faces: got rows from -1 to 1"]),
    (lambda: cotangent_matrix(_V, np.array([[0.0, 1, 2]])), ["faces: got float64", "integers"]),
    (lambda: cotangent_matrix(_V, np.array([[0, 1, 2, 3]])), ["faces", "(1, 4)", "(F, 3)"]),
    (lambda: cotangent_matrix(_V[:, :2], np.array([[0, 1, 2]])), ["vertices: got shape (30, 2)"]),
    (lambda: loopback(np.zeros((4, 3)), np.zeros((5, 3))), ["theta: got shape (5, 3)", "(4, 3)"]),
    (lambda: loopback(np.zeros((2, 4, 3)), np.zeros((4, 3))), ["theta: got shape (4, 3)", "(2, 4, 3)"]),
    (lambda: loopback(np.zeros(12), np.zeros(12)), ["predicted: got shape (12,)", "(J, 3)", "Reshape to (B, J, 3)"]),
    (lambda: loopback(np.zeros((2, 12)), np.zeros((2, 12))), ["predicted: got shape (2, 12)", "Reshape to (B, J, 3)"]),
    (lambda: chamfer(_X[None], _V), ["X: got shape (1,", "Pass one at a time: loop over the first axis."]),
    (lambda: chamfer(OnACard(), _V), ["X: got OnACard; expected numbers", "Use Tensor.cpu() to copy the tensor"]),
    (lambda: chamfer(_X, OnACard(RuntimeError)), ["V: got OnACard; expected numbers", "Use Tensor.cpu() to copy the tensor"]),
    (lambda: loopback(np.zeros((0, 4, 3)), np.zeros((0, 4, 3))), ["predicted: got shape (0, 4, 3)"]),
    (lambda: objective(_X, _V, _V, weights="best"), ["weights: got 'best'", "'paper'", "'default'"]),
    (lambda: objective(_X, _V, _V, weights={"lam": 1}), ["weights: got {'lam': 1}", "LossWeights"]),
    (lambda: objective(_X, _V, _V, weights="paper", x_labels=_xl), ["v_labels: got None", "x_labels"]),
    (lambda: objective(_X, _V, _V, weights="paper", v_labels=_vl), ["x_labels: got None", "Leave both out"]),
    (lambda: objective(_X * np.nan, _V, _V, weights=LossWeights(chamfer=0.0)), ["X: got 37 points that are NaN"]),
    (lambda: objective(_X, _V, _V, weights="default", K=S.K), ["offsets: got None"]),
    (lambda: objective(_X, _V, _V[:-2], weights="paper"), ["V: got 28 points"]),
    (lambda: LossWeights(lam=-1.0), ["lam: got -1.0", "at least 0"]),
    (lambda: LossWeights(lam_lap=np.nan), ["lam_lap: got nan"]),
    (lambda: LossWeights(lam_lap=10**400), ["lam_lap: got 1000", "a finite number"]),
    (lambda: LossWeights(lam_lap=10**5000), ["lam_lap: got a number of several thousand digits"]),
    (lambda: LossWeights(lam_lap=np.float32(np.inf)), ["lam_lap: got", "a finite number"]),
    (lambda: LossWeights(squared="False"), ["squared: got 'False'", "True or False"]),
    (lambda: LossWeights(squared=np.array([True, False])), ["squared: got array([ True, False])", "True or False"]),
    (lambda: laplacian_posed(_V, S.K, squared="False"), ["squared: got 'False'", "True or False"]),
    (lambda: laplacian_offsets(_V, S.K, squared=np.array([True, False])), ["squared: got array", "True or False"]),
    (lambda: laplacian_posed(_V, S.K, squared=1), ["squared: got 1;", "True or False"]),
    (lambda: LossWeights(laplacian="both"), ["laplacian: got 'both'", "'posed' or 'offsets'"]),
    (lambda: LossWeights(laplacian="ofsets"), ["laplacian: got 'ofsets'", "Did you mean 'offsets'?"]),
    (lambda: LossWeights(laplacian=np.array(["posed", "offsets"])), ["laplacian: got array(", "'posed' or 'offsets'"]),
    (lambda: LossWeights(laplacian=S.K), ["laplacian: got <", "'posed' or 'offsets'"]),
    (lambda: PRESETS["paper"].replace(lam_s=np.inf), ["lam_s: got inf"]),
]


@pytest.mark.parametrize("call, words", BAD)
def test_bad_input_is_named(call, words):
    with pytest.raises(InputError) as error:
        call()
    for word in words:
        assert word in str(error.value)
