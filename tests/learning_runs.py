"""Collections, loops and fitters of the tube rig that learning is tested on, and how far what they find is from the truth."""

import numpy as np

from lbsfit_np.fitting import mirror_image, refit, search, second_look
from lbsfit_np.fitting.effort import EFFORTS, Effort
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.fitting.scout import Found
from lbsfit_np.learning import first_fits, free_form
from lbsfit_np.learning.loop import Loop, LoopSettings
from lbsfit_np.learning.reading import read_collection
from lbsfit_np.learning.variants import as_variant
from lbsfit_np.optimize import registration
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.lbfgs import minimise
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.segmentation.stage import Training
from lbsfit_np.starts.turns import Facing
from lbsfit_np.synthesis import Synthesis

SMALL = {"effort": "fast", "training_scans": 200, "training": {"n_points": 200}, "rounds": 1, "random_state": 0}
SCANS = {"n_points": 400, "holes": 1, "density": 0.3}
HURRIED = Effort(2, 1, 1, 1, generations=0, parents=1, proposals=1, closer=False, bends=False)
NAN = np.full((50, 3), np.nan)
# Of a round, where what is trained in it has to be of some use all the same, and where learning is hurried.
FEW = {"round_scans": 25, "library_scans": 30}
FEWER = {"round_scans": 10, "library_scans": 20, "neighbours": 1, "training": Training(epochs=1, learning_rate=1e-3)}
# Of steps that look for a pose, there: so few, on so few points and from so few vertices.
SHORT = {"_FAR_STEPS": 5, "_NEAR_STEPS": 4, "_NEAR_VERTICES": 200, "_SIGMAS": (0.1,)}

# What ``learned_people`` learned from: rows of ``people_scans``, and a scan that cannot be used.
GIVEN = [0, 1, 2, "broken", 3, 4, 5, 6, 7, 8, 9]
IDS = ["ann", "bob", "ann", "ann", "bob", "ann", "bob", "ann", "bob", "ann", "bob"]
WHOLE = [k for k, i in enumerate(GIVEN) if i != "broken"]


def learning_is_hurried(patch, effort="fast", **more):
    """Have fits and rounds end early in this process, for tests that ask what becomes of fits, right or not.

    All steps end earlier than else, and fits of one effort try less.
    """
    patch.setitem(EFFORTS, effort, HURRIED)
    for name, value in (("tolerance", 0.3), ("vertices", 200)):
        patch.setitem(GaussNewton.__init__.__kwdefaults__, name, value)
    patch.setitem(GaussNewton.pose.__kwdefaults__, "iterations", 5)
    for name, value in SHORT.items():
        patch.setattr(refit, name, value)
    patch.setattr(registration, "_STEPS", 1)
    patch.setattr(registration, "_PLACES", 1000)
    for module in (free_form, refit, search):
        patch.setattr(module, "minimise", lambda *given, **more: minimise(*given, **more | {"tolerance": 0.1}))
    for module in (first_fits, second_look):  # such fits are in doubt, which would have each looked at for an arm
        patch.setattr(module, "may_go_on", lambda rig, settings: False)
    patch.setattr(mirror_image, "one_sided", lambda rig: False)  # and in the mirror
    quick = FEWER | more
    patch.setattr(LoopSettings, "for_training", lambda n, **others: LoopSettings(**quick, **others))


def rounds_are_short(patch, **more):
    """Have rounds train on few scans, and take few turns; fits are as good as ever."""
    quick = FEW | {"turns": 1} | more
    patch.setattr(LoopSettings, "for_training", lambda n, **others: LoopSettings(**quick, **others))


def assert_nothing_is_hurried():
    """For fixtures of the session, which others take for good fits."""
    assert HURRIED not in EFFORTS.values()


def mean_gap(rig, results, scans, what="joints"):
    """Mean distance in half sizes."""
    away = [np.linalg.norm(getattr(r, what) - getattr(s, what), axis=1).mean() for r, s in zip(results, scans, strict=True)]
    return np.mean(away) / (rig.size / 2)


def collected(rig, scans, subjects=None, **options):
    """The collection, as the parameters' defaults have it read."""
    given = {"max_points": 2500, "held_out": 0.1, "scale": "estimate", "random_state": 0, **options}
    return read_collection(rig, scans, subjects, **given)


def loop_over(rig, collection, variant, segmenter, library=None, **options):
    """The loop of a fitter like ``SMALL``."""
    given = {
        "facing": Facing(),
        "fit_settings": FitSettings(),
        "settings": LoopSettings.for_training(100, rounds=1),
        "synthesis": Synthesis(n_points=200),
        "joints": "follow",
        "sequence": False,
        "smooth": 0.0,
        "jobs": 1,
        "random_state": 0,
        "progress": None,
    }
    return Loop(rig, collection, as_variant(variant), segmenter, library, **(given | options))


def found_at_the_truth(rig, scan):
    """What a scout finds of a scan in the rig's own unit, if it finds the truth."""
    frame = Frame(np.zeros(3), rig.size / 2)
    state = Model(rig).rest().replace(theta=scan.pose, translation=scan.translation / frame.unit)
    return Found(frame, Problem(frame.inside(scan.points)), state, None, 1.0, ())
