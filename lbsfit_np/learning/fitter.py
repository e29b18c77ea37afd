"""LBSFitter: the estimator. Pretrains the segmenter on synthetic scans of the rig, and fits scans with it."""

from collections.abc import Mapping

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
from ..segmentation.stage import Training
from ..skinning import JOINT_MODES
from ..synthesis import Synthesis, TrainingScans, make_settings

__all__ = ["LBSFitter", "fit_scan"]


# Beside Synthesis' own defaults: the reference scale is a guess, and people are not of the rig's size.
_TRAINING = {"scale": 0.05}


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
    training_scans : int, default 4000
        Synthetic scans that the segmenter is trained on.
    training : dict, optional
        Fields of ``synthesis.Synthesis`` for them, such as ``{"turn": 3.14, "scale": 0.2}``; ``scale`` is 0.05 unless given.
    n_jobs : int, optional
        Processes for synthesising training scans; results do not depend on it.
    random_state : int or None

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
        training_scans=4000,
        training=None,
        n_jobs=None,
        random_state=None,
    ):
        self.rig = rig
        self.weights = weights
        self.joints = joints
        self.scale = scale
        self.max_points = max_points
        self.training_scans = training_scans
        self.training = training
        self.n_jobs = n_jobs
        self.random_state = random_state

    def pretrain(self, *, cache=False, progress=None):
        """Train the segmenter s on synthetic scans of the rig (step 1 of Algorithm 1).

        Poses are uniform within the limits, in half of the scans correlated between joints (``synthesis.training_poses``);
        shapes and scans vary as ``training`` says.

        Parameters
        ----------
        cache : bool, default False
            Whether to look in, and add to, the cache of segmenters.
        progress : callable, optional
            Called with the share done, in [0, 1].

        Returns
        -------
        self
        """
        self._check()
        rig, seed = self.rig.welded, self.random_state
        given = self.training or {}
        settings = given if isinstance(given, Synthesis) else make_settings(_TRAINING | dict(given))

        def train():
            return train_segmenter(
                rig,
                TrainingScans(rig, settings, seed),
                self.training_scans,
                random_state=seed,
                n_jobs=self.n_jobs,
                progress=progress,
            )

        if not cache or not isinstance(seed, (int, np.integer)):
            self.segmenter_ = train()
        else:
            key = rig.digest, settings, self.training_scans, Descriptor(), Training(), int(seed)
            self.segmenter_ = cached_segmenter(key, train)
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
        return self._fit_scan(points, theta0, labels, point_weights)

    def _fit_scan(self, points, theta0, labels, point_weights, *, cache=False):
        """:meth:`fit_scan`, with the cache of segmenters where asked; all is checked before anything is trained."""
        self._check()
        rig = self.rig
        points = check_points(points, minimum=len(rig.parts))
        if theta0 is not None:
            theta0 = check_array("theta0", theta0, rig.lower.shape)
        if point_weights is not None:
            point_weights = check_array("point_weights", point_weights, (len(points),))
            if point_weights.min() < 0:
                raise InputError("point_weights", f"{int((point_weights < 0).sum())} negative values", "values of at least 0")
            if np.count_nonzero(point_weights) < len(rig.parts):
                got = f"{np.count_nonzero(point_weights)} positive values"
                raise InputError("point_weights", got, f"at least {len(rig.parts)}, as many as the rig has parts")
        if labels is not None:
            labels = _labels(labels, len(points), rig.parts)
        elif getattr(self, "segmenter_", None) is None:
            self.pretrain(cache=cache)
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
        if not isinstance(self.training, (type(None), Mapping, Synthesis)):
            raise InputError("training", type(self.training).__name__, "a dict of fields of synthesis.Synthesis")
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
    return fitter._fit_scan(points, theta0, labels, point_weights, cache=True)


def _labels(labels, n, parts):
    labels = np.asarray(labels)
    if labels.shape != (n,):
        raise InputError("labels", f"shape {labels.shape}", f"shape ({n},), one for each point")
    if labels.dtype.kind not in "iu":
        raise InputError("labels", f"values of type {labels.dtype}", "integers that index rig.parts")
    bad = np.flatnonzero((labels < 0) | (labels >= len(parts)))
    if len(bad):
        got = f"{labels[bad[0]]} at index {bad[0]}"
        raise InputError("labels", got, f"integers from 0 to {len(parts) - 1}, which index rig.parts")
    return labels.astype(int)
