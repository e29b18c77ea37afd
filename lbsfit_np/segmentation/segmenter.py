"""The segmenter s: X → the part of each point; a scikit-learn classifier on point descriptors."""

import json
import warnings
from dataclasses import asdict, dataclass

import numpy as np

from ..errors import FileError, InputError
from ..seeds import generator, integer_seed
from .descriptors import Descriptor

__all__ = ["Segmenter", "train_segmenter"]

_FORMAT = 1


@dataclass(frozen=True)
class Segmenter:
    """A trained segmenter, tied to one rig.

    Attributes
    ----------
    classifier : sklearn.neural_network.MLPClassifier
    mean, deviation : (d,) arrays
        Standardisation of the descriptors.
    descriptor : Descriptor
    n_parts : int
    half : float
        Half of the rig's size: what one descriptor unit is, in rig units.
    rig_digest : str
        ``Rig.digest`` of the welded rig that it was trained on.
    """

    classifier: object
    mean: np.ndarray
    deviation: np.ndarray
    descriptor: Descriptor
    n_parts: int
    half: float
    rig_digest: str

    def predict_proba(self, points, *, scale=1.0, rows=None):
        """Probability of each part for points of a scan.

        Parameters
        ----------
        points : (n, 3) array
            The scan, in its own unit.
        scale : float, default 1
            The scan's units in a rig unit.
        rows : (k,) int array, optional
            Which points; all by default.

        Returns
        -------
        (k, n_parts) array
            Rows sum to 1.
        """
        X = self.descriptor(np.asarray(points, dtype=float) / (scale * self.half), rows)
        proba = np.zeros((len(X), self.n_parts))
        if self.classifier is None:
            proba[:, 0] = 1.0
            return proba
        X -= self.mean
        X /= self.deviation
        p = self.classifier.predict_proba(X)
        proba[:, self.classifier.classes_] = p
        return proba

    def predict(self, points, *, scale=1.0, rows=None):
        """(k,) int: the most probable part of each point; arguments as in :meth:`predict_proba`."""
        return self.predict_proba(points, scale=scale, rows=rows).argmax(axis=1)

    def check_rig(self, rig):
        """Raise unless this segmenter belongs to ``rig``."""
        if rig.welded.digest != self.rig_digest:
            raise InputError(
                "segmenter",
                "one that was trained on another rig (or on other parts or limits of this one)",
                f"one of rig {rig.name!r} with {len(rig.parts)} parts",
                "Train it again with fitter.pretrain().",
            )

    def save(self, path):
        """Write as NPZ: arrays and one JSON text, no pickle; :meth:`load` executes nothing from it."""
        from ..io.write import write_npz

        header = {
            "format": _FORMAT,
            "descriptor": asdict(self.descriptor),
            "n_parts": self.n_parts,
            "half": self.half,
            "rig_digest": self.rig_digest,
            "out_activation": None if self.classifier is None else self.classifier.out_activation_,
        }
        arrays = {"mean": self.mean, "deviation": self.deviation}
        if self.classifier is not None:
            arrays["classes"] = self.classifier.classes_
            for k, (w, b) in enumerate(zip(self.classifier.coefs_, self.classifier.intercepts_)):
                arrays[f"coefs_{k}"], arrays[f"intercepts_{k}"] = w, b
        write_npz(path, lbsfit_np_segmenter=np.array(json.dumps(header)), **arrays)

    @classmethod
    def load(cls, path):
        """Read what :meth:`save` wrote."""
        try:
            with np.load(path, allow_pickle=False) as z:
                header = json.loads(str(z["lbsfit_np_segmenter"]))
                arrays = {k: z[k] for k in z.files if k != "lbsfit_np_segmenter"}
            if header["format"] != _FORMAT:
                raise FileError(str(path), f"segmenter format {header['format']}", f"format {_FORMAT}", "Train it again.")
            n_layers = sum(k.startswith("coefs_") for k in arrays)
            classifier = None if not n_layers else _rebuilt(arrays, n_layers, header["out_activation"])
            return cls(
                classifier,
                arrays["mean"],
                arrays["deviation"],
                Descriptor(**header["descriptor"]),
                int(header["n_parts"]),
                float(header["half"]),
                header["rig_digest"],
            )
        except FileNotFoundError:
            raise FileError(str(path), "no such file", "a segmenter that was saved with Segmenter.save") from None
        except FileError:
            raise
        except Exception as error:  # zipfile, json, keys: whatever is wrong with it, it is not one of ours
            raise FileError(str(path), f"a file that cannot be read ({error})", "a segmenter that was saved with Segmenter.save") from None


def train_segmenter(rig, scans, *, points_per_scan=150, hidden=(256, 128), epochs=12, descriptor=None, random_state=None):
    """Train s on labelled scans of a rig.

    Parameters
    ----------
    rig : Rig
        The welded rig.
    scans : iterable of (points, labels, scale)
        Points in the scan's unit, labels that index rig.parts, and the scan's units in a rig unit.
    points_per_scan : int
        Points described in each scan, drawn by the seed.
    hidden : tuple of int
        Hidden layers of the MLPClassifier.
    epochs : int
    descriptor : Descriptor, optional
    random_state : int or None

    Returns
    -------
    Segmenter
    """
    descriptor = descriptor or Descriptor()
    half = rig.size / 2
    X, y = [], []
    for i, (points, labels, scale) in enumerate(scans):
        rng = generator(random_state, "segmenter points", i)
        rows = rng.choice(len(points), min(points_per_scan, len(points)), replace=False)
        X.append(descriptor(np.asarray(points) / (scale * half), rows))
        y.append(np.asarray(labels)[rows])
    X, y = np.concatenate(X), np.concatenate(y)
    mean, deviation = X.mean(axis=0, dtype=float).astype(np.float32), X.std(axis=0, dtype=float).astype(np.float32) + np.float32(1e-6)
    X -= mean
    X /= deviation
    n_parts = len(rig.parts)
    classifier = None
    if len(np.unique(y)) > 1:
        classifier = _train(X, y, hidden, epochs, integer_seed(random_state, "segmenter"))
    return Segmenter(classifier, mean, deviation, descriptor, n_parts, half, rig.digest)


def _train(X, y, hidden, epochs, seed):
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPClassifier

    classifier = MLPClassifier(
        hidden, batch_size=min(1024, len(X)), max_iter=epochs, learning_rate_init=2e-3, n_iter_no_change=epochs, random_state=seed
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the number of epochs is the budget, not a failure
        return classifier.fit(X, y)


def _rebuilt(arrays, n_layers, out_activation):
    """An MLPClassifier that predicts, from its fitted attributes."""
    from sklearn.neural_network import MLPClassifier

    coefs = [arrays[f"coefs_{k}"] for k in range(n_layers)]
    classifier = MLPClassifier(tuple(w.shape[1] for w in coefs[:-1]))
    classifier.coefs_ = coefs
    classifier.intercepts_ = [arrays[f"intercepts_{k}"] for k in range(n_layers)]
    classifier.classes_ = arrays["classes"]
    classifier.n_features_in_ = coefs[0].shape[0]
    classifier.n_layers_ = n_layers + 1
    classifier.n_outputs_ = coefs[-1].shape[1]
    classifier.out_activation_ = out_activation
    return classifier
