"""Learn a template for each of two people from their scans, fit a new scan of one, and save the fits of one as an animation.

The scans are synthesised here, so that the truth is known; with your own, ``scans = [lbs.load_scan(path) for path in paths]``.
"""

import tempfile
from pathlib import Path

import numpy as np

import lbsfit_np as lbs


def main():
    rig = lbs.load_rig("hand-coarse")
    people = {"ann": rig.subject(1), "bob": rig.subject(2)}
    subjects = ["ann"] * 2 + ["bob"] * 2
    truth = [scan_of(rig, people[who], seed) for seed, who in enumerate(subjects)]
    scans = [t.points for t in truth]

    # By default there are many more training scans and up to four rounds; fits are then better, and take minutes.
    fitter = lbs.LBSFitter(rig, training_scans=100, rounds=1, effort="fast", random_state=0)
    fitter.pretrain()
    alone = [fitter.fit_scan(points) for points in scans]
    fitter.fit(scans, subjects)

    print(f"mean joint error, one by one: {error(alone, truth):.2f} mm, learned: {error(fitter.results_, truth):.2f} mm")
    for who, template in fitter.template_.items():
        before, after = (mean_distance(t.vertices, people[who].vertices) for t in (rig, template))
        print(f"template of {who}: {1000 * before:.1f} mm from the true one before, {1000 * after:.1f} mm after")

    new = scan_of(rig, people["bob"], 99)
    result = fitter.fit_scan(new.points)
    print(f"a new scan is of {result.subject!r}; mean joint error {error([result], [new]):.2f} mm")

    with tempfile.TemporaryDirectory() as folder:
        fitter.save(Path(folder) / "model.npz")  # lbs.LBSFitter.load, lbsfit fit
        away = lbs.save_animation(Path(folder) / "bob.glb", rig, fitter.results_[2:])
        print(f"bob.glb: {len(away)} key frames, {1000 * away.mean():.2g} mm from the registered meshes in the mean")


def scan_of(rig, person, seed):
    """A scan of a person in a natural pose, with its truth."""
    template = [(person.vertices, person.joints)]
    return lbs.synthesize(rig, 1, templates=template, poses="natural", random_state=seed, n_points=600, scale=0.0)[0]


def error(results, truth):
    """Mean distance of the joints, in millimetres: the rig's unit is the metre."""
    return 1000 * np.mean([mean_distance(r.joints, t.joints) for r, t in zip(results, truth, strict=True)])


def mean_distance(a, b):
    a, b = np.asarray(a), np.asarray(b)
    return np.linalg.norm(a - b, axis=1).mean()


if __name__ == "__main__":
    main()
