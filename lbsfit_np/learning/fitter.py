"""LBSFitter: the estimator. Pretrains the segmenter on synthetic scans of the rig, and fits scans with it."""

import numpy as np
from sklearn.base import BaseEstimator

from ..errors import InputError, check_array
from ..fitting.scan_fit import FitSettings, fit_points
from ..losses.objective import as_weights
from ..optimize.model import Model
from ..rig.rig import Rig
from ..scan import check_points
from ..segmentation.cache import cached_segmenter
from ..segmentation.descriptors import Descriptor
from ..segmentation.segmenter import train_segmenter
from ..skinning import JOINT_MODES
from ..synthesis import make_settings, synthesize_nth

__all__ = ["LBSFitter", "fit_scan"]


class LBSFitter(BaseEstimator):
    """Fit a rig to point clouds; scikit-learn's estimator conventions.

    Parameters
    ----------
    rig : Rig
    weights : {"default", "paper"} or LossWeights, default "default"
        Weights of the objective; docs/losses.md says how the default was chosen.
    joints : {"follow", "fixed"}, default "follow"
        Whether joints follow the changed template, or stay where the rig has them, as in the paper.
    scale : {"estimate", "fixed"}, default "estimate"
        Whether isotropic scale is found with the pose, or is 1 (scan and rig in one unit).
    max_points : int, default 2500
        Points of a scan that take part in the optimisation; all are labelled.
    training_scans : int, default 2000
        Synthetic scans that the segmenter is trained on.
    training : dict, optional
        Fields of ``synthesis.Synthesis`` for them, such as ``{"turn": 3.14, "scale": 0.2}``.
    random_state : int, Generator or None

    Attributes
    ----------
    segmenter_ : Segmenter
        After :meth:`pretrain`.
    """

    def __init__(
        self,
        rig,
        *,
        weights="default",
        joints="follow",
        scale="estimate",
        max_points=2500,
        training_scans=2000,
        training=None,
        random_state=None,
    ):
        self.rig = rig
        self.weights = weights
        self.joints = joints
        self.scale = scale
        self.max_points = max_points
        self.training_scans = training_scans
        self.training = training
        self.random_state = random_state

    def pretrain(self, *, cache=False, progress=None):
        """Train the segmenter s on uniform poses of the template (step 1 of Algorithm 1).

        Parameters
        ----------
        cache : bool, default False
            Whether to look in, and add to, the cache of segmenters.
        progress : callable, optional
            Wraps the iterable of synthetic scans, as ``tqdm`` does.

        Returns
        -------
        self
        """
        self._check()
        rig, seed = self.rig.welded, self.random_state
        settings = make_settings(self.training or {})

        def train():
            indices = range(self.training_scans)
            scans = (synthesize_nth(rig, i, settings, random_state=seed) for i in (progress(indices) if progress else indices))
            return train_segmenter(rig, ((s.points, s.labels, 1.0) for s in scans), random_state=seed)

        if not cache or not isinstance(seed, (int, np.integer)):
            self.segmenter_ = train()
        else:
            self.segmenter_ = cached_segmenter((rig.digest, settings, self.training_scans, Descriptor(), int(seed)), train)
        return self

    def fit_scan(self, points, *, theta0=None, labels=None, point_weights=None):
        """Fit one scan; pretrains first where that has not been done and labels are not given.

        Parameters
        ----------
        points : (n, 3) array or Scan
            In any unit that ``scale`` allows.
        theta0 : (J, 3) array, optional
            A known start, radians.
        labels : (n,) int array, optional
            Known parts of the points, which index ``rig.parts``.
        point_weights : (n,) array, optional
            Non-negative; 0 leaves a point out of the fit.

        Returns
        -------
        FitResult
        """
        self._check()
        rig = self.rig
        points = check_points(points, minimum=len(rig.parts))
        if theta0 is not None:
            theta0 = check_array("theta0", theta0, rig.lower.shape)
        if point_weights is not None:
            point_weights = check_array("point_weights", point_weights, (len(points),))
            if point_weights.min() < 0:
                raise InputError("point_weights", f"{int((point_weights < 0).sum())} negative values", "values of at least 0")
        if labels is not None:
            labels = _labels(labels, len(points), rig.parts)
        elif getattr(self, "segmenter_", None) is None:
            self.pretrain()
        if labels is None:
            self.segmenter_.check_rig(rig)
        return fit_points(
            self._model(),
            points,
            segmenter=None if labels is not None else self.segmenter_,
            settings=FitSettings(weights=as_weights(self.weights), scale=self.scale, max_points=self.max_points),
            theta0=theta0,
            labels=labels,
            point_weights=point_weights,
            random_state=self.random_state,
        )

    def _model(self):
        """The rig made ready, kept until ``rig`` or ``joints`` change."""
        kept = self.__dict__.get("_ready")
        if kept is None or kept[0] is not self.rig or kept[1] != self.joints:
            self._ready = kept = self.rig, self.joints, Model(self.rig, self.joints)
        return kept[2]

    def _check(self):
        if not isinstance(self.rig, Rig):
            raise InputError("rig", type(self.rig).__name__, "a Rig", "Read one with load_rig.")
        as_weights(self.weights)
        if self.joints not in JOINT_MODES:
            raise InputError("joints", repr(self.joints), " or ".join(map(repr, JOINT_MODES)))
        if self.scale not in ("estimate", "fixed"):
            raise InputError("scale", repr(self.scale), "'estimate' or 'fixed'")
        for name in ("max_points", "training_scans"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise InputError(name, repr(value), "a positive integer")


def fit_scan(rig, points, *, theta0=None, labels=None, point_weights=None, random_state=0, **parameters):
    """Fit one scan in one call, with a segmenter that is trained once and kept in the user's cache folder.

    Parameters
    ----------
    rig : Rig
    points, theta0, labels, point_weights
        As in :meth:`LBSFitter.fit_scan`.
    random_state : int, default 0
    **parameters
        Of :class:`LBSFitter`.

    Returns
    -------
    FitResult
    """
    fitter = LBSFitter(rig, random_state=random_state, **parameters)
    if labels is None:
        check_points(points, minimum=len(rig.parts))
        fitter.pretrain(cache=True)
    return fitter.fit_scan(points, theta0=theta0, labels=labels, point_weights=point_weights)


def _labels(labels, n, parts):
    labels = np.asarray(labels)
    if labels.shape != (n,):
        raise InputError("labels", f"shape {labels.shape}", f"shape ({n},), one for each point")
    if labels.dtype.kind not in "iu":
        raise InputError("labels", f"values of type {labels.dtype}", "integers that index rig.parts")
    bad = np.flatnonzero((labels < 0) | (labels >= len(parts)))
    if len(bad):
        raise InputError("labels", f"{labels[bad[0]]} at index {bad[0]}", f"integers from 0 to {len(parts) - 1}, which index rig.parts")
    return labels.astype(int)
