"""Stage: one standardised classifier that scikit-learn trains, kept as arrays so that neither a file nor an answer needs it."""

import warnings
from dataclasses import dataclass, replace
from numbers import Real

import numpy as np

from ..errors import InputError, brief, is_whole
from ..interrupts import passing_interrupts
from ..seeds import generator, integer_seed
from ..threads import one_thread

__all__ = ["LARGEST", "Stage", "Training", "forward", "in_half_precision", "train_stage"]


@dataclass(frozen=True)
class Training:
    """How the classifiers are trained.

    Attributes
    ----------
    points_per_scan : int
        Number of points described in each scan, drawn by the seed.
    hidden : tuple of int
        Sizes of the hidden layers of the MLPClassifier.
    epochs : int
    average_from : int
        Epoch from which the weights are averaged; the last epoch if there are not that many.
    learning_rate : float
    second : float
        Share of the scans that train the second stage; 0 leaves it out. The first stage never sees them, so that the second
        learns from answers that are as good as those for a new scan.
    """

    points_per_scan: int = 360
    hidden: tuple = (256, 128, 64)
    epochs: int = 4
    average_from: int = 1
    learning_rate: float = 2e-3
    second: float = 0.5

    def __post_init__(self):
        """Raise InputError where a value is out of its range."""
        for name, least in (("points_per_scan", 1), ("epochs", 1), ("average_from", 0)):
            if not is_whole(value := getattr(self, name), least):
                raise InputError(name, brief(value), f"a whole number of at least {least}")
        if not isinstance(self.hidden, (tuple, list)) or not self.hidden or not all(is_whole(h, 1) for h in self.hidden):
            raise InputError("hidden", brief(self.hidden), "sizes of one or more layers")
        for name, least, most in (("learning_rate", 1e-12, 1.0), ("second", 0.0, 0.9)):
            value = getattr(self, name)
            if not isinstance(value, Real) or isinstance(value, bool) or not least <= value <= most:
                raise InputError(name, brief(value), f"a number from {least:g} to {most:g}")

    def going_on(self, start):
        """The same with the layers of a segmenter that training goes on from; itself without one."""
        hidden = start and next(filter(None, (stage.hidden for stage in start.stages)), None)
        return replace(self, hidden=hidden) if hidden else self


# Chunks an epoch: how often the weights are looked at for the average, and what part of the data is standardised at a time.
_CHUNKS = 4
# Rows at a time of which moments are taken, to bound memory.
_BLOCK = 8192
# Half precision's step near 1: what varies by less in training says nothing, and is not to be made large by standardising.
_STEP = 2.0**-10
# What it can hold.
LARGEST = 6e4


@dataclass(frozen=True)
class Stage:
    """A classifier of standardised descriptions: a multilayer perceptron with rectified units, as scikit-learn has trained it.

    It answers by itself, with the very numbers of MLPClassifier: to import scikit-learn takes longer than to label a scan.

    Attributes
    ----------
    mean, deviation : (d,) arrays
    layers : tuple of ((d_in, d_out) array, (d_out,) array)
        Empty where all points are of one part. Of two parts there is one output, the logit of the second.
    classes : (m,) int array
        The parts of the outputs.
    n_parts : int
    """

    mean: np.ndarray
    deviation: np.ndarray
    layers: tuple
    classes: np.ndarray
    n_parts: int

    def __post_init__(self):
        """Raise ValueError unless the arrays are finite and fit together: no broken file is to fail later, far from its name."""
        if not all(a.dtype.kind == "f" and np.isfinite(a).all() for a in (self.mean, self.deviation, *self._weights())):
            raise ValueError("values that are not finite numbers")
        if self.mean.ndim != 1 or self.mean.shape != self.deviation.shape or not (self.deviation > 0).all():
            raise ValueError("a mean and deviations that do not fit together")
        width = len(self.mean)
        for w, b in self.layers:
            if w.ndim != 2 or w.shape[0] != width or b.shape != w.shape[1:]:
                raise ValueError("layers that do not fit together")
            width = w.shape[1]
        outputs = (width if width > 1 else 2) if self.layers else 1
        classes = self.classes
        if classes.dtype.kind not in "iu" or classes.shape != (outputs,) or classes.min() < 0 or classes.max() >= self.n_parts:
            raise ValueError("classes that do not fit the parts")

    def _weights(self):
        return [array for layer in self.layers for array in layer]

    @property
    def hidden(self):
        """Sizes of the hidden layers; None without a classifier."""
        return tuple(len(b) for _, b in self.layers[:-1]) if self.layers else None

    def predict_proba(self, X):
        """(k, n_parts) probabilities of (k, d) float32 descriptions."""
        proba = np.zeros((len(X), self.n_parts))
        if not self.layers:
            proba[:, self.classes] = 1.0
            return proba
        X = in_half_precision(X).astype(np.float32)  # as in training: what is constant there must be the same here
        X -= self.mean
        X /= self.deviation
        X = forward(X, self.layers)
        proba[:, self.classes] = _softmax(X) if X.shape[1] > 1 else _logistic(X)
        return proba

    def arrays(self, prefix):
        """The stage as named arrays; :meth:`from_arrays` reads them back."""
        out = {f"{prefix}_mean": self.mean, f"{prefix}_deviation": self.deviation}
        out[f"{prefix}_only"] = np.array(0 if self.layers else int(self.classes[0]))
        if self.layers:
            out[f"{prefix}_classes"] = self.classes
            for k, (w, b) in enumerate(self.layers):
                out[f"{prefix}_coefs_{k}"], out[f"{prefix}_intercepts_{k}"] = w, b
        return out

    @classmethod
    def from_arrays(cls, arrays, prefix, n_parts):
        """A stage from what :meth:`arrays` gave."""
        n = sum(k.startswith(f"{prefix}_coefs_") for k in arrays)
        layers = tuple((arrays[f"{prefix}_coefs_{k}"], arrays[f"{prefix}_intercepts_{k}"]) for k in range(n))
        only = np.array([int(arrays[f"{prefix}_only"])])
        classes = arrays[f"{prefix}_classes"] if n else only
        return cls(arrays[f"{prefix}_mean"], arrays[f"{prefix}_deviation"], layers, classes, n_parts)


def forward(X, layers):
    """(k, d_out): what a multilayer perceptron with rectified units makes of (k, d_in) inputs, before any softmax."""
    for k, (w, b) in enumerate(layers):
        X = X @ w
        X += b
        if k + 1 < len(layers):
            np.maximum(X, 0, out=X)
    return X


def _softmax(X):
    X = np.exp(X - X.max(axis=1)[:, None])
    X /= X.sum(axis=1)[:, None]
    return X


def _logistic(X):
    from scipy.special import expit

    second = expit(X)
    return np.hstack([1 - second, second])


@one_thread()  # the result must not depend on the number of threads, and a second one gains little
def train_stage(X, y, n_parts, training, random_state, name, progress, *, start=None):
    """Train one stage: epochs of Adam in chunks, and the mean of the weights over the later ones, which generalises better.

    Parameters
    ----------
    X : (k, d) float16 array
        Of :func:`in_half_precision`.
    y : (k,) int array
    n_parts : int
    training : Training
    random_state : int or None
    name : str
        Names the random streams.
    progress : callable
        Called with the share done.
    start : Stage, optional
        Go on from these weights and this standardisation; taken up only where it knows the same parts.

    Returns
    -------
    Stage

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C, at once: what is trained by half is never returned.
    """
    from sklearn.neural_network import MLPClassifier

    if not len(y):
        raise InputError("scan", "scans without a point that has a label", "labels from 0 to the number of parts")
    mean, deviation = _moments(X)
    classes = np.unique(y)
    if start is not None and not (start.layers and np.isin(classes, start.classes).all()):
        start = None
    if start is not None:
        mean, deviation, classes = start.mean, start.deviation, start.classes
    if len(classes) == 1:
        progress(1.0)
        return Stage(mean, deviation, (), classes, n_parts)

    def standardised(rows):
        x = X[rows].astype(np.float32)
        x -= mean
        x /= deviation
        return x

    classifier = MLPClassifier(
        training.hidden,
        batch_size=max(1, min(1024, len(X) // _CHUNKS)),
        learning_rate_init=training.learning_rate,
        random_state=integer_seed(random_state, name),
    )
    if start is not None:  # scikit-learn makes its optimiser with the weights, so they are written into what it made
        some = slice(classifier.batch_size)
        _fit_chunk(classifier, standardised(some), y[some], classes)
        for w, b, (given_w, given_b) in zip(classifier.coefs_, classifier.intercepts_, start.layers, strict=True):
            w[...], b[...] = given_w, given_b
    rng = generator(random_state, name, "order")
    averaged, count = None, 0
    for epoch in range(training.epochs):
        chunks = np.array_split(rng.permutation(len(X)), min(_CHUNKS, len(X)))
        for k, rows in enumerate(chunks):
            _fit_chunk(classifier, standardised(rows), y[rows], classes)
            progress((epoch + (k + 1) / len(chunks)) / training.epochs)
            if epoch >= min(training.average_from, training.epochs - 1):
                count += 1
                now = classifier.coefs_ + classifier.intercepts_
                if averaged is None:
                    averaged = [w.copy() for w in now]
                else:
                    averaged = [a + (w - a) / count for a, w in zip(averaged, now, strict=True)]
    n = len(classifier.coefs_)
    return Stage(mean, deviation, tuple(zip(averaged[:n], averaged[n:], strict=True)), classes, n_parts)


def in_half_precision(X):
    """Descriptions as a stage learns from them: a thousandth of a length is finer than the voxels, and takes half the memory."""
    return np.clip(X, -LARGEST, LARGEST).astype(np.float16)


def _moments(X):
    """Mean and deviation of each column, float32, the latter at least half precision's step."""
    total = squares = 0.0
    for start in range(0, len(X), _BLOCK):
        x = X[start : start + _BLOCK].astype(float)
        total, squares = total + x.sum(axis=0), squares + (x**2).sum(axis=0)
    mean = total / len(X)
    deviation = np.sqrt(np.maximum(squares / len(X) - mean**2, 0.0))
    return mean.astype(np.float32), np.maximum(deviation, _STEP).astype(np.float32)


def _fit_chunk(classifier, X, y, classes):
    """One ``partial_fit``, whole or with a KeyboardInterrupt."""
    losses = len(getattr(classifier, "loss_curve_", ()))
    with passing_interrupts(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Training interrupted")  # it is raised, which says enough
        classifier.partial_fit(X, y, classes=classes)
    if len(classifier.loss_curve_) == losses:
        raise KeyboardInterrupt  # one that was no signal, such as another thread can raise here
