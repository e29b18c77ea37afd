"""Sets of scans with known correspondences, and fits of them that are exact or off by a known amount."""

from dataclasses import replace

import numpy as np

from lbsfit_np import synthesize
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.io.write import write_mesh_ply
from lbsfit_np.learning.archive import learned_digests, model_digest
from lbsfit_np.learning.fitter import LBSFitter
from lbsfit_np.learning.parameters import learned_with

_pretrain = LBSFitter.pretrain  # which tests may replace
WHO = ("ann", "ann", "bob", "bob")  # whose the scans of ``pair_scans`` are


def posed_meshes(rig, n, seed=5):
    """(n, m, 3): the rig in poses."""
    return np.array([s.vertices for s in synthesize(rig, n, random_state=seed, n_points=50)])


def write_meshes(folder, rig, vertices, name="s{}.ply"):
    folder.mkdir(parents=True, exist_ok=True)
    for i, v in enumerate(vertices):
        write_mesh_ply(folder / name.format(i), v, rig.faces)
    return folder


def result_of(rig, vertices, n, status="ok", scale=1.0, recon=0.01):
    """A FitResult with a given registration, of n points."""
    J, zeros = len(rig.parents), np.zeros((len(rig.parents), 3))
    return FitResult(
        pose=zeros.copy(),
        translation=np.zeros(3),
        scale=scale,
        offsets=np.zeros(rig.vertices.shape),
        rest_joints=zeros.copy(),
        vertices=np.array(vertices, dtype=float),
        joints=zeros.copy(),
        joint_std=np.full(J, np.nan),
        labels=np.zeros(n, dtype=int),
        confidence=np.ones(n),
        left_out=np.zeros(n, dtype=bool),
        took_part=np.ones(n, dtype=bool),
        term_labels=np.zeros(n, dtype=int),
        terms={"recon": recon},
        converged=True,
        status=status,
        message=f"made up for {J} joints",
        probability=0.9,
        evidence={},
        evaluations=1,
        seconds=0.5,
        parts=rig.parts,
        rig_digest=rig.digest,
    )


def fits_are_given(patch, registrations):
    """Have fitters fit by looking up the registration of a scan, by its name, and count what they fit; errors are raised.

    The registration is an array, or a pair of one and options of ``result_of``.
    """
    import lbsfit_np as lbs

    asked = []

    def fit_scan(self, scan, **options):
        asked.append(scan.name)
        given = registrations[scan.name]
        if isinstance(given, Exception | KeyboardInterrupt):
            raise given
        vertices, more = given if isinstance(given, tuple) else (given, {})
        result = result_of(self.rig, vertices, len(scan.points), **more)
        return replace(result, model_digest=model_digest(self, options.get("subject")))

    def pretrain(self, **options):
        self.segmenter_ = self.regressor_ = "given"
        return self

    patch.setattr(lbs.LBSFitter, "fit_scan", fit_scan)
    patch.setattr(lbs.LBSFitter, "pretrain", pretrain)
    return asked


def learning_is_given(patch, registrations):
    """Have fitters learn by looking up registrations, where there is one; the rig is everybody's template.

    Returns a list that gets, each time, the pairs (scan, subject) that were learned from.
    """
    import lbsfit_np as lbs

    learned = []

    def fit(self, scans, subjects=None, **options):
        scans = [scan() for scan in scans]
        learned.append([(scan.name, subject) for scan, subject in zip(scans, subjects, strict=True)])
        found = [registrations.get(scan.name) for scan in scans]
        known = [s for s, vertices in zip(subjects, found) if vertices is not None]
        self.template_, self.unit_ = dict.fromkeys(known, self.rig), dict.fromkeys(known, 1.0)
        self.learned_unit_ = None
        hurried = _pretrain(lbs.LBSFitter(self.rig, training_scans=2, training={"n_points": 100}, random_state=0))
        self.segmenter_, self.regressor_ = hurried.segmenter_, hurried.regressor_  # a model without these is refused
        self.history_, self._learned_with = [{"round": 0}], learned_with(self)
        digests = learned_digests(self)

        def result(scan, subject, vertices):
            return replace(result_of(self.rig, vertices, len(scan.points)), model_digest=digests[subject])

        self.results_ = [v if v is None else result(s, subject, v) for s, subject, v in zip(scans, subjects, found)]
        return self

    patch.setattr(lbs.LBSFitter, "fit", fit)
    return learned


def what_fits_are_told(patch):
    """A dict that gets of each scan that is fitted its subject and the fitter; after ``fits_are_given``."""
    import lbsfit_np as lbs

    told, fit_scan = {}, lbs.LBSFitter.fit_scan

    def noted(self, scan, **options):
        told[scan.name] = options.get("subject"), self
        return fit_scan(self, scan, **options)

    patch.setattr(lbs.LBSFitter, "fit_scan", noted)
    return told
