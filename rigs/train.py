"""Trains the segmenters that come with the bundled rigs: rigs/trained/, for fits with the default settings and seed 0.

Run from the checkout: python -m rigs.train, after every change of what the names of the files stand for: the rigs, the defaults
of training, ``segmentation.cache.RECIPES``; tests say so. It trains those that are missing, two to three minutes of one core
each, and removes those that nothing asks for any more. The same versions of the libraries on the same kind of processor give the
same weights.
"""

from pathlib import Path

from lbsfit_np.io.rigs import load_rig
from lbsfit_np.learning.fitter import LBSFitter
from lbsfit_np.learning.pretraining import pretrain_segmenter, shipped_name_of
from lbsfit_np.learning.training import training_settings

__all__ = ["RIGS", "SEED", "asked_for"]

FOLDER = Path(__file__).parent / "trained"
RIGS = ("hand", "hand-left", "body", "body-coarse")
SEED = 0  # of the commands and of ``lbs.fit_scan``, unless one is given


def asked_for():
    """What there is to be trained, by the stem of its file in rigs/trained/.

    Returns
    -------
    dict of str to tuple
        Rig, Synthesis and number of scans: for each rig those of whole scans and of scans of one side.
    """
    out = {}
    for fitter in (LBSFitter(load_rig(name), partial=partial) for name in RIGS for partial in (False, True)):
        made_of = fitter.rig, training_settings(fitter.training, partial=fitter.partial), fitter.training_scans
        out[shipped_name_of(*made_of, random_state=SEED)] = made_of
    return out


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    wanted = asked_for()
    for path in FOLDER.glob("*.npz"):
        if path.stem not in wanted:
            path.unlink()
            print(f"removed {path.name}")
    for name, (rig, synthesis, n_scans) in wanted.items():
        path = FOLDER / f"{name}.npz"
        if not path.exists():
            options = {"random_state": SEED, "n_jobs": -1, "cache": False, "progress": lambda share: None}
            pretrain_segmenter(rig, synthesis, n_scans, **options).save(path)
            of = "scans of one side" if synthesis.one_sided else "whole scans"
            print(f"{path.name}: {rig.name}, {of}, {path.stat().st_size / 1e3:.0f} kB", flush=True)
