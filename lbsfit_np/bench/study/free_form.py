"""The free-form baselines, which play 3D-CODED's part: no skinning, the template's vertices move under Chamfer and Laplacian.

What differs is where the vertices start: from the template, from the best of several synthetic scans that look alike
("augmented"), or from what a regressor says that was taught with the true vertices of the training scans ("supervised").
"""

import time
from dataclasses import dataclass

import numpy as np

from ...fitting.scan_fit import FitSettings
from ...learning.free_form import LOOSE, free_form
from ...optimize.frame import Frame
from ...optimize.model import Model
from ...optimize.problem import Problem
from ...seeds import integer_seed
from ...skinning import skin
from ...starts.clean import TakingPart
from ...starts.look import look
from ...threads import one_thread

__all__ = ["Augmented", "FreeForm", "FromTemplate", "Supervised", "best_free_form", "taught"]

# Synthetic scans that the augmented baseline starts from.
_STARTS = 3
_COMPONENTS, _HIDDEN, _EPOCHS = 64, (256, 128), 300
# Training scans that the components are of; more of them change nothing but the memory that it takes.
_OF_COMPONENTS = 2000


@dataclass(frozen=True)
class FreeForm:
    """What was found of a scan.

    Attributes
    ----------
    vertices : (m, 3) array
    joints : (J, 3) array
        Of the joint regressor.
    recon : float
        √L_c, what it leaves unexplained.
    """

    vertices: np.ndarray
    joints: np.ndarray
    recon: float


def best_free_form(rig, points, starts, others=()):
    """Vertices fitted to a scan from each of some starts; those with the least Chamfer distance.

    Parameters
    ----------
    rig : Rig
    points : (n, 3) array
        In the rig's unit.
    starts : iterable of (m, 3) arrays
        Vertices, in the scan's frame up to translation and scale.
    others : iterable of FreeForm
        That were found before, from other starts.

    Returns
    -------
    FreeForm
    """
    return min([*others, *(_fitted(rig, points, start) for start in starts)], key=lambda found: found.recon)


def _fitted(rig, points, start):
    model = Model(rig.with_template(start), half=rig.size / 2)
    frame, part = Frame(points.mean(axis=0), model.half), TakingPart.only(np.arange(len(points)), len(points))
    with one_thread():
        problem = Problem(frame.inside(points))
        result = free_form(model, FitSettings(weights=LOOSE), problem, points, part, frame, time.perf_counter())
    return FreeForm(result.vertices, rig.regressor @ result.vertices, result.terms["recon"])


@dataclass(frozen=True)
class FromTemplate:
    """points → FreeForm, from the template in its rest pose."""

    rig: object

    def __call__(self, points):
        return best_free_form(self.rig, points, [self.rig.vertices])


@dataclass(frozen=True)
class Augmented:
    """(points, FreeForm from the template or None) → FreeForm: that, or from poses of the library whose scans look alike."""

    rig: object
    library: object

    def __call__(self, task):
        points, from_template = task
        starts = [skin(self.rig, theta).vertices for theta in self.library.nearest(points, _STARTS)]
        return best_free_form(self.rig, points, starts, [] if from_template is None else [from_template])


@dataclass(frozen=True)
class Supervised:
    """points → FreeForm, from what a regressor says that knows the true vertices of its training scans.

    Attributes
    ----------
    rig : Rig
    mean, deviation : (d,) arrays
        Standardisation of the looks.
    network : MLPRegressor
        Standardised look → coefficients.
    centre : (3m,) array
    components : (k, 3m) array
        Principal components of the vertices, about the scan's centroid.
    """

    rig: object
    mean: np.ndarray
    deviation: np.ndarray
    network: object
    centre: np.ndarray
    components: np.ndarray

    def __call__(self, points):
        x = (look(points).vectors - self.mean) / self.deviation
        vertices = self.centre + self.network.predict(x).reshape(1, -1)[0] @ self.components
        return best_free_form(self.rig, points, [vertices.reshape(-1, 3)])


def taught(rig, scans, random_state):
    """The supervised baseline's regressor, from training scans and their true vertices.

    Parameters
    ----------
    rig : Rig
    scans : sequence of SyntheticScan
    random_state : int

    Returns
    -------
    Supervised
    """
    import warnings

    from sklearn.decomposition import PCA
    from sklearn.neural_network import MLPRegressor

    def shape_of(scan):
        return (scan.vertices - scan.points.mean(axis=0)).ravel().astype(np.float32)

    some = np.unique(np.linspace(0, len(scans) - 1, min(len(scans), _OF_COMPONENTS)).astype(int))
    shapes = np.array([shape_of(scans[i]) for i in some])
    centre = shapes.mean(axis=0)
    with one_thread():
        k = min(_COMPONENTS, len(some) - 1)
        seed = integer_seed(random_state, "components")
        components = PCA(k, svd_solver="randomized", random_state=seed).fit(shapes).components_
        both = [(look(scan.points).vectors[0], components @ (shape_of(scan) - centre)) for scan in scans]
        looks, coefficients = (np.array(values) for values in zip(*both, strict=True))
        mean, deviation = looks.mean(axis=0), looks.std(axis=0) + 1e-6
        network = MLPRegressor(
            hidden_layer_sizes=_HIDDEN,
            batch_size=min(64, len(scans)),
            max_iter=_EPOCHS,
            alpha=0.1,
            random_state=integer_seed(random_state, "supervised"),
        )
        unit = rig.size / 2  # coefficients of about 1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that all epochs were used is the plan
            network.fit((looks - mean) / deviation, coefficients / unit)
    return Supervised(rig, mean, deviation, network, centre, components * unit)
