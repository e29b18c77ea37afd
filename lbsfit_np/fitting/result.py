"""FitResult: all that one fit found, saved without pickle."""

import json
from dataclasses import dataclass, field

import numpy as np

from ..errors import FileError, InputError
from ..rig.units import METRES

__all__ = ["FORMAT", "FitResult"]

FORMAT = 9
_SHORT = 80  # letters of the message in repr
_ARRAYS = ("pose", "translation", "offsets", "rest_joints", "vertices", "joints", "joint_std", "labels", "confidence")
_ARRAYS += ("left_out", "took_part", "term_labels")
_SCALARS = ("scale", "converged", "status", "message", "evaluations", "probability", "seconds")
_SCALARS += ("rig_digest", "model_digest", "subject", "unit")


@dataclass(frozen=True, eq=False, repr=False)
class FitResult:
    """The fit of one scan. ``vertices = scale · M(Θ, U + offsets) + translation``.

    ``rig.pose(r.pose, r.translation, r.scale, r.offsets, joints=r.rest_joints)`` gives the vertices back.

    Attributes
    ----------
    pose : (J, 3) array
        Θ, rotation vectors in the joints' rest frames, radians; rows as in the rig.
    translation : (3,) array
        In the scan's unit and frame.
    scale : float
        Scan units per rig unit.
    offsets : (m, 3) array
        U^d − U, in rig units.
    rest_joints : (J, 3) array
        Joint positions of U^d in the rest pose, in rig units.
    vertices : (m, 3) array
        The registered mesh in the scan's frame and unit: the rig's vertices in their order.
    joints : (J, 3) array
        Posed joint positions, in the scan's frame and unit.
    joint_std : (J,) array
        How precisely the scan determines each joint position where the fit is about right: the expected root mean squared
        distance, in the scan's unit (``optimize.precision``). It is large where hardly any points depend on a joint, whose
        position is then a guess, and NaN where it is not known: in free-form fits.
    labels : (n,) int array
        Part of every scan point, as an index into ``parts``.
    confidence : (n,) array
        Confidence of each label, in [0, 1].
    left_out : (n,) bool array
        Which points are of nothing that the rig models, such as floors, clutter and very many points at one place, or have next
        to no weight: the fit did not look at them.
    took_part : (n,) bool array
        Which points the objective, and so ``terms``, is of: all that are not left out, or some of them where there are very many
        (``max_points``).
    term_labels : (n,) int array
        The parts that "structured" of ``terms`` goes by: ``labels`` as they were before the last steps, and ``len(parts)``, which
        no vertex has, for points whose part was in doubt then or that did not take part.
    terms : dict of str to float
        Loss terms of this result, in units of ``scale`` · half, where half is half the rig's size: "chamfer" L_{c²,λ},
        "structured" L_{s²,λ} and "laplacian" L_lap (each before its weight), "total" the weighted sum, "recon" √L_c(X, V^d).
    converged : bool
        Whether the full stage ended at its tolerance rather than at its iteration limit.
    status : {"ok", "suspect", "failed"}
        Whether the fit seems right, judged by ``probability``; also ``failed`` where the fit is not finite.
    message : str
        What speaks against the fit, if anything does; what was left out; the unit.
    probability : float
        Probability that the mean joint error is below 1.5 % of the rig's size, calibrated on scans of the bundled rigs
        (``fitting.confidence``). Where a scan lacks a part, it says nothing of the joints that are guesses, see ``joint_std``.
    evidence : dict of str to float
        What the probability rests on: each value is in [0, 1], and near 0 where nothing is wrong. See docs/fitting.md.
    evaluations : int
        Number of evaluations of an objective by L-BFGS in the stages of this pose; those of hypotheses are not counted.
    seconds : float
    parts : tuple of str
    rig_digest : str
        ``Rig.digest`` of the rig.
    model_digest : str
        Digest of what was learned from a collection, if the fit used that (``learning.archive.model_digest``); else empty.
    subject : str
        Whose learned template the fit is on: the id as text, or "0" for the one subject of a model that was learned without ids.
        Empty where the fit is on none, as for a single scan or for somebody else.
    unit : {"m", "cm", "mm", "in", "ft", ""}
        The scan's unit, if the caller has said it; else empty, and ``message`` says what it seems to be.
    settings : dict
        The ``LBSFitter`` parameters that the fit depends on, by name, as plain data, and "version", the package's version.
        "random_state" is None where it was not a whole number. Given starts, labels, point weights and segmenters are not
        recorded. Empty where the fit was not made by an ``LBSFitter``.
    """

    pose: np.ndarray
    translation: np.ndarray
    scale: float
    offsets: np.ndarray
    rest_joints: np.ndarray
    vertices: np.ndarray
    joints: np.ndarray
    joint_std: np.ndarray
    labels: np.ndarray
    confidence: np.ndarray
    left_out: np.ndarray
    took_part: np.ndarray
    term_labels: np.ndarray
    terms: dict
    converged: bool
    status: str
    message: str
    probability: float
    evidence: dict
    evaluations: int
    seconds: float
    parts: tuple
    rig_digest: str
    model_digest: str = ""
    subject: str = ""
    unit: str = ""
    settings: dict = field(default_factory=dict)

    def __repr__(self):
        message = self.message if len(self.message) <= _SHORT else f"{self.message[:_SHORT]}…"
        size = f"{len(self.vertices)} vertices, {len(self.joints)} joints"
        return f"<FitResult: {self.status}, probability {self.probability:.2f}, {size}: {message}>"

    def save(self, path):
        """Write as NPZ, atomically; the name must end in ``.npz``.

        Keys: the arrays by their names (``pose``, ``translation``, ``offsets``, ``rest_joints``, ``vertices``, ``joints``,
        ``joint_std``, ``labels``, ``confidence``, ``left_out``, ``took_part``, ``term_labels``); ``scale``, ``converged``,
        ``status``, ``message``, ``probability``, ``evaluations``, ``seconds``, ``rig_digest``, ``model_digest``,
        ``subject``, ``unit`` as 0-d arrays; ``parts`` as text; ``terms``, ``evidence`` and ``settings`` as JSON text;
        ``lbsfit_np_result``, the format's number.
        """
        from ..io.npz import RESULT_KEY
        from ..io.write import check_npz_name, write_npz

        check_npz_name(path)
        if not isinstance(self.settings, dict):
            raise InputError("settings", f"a {type(self.settings).__name__}", "a dict")
        try:
            settings = json.dumps(self.settings)
        except (TypeError, ValueError, RecursionError) as error:
            raise InputError("settings", f"what JSON cannot store ({error})", "text, numbers, lists and dicts") from None
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        scalars = {name: np.array(getattr(self, name)) for name in _SCALARS}
        write_npz(
            path,
            terms=np.array(json.dumps(self.terms)),
            evidence=np.array(json.dumps(self.evidence)),
            settings=np.array(settings),
            parts=np.array(self.parts),
            **{RESULT_KEY: np.array(FORMAT)},
            **arrays,
            **scalars,
        )

    @classmethod
    def load(cls, path):
        """Read what :meth:`save` wrote."""
        from ..io.npz import RESULT_KEY, read_npz

        z = read_npz(path)
        if RESULT_KEY not in z:
            raise FileError(str(path), f"an NPZ without the key {RESULT_KEY}", "a result that was saved with FitResult.save")
        if z[RESULT_KEY].tolist() != FORMAT:
            raise FileError(str(path), f"result format {z[RESULT_KEY]}", f"format {FORMAT}", "Fit again.")
        try:
            fields = {name: z[name] for name in _ARRAYS}
            fields.update({name: z[name].item() for name in _SCALARS})
            terms, evidence, settings = (json.loads(str(z[name])) for name in ("terms", "evidence", "settings"))
            if z["parts"].ndim != 1:
                raise ValueError("parts that are not a list")
            _check(fields, terms, evidence, settings)
            return cls(terms=terms, evidence=evidence, settings=settings, parts=tuple(z["parts"].tolist()), **fields)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            raise FileError(
                str(path), f"an incomplete or broken result ({error})", "a result that was saved with FitResult.save"
            ) from None


def _check(fields, terms, evidence, settings):
    """Raise ValueError unless the fields are of the right kinds and fit together."""
    J, m, n = len(fields["pose"]), len(fields["offsets"]), len(fields["labels"])
    shapes = {
        "pose": (J, 3),
        "translation": (3,),
        "offsets": (m, 3),
        "rest_joints": (J, 3),
        "vertices": (m, 3),
        "joints": (J, 3),
        "joint_std": (J,),
        "labels": (n,),
        "confidence": (n,),
        "left_out": (n,),
        "took_part": (n,),
        "term_labels": (n,),
    }
    kinds = {"labels": "iu", "left_out": "b", "took_part": "b", "term_labels": "iu"}
    for name, shape in shapes.items():
        if fields[name].shape != shape or fields[name].dtype.kind not in kinds.get(name, "f"):
            raise ValueError(f"{name} of type {fields[name].dtype} and shape {fields[name].shape}")
    kinds = {"scale": float, "converged": bool, "status": str, "message": str, "evaluations": int}
    kinds |= {"probability": float, "seconds": float, "rig_digest": str, "model_digest": str, "subject": str, "unit": str}
    for name, kind in kinds.items():
        if not isinstance(fields[name], kind):
            raise ValueError(f"{name} is {fields[name]!r}")
    if fields["unit"] not in ("", *METRES):
        raise ValueError(f"unit is {fields['unit']!r}")
    if not isinstance(settings, dict):
        raise ValueError("settings that are not a dict")
    for name, numbers in (("terms", terms), ("evidence", evidence)):
        if not isinstance(numbers, dict) or not all(isinstance(v, float) for v in numbers.values()):
            raise ValueError(f"{name} that are not numbers")
