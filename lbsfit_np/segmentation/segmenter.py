"""The segmenter s: X → the part of each point; scikit-learn classifiers on point descriptors, the second in context."""

import json
from dataclasses import asdict, dataclass
from numbers import Real

import numpy as np

from ..errors import FileError, InputError, as_array, brief, check_callables, is_whole
from ..losses.checks import as_float, check_set
from ..rig.rig import Rig
from ..rotations import matrix_from_rotvec
from ..scan import some_rows
from ..seeds import check_random_state, generator
from ..threads import one_thread
from ..workers import each, processors, startable
from .context import CONTEXT_POINTS, context, context_size
from .descriptors import Descriptor, within_reach
from .stage import LARGEST, Stage, Training, in_half_precision, train_stage

__all__ = ["Segmenter", "jobs_of", "train_segmenter"]

_FORMAT = 3
# What the file of a segmenter has, and no other.
_KEY = "lbsfit_np_segmenter"
# Axes about which the copies of a scan that it is labelled by are turned: a tetrahedron's, as far from each other as can be.
_AXES = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
# By how much, radians, and how far the root has to turn either way in training for that; less where it turns less.
_TURN, _ROOT = 0.25, 0.6
# Points that are described at a time, of 6 KB each; those of a fit are not as many.
_BLOCK = 8192
# Coordinates of which differences are finite.
_FINITE = 1e300


@dataclass(frozen=True, eq=False, repr=False)
class Segmenter:
    """A trained segmenter, tied to one rig.

    Attributes
    ----------
    stages : tuple of one or two Stage
        The first sees a point's descriptor; the second also sees what the first said about the point's surroundings.
    descriptor : Descriptor
    n_parts : int
    half : float
        Half of the rig's size, in rig units: the length of one descriptor unit.
    rig_digest : str
        ``Rig.digest`` of the welded rig that the segmenter was trained on.
    turn : float
        Angle, in radians, by which :meth:`predict_proba` turns the copies of a scan that it labels. 0 where the rig's root does
        not turn, as no training scan was turned then.
    """

    stages: tuple
    descriptor: Descriptor
    n_parts: int
    half: float
    rig_digest: str
    turn: float

    def __post_init__(self):
        """Raise ValueError unless the stages fit the descriptor and each other, and half and turn can be."""
        if not 0 < self.half < np.inf:
            raise ValueError(f"a half size of {self.half}")
        if not 0 <= self.turn <= _TURN:
            raise ValueError(f"views turned by {self.turn}")
        widths = [self.descriptor.size, self.descriptor.size + context_size(self.n_parts)]
        if not 1 <= len(self.stages) <= 2 or any(len(s.mean) != w for s, w in zip(self.stages, widths, strict=False)):
            raise ValueError("stages that do not fit the descriptor")

    def __repr__(self):
        stages = f"{len(self.stages)} stage{'s' * (len(self.stages) > 1)}"
        return f"<Segmenter: {self.n_parts} parts, {self.descriptor.size} numbers per point, {stages}>"

    @one_thread()
    def predict_proba(self, points, *, scale=1.0, rows=None, views=4):
        """Give the probability of each part for points of a scan, as the mean over slightly turned copies.

        Voxels, probes and what the classifiers happen to have learned fall differently on each copy, so that errors cancel. The
        order of the points has a little say: every so-manieth of them tells what is around a point. In another order three or
        four points in a hundred get another part, of single scans up to eight.

        Parameters
        ----------
        points : (n, 3) array or Scan
            The scan, in its own unit; n ≥ 1, finite.
        scale : float, default 1
            Scan units per rig unit.
        rows : (k,) int array, optional
            Which points to label; all by default.
        views : {4, 1}
            Number of copies, each turned by ``turn``. 1 takes the scan as it is, in a quarter of the time; fits use 1, as their
            last steps use no labels.

        Returns
        -------
        (k, n_parts) array
            Rows sum to 1.

        Raises
        ------
        InputError
            Points, a scale or rows that cannot be used.
        """
        points = check_set("points", getattr(points, "points", points), most=1e305)  # with room for what is computed of them
        if isinstance(scale, bool) or not isinstance(scale, Real) or not 1e-100 <= as_float(scale) <= 1e100:
            raise InputError("scale", brief(scale), "a positive number, from 1e-100 to 1e100")
        rows = np.arange(len(points)) if rows is None else _checked_rows(rows, len(points))
        if isinstance(views, bool) or not isinstance(views, Real) or views not in (1, len(_AXES)):
            raise InputError("views", brief(views), f"{len(_AXES)}, or 1")
        with np.errstate(over="ignore"):
            points = points / (float(scale) * self.half)
        middle = np.median(points, axis=0)
        if np.abs(middle).max() > LARGEST:  # what is subtracted below would be lost
            points = np.clip(points, -_FINITE, _FINITE)
            points, middle = points - np.median(points, axis=0), np.zeros(3)
        points = np.clip(points, middle - LARGEST, middle + LARGEST)  # further away is all the same
        if views == 1 or not self.turn:
            return self._proba(points, rows)
        return sum(self._proba(points @ R.T, rows) for R in matrix_from_rotvec(self.turn * _AXES)) / len(_AXES)

    def _proba(self, points, rows):
        """Probabilities of one view, in half sizes of the rig."""
        *first, last = self.stages
        described = _described(points, rows, self.descriptor, *first)
        return np.concatenate([last.predict_proba(x) for x in described])

    def predict(self, points, *, scale=1.0, rows=None, views=4):
        """(k,) int: the most probable part of each point; arguments as in :meth:`predict_proba`."""
        return self.predict_proba(points, scale=scale, rows=rows, views=views).argmax(axis=1)

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
        """Write as NPZ: arrays and one JSON text, without pickle; :meth:`load` executes nothing from it."""
        from ..io.write import check_npz_name, write_npz

        check_npz_name(path)
        header = json.dumps({"format": _FORMAT} | self.header())
        write_npz(path, **{_KEY: np.array(header)}, **self.arrays("stage"))

    def header(self):
        """Everything but the stages' arrays, as plain data for JSON."""
        plain = {name: getattr(self, name) for name in ("n_parts", "half", "rig_digest", "turn")}
        return plain | {"descriptor": asdict(self.descriptor), "stages": len(self.stages)}

    def arrays(self, prefix):
        """The stages as named arrays; :meth:`from_arrays` reads them back."""
        return {name: a for k, stage in enumerate(self.stages) for name, a in stage.arrays(f"{prefix}_{k}").items()}

    @classmethod
    def from_arrays(cls, header, arrays, prefix):
        """Make a segmenter from what :meth:`header` and :meth:`arrays` gave; KeyError, ValueError or the like if it is broken."""
        n_parts = int(header["n_parts"])
        stages = tuple(Stage.from_arrays(arrays, f"{prefix}_{k}", n_parts) for k in range(int(header["stages"])))
        half, turn = float(header["half"]), float(header["turn"])
        return cls(stages, Descriptor(**header["descriptor"]), n_parts, half, header["rig_digest"], turn)

    @classmethod
    def load(cls, path):
        """Read what :meth:`save` wrote."""
        from ..io.npz import MODEL_KEY, RESULT_KEY, read_npz

        arrays = read_npz(path)
        expected = "a segmenter that was saved with Segmenter.save"
        if _KEY not in arrays:
            got = "a learned model" if MODEL_KEY in arrays else "the result of a fit" if RESULT_KEY in arrays else "another NPZ"
            raise FileError(str(path), f"{got}, without the key {_KEY}", expected, "Check the path.")
        try:
            header = json.loads(str(arrays[_KEY]))
            version = header["format"]
            if version == _FORMAT:
                return cls.from_arrays(header, arrays, "stage")
        except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, RecursionError) as error:
            raise FileError(str(path), f"a file whose content does not fit ({error})", expected, "Train it again.") from None
        raise FileError(str(path), f"segmenter format {version}", f"format {_FORMAT}", "Train it again.")


def train_segmenter(
    rig, scan, n_scans, *, training=None, descriptor=None, random_state=None, n_jobs=None, progress=None, start=None
):
    """Train s on labelled scans of a rig.

    Parameters
    ----------
    rig : Rig
        Scans may be of it or of its ``welded``, to which s belongs.
    scan : callable
        i → (points, labels, scale) of scan i: points in the scan's unit, whole labels that index rig.parts, and scan units per
        rig unit. Points with label −1 are seen but not learned. It must be picklable if ``n_jobs`` asks for processes.
    n_scans : int
    training : Training, optional
    descriptor : Descriptor, optional
    random_state : int, Generator or None
    n_jobs : int, optional
        Number of processes that synthesise and describe scans: None is 1, −1 is one per processor. With more than one, a script
        must call this function under ``if __name__ == "__main__":``. The result does not depend on the number. A Generator as
        ``random_state`` stays in one process.
    progress : callable, optional
        Called with the share done, in [0, 1].
    start : Segmenter, optional
        Continue training from this segmenter of the rig (with its descriptor) instead of from nothing.

    Returns
    -------
    Segmenter

    Raises
    ------
    InputError
        An argument, or what ``scan`` returns, cannot be used; ``start`` is of another rig, or has other layers or another
        descriptor, or has two stages where ``n_scans`` is 1; ``scan`` cannot be sent to processes, or one of these was killed.
    KeyboardInterrupt
        On Ctrl-C, once all processes have ended.
    """
    _check_given(rig, scan, n_scans, training, descriptor, random_state, progress, start)
    rig, jobs = rig.welded, jobs_of(n_jobs, random_state)
    descriptor, training = descriptor or (start.descriptor if start else Descriptor()), training or Training()
    progress = progress or (lambda share: None)
    n_parts, half = len(rig.parts), rig.size / 2
    if start is not None:
        _check_start(start, rig, descriptor, training)
    n_second = _scans_of_second(n_scans, n_parts, training, start)
    n_first = n_scans - n_second
    spans = [(0, n_first), (n_first, n_scans)] if n_second else [(0, n_first)]
    stages = ()
    for k, (name, (begin, stop)) in enumerate(zip(("first", "second"), spans, strict=False)):
        done, share = begin / n_scans, (stop - begin) / n_scans / 2
        describe = _Describe(scan, descriptor, half, training.points_per_scan, n_parts, random_state, *(stages or [None]))
        X, y = _describe_all(describe, begin, stop, jobs, lambda p, d=done, s=share: progress(d + s * p))
        stage = train_stage(
            X,
            y,
            n_parts,
            training,
            random_state,
            name,
            lambda p, d=done, s=share: progress(d + s * (1 + p)),
            start=start.stages[k] if start and k < len(start.stages) else None,
        )
        stages += (stage,)
    root = (rig.upper[rig.root] - rig.lower[rig.root]).min() / 2
    return Segmenter(stages, descriptor, n_parts, half, rig.digest, _TURN * min(1.0, root / _ROOT))


def _check_given(rig, scan, n_scans, training, descriptor, random_state, progress, start):
    """Raise InputError unless each argument of :func:`train_segmenter` is of its kind."""
    if not isinstance(rig, Rig):
        raise InputError("rig", brief(rig), "a Rig", "Read one with load_rig.")
    if scan is None:
        raise InputError("scan", "None", "a function i → (points, labels, scale)")
    check_callables(scan=(scan, (("i",),)), progress=(progress, (("share",),)))
    if not is_whole(n_scans, 1):
        raise InputError("n_scans", brief(n_scans), "a whole number of at least 1")
    kinds = {"training": (training, Training), "descriptor": (descriptor, Descriptor), "start": (start, Segmenter)}
    for name, (value, kind) in kinds.items():
        if value is not None and not isinstance(value, kind):
            remedy = "Read one with Segmenter.load." if kind is Segmenter else f"Make one with {kind.__name__}(...)."
            raise InputError(name, brief(value), f"a {kind.__name__}, or None", remedy)
    check_random_state(random_state)


def _check_start(start, rig, descriptor, training):
    """Raise InputError unless a segmenter is one that training can go on from."""
    if start.n_parts != len(rig.parts):
        raise InputError("start", f"a segmenter of {start.n_parts} parts", f"one of the rig's {len(rig.parts)}")
    if start.rig_digest != rig.digest:
        got = "a segmenter of another rig (or of other parts or limits of this one)"
        raise InputError("start", got, f"one of rig {rig.name!r}", "Leave it out to train from nothing.")
    if start.descriptor != descriptor:
        raise InputError("start", f"a segmenter with {start.descriptor}", f"one with {descriptor}")
    for stage in start.stages:
        if stage.hidden not in (None, tuple(training.hidden)):
            raise InputError("start", f"a segmenter with layers of {stage.hidden}", f"the training's {tuple(training.hidden)}")


def _scans_of_second(n_scans, n_parts, training, start):
    """How many of the scans the second stage learns from; one or more where both stages of ``start`` are trained further."""
    n = int(training.second * n_scans) if n_parts > 1 else 0
    if start is None or len(start.stages) == 1 or not training.second:
        return n
    if n_scans == 1:
        remedy = "Give it more scans, or Training(second=0) to leave the second stage out."
        raise InputError("n_scans", "1 with a start of two stages", "at least 2: each stage has scans of its own", remedy)
    return max(n, 1)


@dataclass(frozen=True)
class _Describe:
    """Indices of scans → descriptions and labels of some points of each; made to be sent to another process."""

    scan: object
    descriptor: Descriptor
    half: float
    points_per_scan: int
    n_parts: int
    random_state: int | None
    first: Stage | None

    def __call__(self, indices):
        X, y = [], []
        for i in map(int, indices):
            points, labels, scale = self.scan(i)
            points, labels = np.asarray(points), np.asarray(labels)
            self._check(i, points, labels, scale)
            points = points / (scale * self.half)
            rng = generator(self.random_state, "segmenter points", i)
            of_the_body = np.flatnonzero(labels >= 0)  # clutter and floor are there to be seen, not to be learned
            rows = of_the_body[rng.choice(len(of_the_body), min(self.points_per_scan, len(of_the_body)), replace=False)]
            X.extend(_described(points, rows, self.descriptor, *([] if self.first is None else [self.first])))
            y.append(labels[rows])
        return in_half_precision(np.concatenate(X)), np.concatenate(y)

    def _check(self, i, points, labels, scale):
        """Raise InputError where a scan cannot be learned from; after the training of a stage would be late."""
        if points.ndim != 2 or points.shape[1:] != (3,) or labels.shape != points.shape[:1] or labels.dtype.kind not in "iu":
            got = f"points of shape {points.shape} and {labels.dtype} labels of shape {labels.shape}"
            raise InputError("scan", f"{got} of scan {i}", "points of shape (n, 3) and n whole numbers")
        if not len(points):
            raise InputError("scan", f"no points of scan {i}", "one or more points")
        if isinstance(scale, bool) or not isinstance(scale, Real) or not 0 < as_float(scale) < np.inf:
            raise InputError("scan", f"the scale {brief(scale)} of scan {i}", "a positive number of scan units per rig unit")
        if not np.isfinite(points).all():
            raise InputError("scan", f"points that are NaN or infinite, of scan {i}", "finite points")
        if not -1 <= int(labels.min()) <= int(labels.max()) < self.n_parts:
            got = f"labels from {labels.min()} to {labels.max()} of scan {i}"
            raise InputError("scan", got, f"labels from 0 to {self.n_parts - 1}, or −1 where none is known")


def _describe_all(describe, start, stop, jobs, progress):
    """Descriptions and labels of the scans from ``start`` to ``stop``, in their order whatever ``jobs`` is."""
    batches = np.array_split(np.arange(start, stop), max(1, (stop - start) // 50))
    answers = list(each(describe, batches, jobs=jobs, done=progress))
    y = np.concatenate([labels for _, labels in answers])
    X, end = np.empty((len(y), answers[0][0].shape[1]), np.float16), len(y)
    while answers:  # from the end, where memory is given back at once: there is never all of it twice
        x, _ = answers.pop()
        X[end - len(x) : end], end = x, end - len(x)
    return X, y


def jobs_of(n_jobs, random_state):
    """The number of processes to use."""
    if n_jobs is None:
        return 1
    if not is_whole(n_jobs, -1) or n_jobs == 0:
        expected = "a positive whole number of processes, −1 for one per processor, or None for one"
        raise InputError("n_jobs", brief(n_jobs), expected)
    if isinstance(random_state, np.random.Generator):
        return 1  # copies of it in several processes would draw the same numbers for different scans
    return startable(int(n_jobs) if n_jobs > 0 else processors())


def _described(points, rows, descriptor, first=None):
    """Descriptors of some points of a scan, with the context that a first stage gives them; block by block, to bound memory."""
    grid, seen = descriptor.grid(points), None
    blocks = [rows[start : start + _BLOCK] for start in range(0, max(len(rows), 1), _BLOCK)]
    if first is None:
        yield from (descriptor(points, block, grid) for block in blocks)
        return
    near = np.flatnonzero(within_reach(points))  # one that is far away would shift the centre of all
    around = near[some_rows(points[near], CONTEXT_POINTS)]
    for block in blocks:
        k = len(block)
        own = descriptor(points, block if seen is not None else np.concatenate([block, around]), grid)
        proba = first.predict_proba(own)
        seen = proba[k:] if seen is None else seen
        yield np.hstack([own[:k], context(points[block], proba[:k], points[around], seen)])


def _checked_rows(rows, n):
    rows = as_array("rows", rows, "whole numbers of shape (k,), k ≥ 1")
    if rows.ndim != 1 or not rows.size or rows.dtype.kind not in "iu":
        raise InputError("rows", f"{rows.dtype} values of shape {rows.shape}", "whole numbers of shape (k,), k ≥ 1")
    if not (rows.min() >= 0 and rows.max() < n):
        raise InputError("rows", f"numbers from {rows.min()} to {rows.max()}", f"rows of the {n} points")
    return rows.astype(int)
