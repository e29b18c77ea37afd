"""Starts without labels: synthesised poses that look like the scan, and f, a regressor from the look of a scan to its pose.

The look of a scan is its distance from fixed points around its centroid, near to far (a basis point set): one vector, whatever
the number of points. Synthetic scans whose vectors are nearest have poses nearby; a regressor trained on the same pairs by

    L_Θ = ‖f(M(Θ', U^d)) − Θ'‖²

answers with a pose between them. Neither needs to be exact: the fit goes on from there.
"""

from dataclasses import dataclass

import numpy as np

from ..seeds import integer_seed
from ..segmentation.descriptors import describe_scan

__all__ = ["PoseLibrary", "build_library"]

_HIDDEN = (256, 128)
_EPOCHS = 60
# Much, as scans are few beside the looks' 384 numbers: with a thousandth of it f learns its scans by heart and errs by nearly
# twice as much on others (joints of 1,500 scans of the coarse hand: 0.23 half sizes; with this 0.15).
_DECAY = 1.0


@dataclass(frozen=True)
class PoseLibrary:
    """Poses of synthetic scans by the look of these scans, and the regressor f trained on them.

    Attributes
    ----------
    looks : (N, d) float32 array
    poses : (N, J, 3) array
        Θ', radians.
    mean, deviation : (d,) float32 arrays
        Standardisation of the looks for f.
    layers : tuple of ((d_in, d_out) array, (d_out,) array)
        Of f, a multilayer perceptron with rectified units.
    """

    looks: np.ndarray
    poses: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    layers: tuple

    def __post_init__(self):
        """Raise ValueError unless the arrays fit together."""
        widths = [self.looks.shape[1:], *(w.shape[1:] for w, _ in self.layers)]
        fit = all((w.shape[0],) == width and b.shape == w.shape[1:] for (w, b), width in zip(self.layers, widths))
        ends = self.mean.shape == self.deviation.shape == self.looks.shape[1:] and widths[-1] == (self.poses[0].size,)
        if not (fit and ends and self.poses.ndim == 3 and len(self.poses) == len(self.looks)):
            raise ValueError("a library of poses whose arrays do not fit together")

    def nearest(self, points, k):
        """(k, J, 3): the poses whose scans look most like ``points`` (n, 3), given in half sizes of the rig."""
        away = ((self.looks - describe_scan(points)) ** 2).sum(axis=1)
        return self.poses[np.argsort(away, kind="stable")[:k]]

    def regress(self, points):
        """(J, 3): f(X), the pose that the regressor sees in ``points``."""
        x = ((describe_scan(points) - self.mean) / self.deviation)[None]
        for k, (weights, bias) in enumerate(self.layers):
            x = x @ weights + bias
            if k + 1 < len(self.layers):
                x = np.maximum(x, 0.0)
        return x.reshape(self.poses.shape[1:]).astype(float)

    def arrays(self, prefix):
        """The library as named arrays; :meth:`from_arrays` reads them back."""
        out = {f"{prefix}_{name}": getattr(self, name) for name in ("looks", "poses", "mean", "deviation")}
        for k, (weights, bias) in enumerate(self.layers):
            out[f"{prefix}_weights_{k}"], out[f"{prefix}_bias_{k}"] = weights, bias
        return out

    @classmethod
    def from_arrays(cls, arrays, prefix):
        """A library from what :meth:`arrays` gave."""
        n = sum(key.startswith(f"{prefix}_weights_") for key in arrays)
        layers = tuple((arrays[f"{prefix}_weights_{k}"], arrays[f"{prefix}_bias_{k}"]) for k in range(n))
        return cls(*(arrays[f"{prefix}_{name}"] for name in ("looks", "poses", "mean", "deviation")), layers)


def build_library(looks, poses, *, random_state):
    """A library of synthetic scans, and f trained on it with scikit-learn's MLPRegressor.

    Parameters
    ----------
    looks : (N, d) float32 array
        ``describe_scan`` of each.
    poses : (N, J, 3) array
        Their Θ'.
    random_state : int

    Returns
    -------
    PoseLibrary
    """
    import warnings

    from sklearn.neural_network import MLPRegressor
    from threadpoolctl import threadpool_limits

    mean = looks.mean(axis=0)
    deviation = looks.std(axis=0) + np.float32(1e-6)
    network = MLPRegressor(
        hidden_layer_sizes=_HIDDEN,
        batch_size=min(64, len(looks)),
        max_iter=_EPOCHS,
        tol=0.0,
        n_iter_no_change=_EPOCHS,
        learning_rate_init=1e-3,
        alpha=_DECAY,
        random_state=integer_seed(random_state, "regressor"),
    )
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that all epochs were used is the plan, no failure to converge
        network.fit((looks - mean) / deviation, poses.reshape(len(poses), -1).astype(np.float32))
    layers = tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in zip(network.coefs_, network.intercepts_))
    return PoseLibrary(looks, poses, mean, deviation, layers)
