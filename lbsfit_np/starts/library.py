"""Starts without labels: synthesised poses that look like the scan, and f, a regressor from the look of a scan to its pose.

Synthetic scans whose looks (``starts.look``) are nearest to a scan's have poses nearby; a regressor trained on the same pairs by

    L_Θ = ‖f(M(Θ', U^d)) − Θ'‖²

answers with a pose between them. Neither needs to be exact: the fit goes on from there. As looks do not depend on the unit and
can be taken under many turns, the same few thousand poses tell a scan's facing and its unit as well.
"""

from dataclasses import dataclass

import numpy as np

from ..errors import FileError
from ..interrupts import passing_interrupts
from ..seeds import integer_seed
from ..segmentation.stage import forward
from ..threads import one_thread
from ..workers import each
from .look import look

__all__ = ["PoseLibrary", "Start", "build_library"]

_ARRAYS = ("looks", "radii", "poses", "mean", "deviation")
_HIDDEN = (256, 128)
# Of more scans than these f takes no more steps: of 8,000 a fourth of the epochs, in a fourth of the time, leaves the same error
# on others (joints of one-sided, cropped bodies: 0.281 half sizes either way; of whole hands: 0.109, after all epochs 0.107).
_EPOCHS, _SO_MANY = 60, 2000
# Much, as scans are few beside the looks' 384 numbers: with a thousandth of it f learns its scans by heart and errs by nearly
# twice as much on others (joints of 1,500 scans of the coarse hand: 0.23 half sizes; with this 0.15).
_DECAY = 1.0
# A scan in a known unit is not taken for a pose whose extent differs by more than this factor: people's sizes, and holes.
_SAME_SIZE = 1.35


@dataclass(frozen=True)
class Start:
    """A pose to begin with.

    Attributes
    ----------
    theta : (J, 3) array
        Θ in a frame that faces the rig's way, radians.
    turn : int
        Row of the turns: the turn that leads from that frame to the scan's.
    scale : float
        Scan units per rig unit.
    away : float
        How different the looks are, as a squared distance.
    """

    theta: np.ndarray
    turn: int
    scale: float
    away: float


@dataclass(frozen=True, eq=False, repr=False)
class PoseLibrary:
    """Poses of synthetic scans, by the look of these scans, and the regressor f trained on them.

    Attributes
    ----------
    looks : (N, d) float32 array
    radii : (N,) array
        Radius of each scan, in rig units.
    poses : (N, J, 3) array
        Θ', radians.
    mean, deviation : (d,) float32 arrays
        Standardisation of the looks for f.
    layers : tuple of ((d_in, d_out) array, (d_out,) array)
        The layers of f, a multilayer perceptron with rectified units.
    """

    looks: np.ndarray
    radii: np.ndarray
    poses: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    layers: tuple

    def __post_init__(self):
        """Raise ValueError unless the arrays are finite and fit together, and what is divided by is positive."""
        arrays = self.looks, self.radii, self.poses, self.mean, self.deviation, *(a for layer in self.layers for a in layer)
        if not all(a.dtype.kind == "f" and np.isfinite(a).all() for a in arrays):
            raise ValueError("a library of poses with values that are not finite numbers")
        widths = [self.looks.shape[1:], *(w.shape[1:] for w, _ in self.layers)]
        fit = all((w.shape[0],) == width and b.shape == w.shape[1:] for (w, b), width in zip(self.layers, widths))
        ends = self.mean.shape == self.deviation.shape == self.looks.shape[1:] and widths[-1] == (self.poses[0].size,)
        if not (fit and ends and self.poses.ndim == 3 and len(self.poses) == len(self.looks) == len(self.radii)):
            raise ValueError("a library of poses whose arrays do not fit together")
        if self.radii.ndim != 1 or not (self.radii > 0).all() or not (self.deviation > 0).all():
            raise ValueError("a library of poses with radii or deviations that are not positive")

    def __repr__(self):
        n, J = self.poses.shape[:2]
        widths = " → ".join(str(w) for w in (self.looks.shape[1], *(len(b) for _, b in self.layers)))
        return f"<PoseLibrary: {n} poses of {J} joints, f {widths}>"

    def starts(self, points, turns, k, *, unit=None, within=_SAME_SIZE):
        """Find the poses whose scans look most like a scan, under any of some turns.

        Parameters
        ----------
        points : (n, 3) array
            Any origin.
        turns : (R, 3, 3) array
            As in :func:`~lbsfit_np.starts.look.look`.
        k : int
            Maximum number of starts.
        unit : float, optional
            Scan units per rig unit, where known. Only poses of about this size are then taken, or, if there are fewer than k of
            these, the k nearest in size.
        within : float, default 1.35
            Factor by which sizes may differ from that size.

        Returns
        -------
        list of Start
            The most alike first. Each pose comes once, under its best turn, and no turn has more than a third of all.
        """
        seen = look(points, turns)
        scales = seen.radius / self.radii
        away = (self.looks**2).sum(axis=1) - 2 * seen.vectors @ self.looks.T + (seen.vectors**2).sum(axis=1)[:, None]
        if unit is not None:
            off = np.abs(np.log(scales / unit))
            away[:, off > max(np.log(within), np.sort(off)[: max(k, 1)][-1])] = np.inf
        most = k if len(turns) == 1 else -(-k // 3)
        turn = away.argmin(axis=0)
        best = away[turn, np.arange(len(self.poses))]
        out, taken = [], np.zeros(len(turns), dtype=int)
        for n in np.argsort(best, kind="stable"):
            if len(out) == k or not np.isfinite(best[n]):
                break
            if taken[turn[n]] < most:
                taken[turn[n]] += 1
                out.append(Start(self.poses[n], int(turn[n]), float(scales[n]), float(best[n])))
        return out

    def nearest(self, points, k):
        """(at most k, J, 3): the poses whose scans look most like ``points`` (n, 3), which face the rig's way."""
        return np.array([start.theta for start in self.starts(points, np.eye(3)[None], k)])

    def regress(self, points):
        """(J, 3): f(X), the pose that the regressor sees in ``points``, which face the rig's way."""
        x = forward((look(points).vectors - self.mean) / self.deviation, self.layers)
        return x.reshape(self.poses.shape[1:]).astype(float)

    def arrays(self, prefix):
        """The library as named arrays; :meth:`from_arrays` reads them back."""
        out = {f"{prefix}_{name}": getattr(self, name) for name in _ARRAYS}
        for k, (weights, bias) in enumerate(self.layers):
            out[f"{prefix}_weights_{k}"], out[f"{prefix}_bias_{k}"] = weights, bias
        return out

    @classmethod
    def from_arrays(cls, arrays, prefix):
        """Make a library from what :meth:`arrays` gave."""
        n = sum(key.startswith(f"{prefix}_weights_") for key in arrays)
        layers = tuple((arrays[f"{prefix}_weights_{k}"], arrays[f"{prefix}_bias_{k}"]) for k in range(n))
        return cls(*(arrays[f"{prefix}_{name}"] for name in _ARRAYS), layers)

    def save(self, path):
        """Write as NPZ, without pickle; :meth:`load` reads it."""
        from ..io.write import check_npz_name, write_npz

        check_npz_name(path)
        write_npz(path, **self.arrays("library"))

    @classmethod
    def load(cls, path):
        """Read what :meth:`save` wrote."""
        from ..io.npz import read_npz

        arrays = read_npz(path)
        try:
            return cls.from_arrays(arrays, "library")
        except (KeyError, ValueError, IndexError, TypeError, AttributeError) as error:
            raise FileError(str(path), f"a file whose content does not fit ({error})", "a library of poses") from None


def build_library(scan, n_scans, *, random_state, jobs=1, progress=None):
    """Build a library of synthetic scans, and train f on it with scikit-learn's MLPRegressor.

    Parameters
    ----------
    scan : callable
        i → the i-th SyntheticScan, facing the rig's way; picklable for more than one process.
    n_scans : int
    random_state : int
    jobs : int, default 1
        Number of processes.
    progress : callable, optional
        Called with the share done, in [0, 1].

    Returns
    -------
    PoseLibrary

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C, once all processes have ended; what is half trained is never returned.
    """
    looks, radii, poses = zip(*each(_Seen(scan), range(n_scans), jobs=jobs, done=progress), strict=True)
    return _trained(np.array(looks), np.array(radii), np.array(poses), random_state)


@dataclass(frozen=True)
class _Seen:
    scan: object

    def __call__(self, i):
        scan = self.scan(i)
        seen = look(scan.points)
        return seen.vectors[0], seen.radius / scan.scale, scan.pose


def _trained(looks, radii, poses, random_state):
    import warnings

    from sklearn.neural_network import MLPRegressor

    mean = looks.mean(axis=0)
    deviation = looks.std(axis=0) + np.float32(1e-6)
    epochs = round(_EPOCHS * min(1.0, _SO_MANY / len(looks))) or 1
    network = MLPRegressor(
        hidden_layer_sizes=_HIDDEN,
        batch_size=min(64, len(looks)),
        max_iter=epochs,
        tol=0.0,
        n_iter_no_change=epochs,
        learning_rate_init=1e-3,
        alpha=_DECAY,
        random_state=integer_seed(random_state, "regressor"),
    )
    with one_thread(), passing_interrupts(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that all epochs were used is the plan, no failure to converge
        network.fit((looks - mean) / deviation, poses.reshape(len(poses), -1).astype(np.float32))
    if len(network.loss_curve_) < epochs:
        raise KeyboardInterrupt  # one that was no signal, such as another thread can raise here
    layers = tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in zip(network.coefs_, network.intercepts_))
    return PoseLibrary(looks, radii, poses, mean, deviation, layers)
