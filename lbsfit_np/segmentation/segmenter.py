"""The segmenter s: X → the part of each point; a scikit-learn classifier on point descriptors."""

import json
from dataclasses import asdict, dataclass

import numpy as np

from ..errors import FileError, InputError
from ..seeds import generator, integer_seed
from .descriptors import Descriptor

__all__ = ["Segmenter", "Training", "train_segmenter"]

_FORMAT = 1


@dataclass(frozen=True)
class Training:
    """How the classifier is trained.

    Attributes
    ----------
    points_per_scan : int
        Points described in each scan, drawn by the seed.
    hidden : tuple of int
        Hidden layers of the MLPClassifier.
    epochs : int
    average_from : int
        Epoch from which on the weights are averaged.
    learning_rate : float
    """

    points_per_scan: int = 120
    hidden: tuple = (384, 192, 96)
    epochs: int = 4
    average_from: int = 1
    learning_rate: float = 2e-3


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

    def __post_init__(self):
        """Raise ValueError unless the arrays fit together, so that no broken file fails later, far from its name."""
        widths = [self.descriptor.size]
        if self.classifier is not None:
            for w, b in zip(self.classifier.coefs_, self.classifier.intercepts_, strict=True):
                if w.ndim != 2 or w.shape[0] != widths[-1] or b.shape != w.shape[1:]:
                    raise ValueError("layers that do not fit together")
                widths.append(w.shape[1])
            classes = np.asarray(self.classifier.classes_)
            outputs = widths[-1] if widths[-1] > 1 else 2
            if classes.dtype.kind not in "iu" or classes.shape != (outputs,) or classes.min() < 0 or classes.max() >= self.n_parts:
                raise ValueError("classes that do not fit the parts")
        if self.mean.shape != (self.descriptor.size,) or self.deviation.shape != (self.descriptor.size,):
            raise ValueError("a standardisation that does not fit the descriptor")

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


def train_segmenter(rig, scan, n_scans, *, training=None, descriptor=None, random_state=None, n_jobs=None, progress=None):
    """Train s on labelled scans of a rig.

    Parameters
    ----------
    rig : Rig
        The welded rig.
    scan : callable
        i → (points, labels, scale) of scan i: points in the scan's unit, labels that index rig.parts, and the scan's units
        in a rig unit. Picklable where ``n_jobs`` asks for processes.
    n_scans : int
    training : Training, optional
    descriptor : Descriptor, optional
    random_state : int or None
    n_jobs : int, optional
        Processes that synthesise and describe scans; the result does not depend on it.
    progress : callable, optional
        Called with the share done, in [0, 1].

    Returns
    -------
    Segmenter
    """
    from joblib import Parallel, delayed
    from threadpoolctl import threadpool_limits

    descriptor, training = descriptor or Descriptor(), training or Training()
    progress = progress or (lambda share: None)
    half = rig.size / 2
    batches = np.array_split(np.arange(n_scans), max(1, n_scans // 50))
    described = Parallel(n_jobs=n_jobs, return_as="generator")(
        delayed(_describe)(scan, batch, descriptor, half, training.points_per_scan, random_state) for batch in batches
    )
    X, y = [], []
    for k, (x, labels) in enumerate(described):
        X.append(x)
        y.append(labels)
        progress(_DESCRIBING * (k + 1) / len(batches))
    X, y = np.concatenate(X), np.concatenate(y)
    mean, deviation = X.mean(axis=0, dtype=float).astype(np.float32), X.std(axis=0, dtype=float).astype(np.float32) + np.float32(1e-6)
    X -= mean
    X /= deviation
    classifier = None
    if len(np.unique(y)) > 1:
        with threadpool_limits(1):  # the result must not depend on the number of threads, and a second one gains little
            classifier = _train(X, y, training, random_state, lambda share: progress(_DESCRIBING + (1 - _DESCRIBING) * share))
    return Segmenter(classifier, mean, deviation, descriptor, len(rig.parts), half, rig.digest)


# Share of the training time that goes into synthesis and descriptors, for the progress bar.
_DESCRIBING = 0.5


def _describe(scan, indices, descriptor, half, points_per_scan, random_state):
    """Descriptors and labels of some points of some scans."""
    X, y = [], []
    for i in indices:
        points, labels, scale = scan(int(i))
        rng = generator(random_state, "segmenter points", int(i))
        rows = rng.choice(len(points), min(points_per_scan, len(points)), replace=False)
        X.append(descriptor(points / (scale * half), rows))
        y.append(labels[rows])
    return np.concatenate(X), np.concatenate(y)


def _train(X, y, training, random_state, progress):
    """Epochs of Adam in chunks; the weights after each chunk past the first epochs are averaged, which generalises better."""
    from sklearn.neural_network import MLPClassifier

    classifier = MLPClassifier(
        training.hidden,
        batch_size=min(1024, len(X)),
        learning_rate_init=training.learning_rate,
        random_state=integer_seed(random_state, "segmenter"),
    )
    rng = generator(random_state, "segmenter order")
    classes = np.unique(y)
    averaged, count = None, 0
    for epoch in range(training.epochs):
        for k, rows in enumerate(np.array_split(rng.permutation(len(X)), _CHUNKS)):
            classifier.partial_fit(X[rows], y[rows], classes=classes)
            progress((epoch + (k + 1) / _CHUNKS) / training.epochs)
            if epoch >= training.average_from:
                count += 1
                now = classifier.coefs_ + classifier.intercepts_
                averaged = [w.copy() for w in now] if averaged is None else [a + (w - a) / count for a, w in zip(averaged, now, strict=True)]
    n = len(classifier.coefs_)
    classifier.coefs_, classifier.intercepts_ = averaged[:n], averaged[n:]
    return classifier


# Chunks an epoch: how often the weights are looked at for the average.
_CHUNKS = 4


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
