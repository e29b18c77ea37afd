"""Fit the bundled hand to one scan, and compare the result with the truth.

The scan is synthesised here, so that the truth is known; with a scan of your own, write ``points = lbs.load_scan("scan.ply")``.
"""

import tempfile
from pathlib import Path

import numpy as np

import lbsfit_np as lbs


def main():
    rig = lbs.load_rig("hand")
    scan = lbs.synthesize(rig, n_scans=1, random_state=7, n_points=1500)[0]

    # The bundled hand comes with a segmenter. What else is trained, of a rig of your own that too, is kept for the next run.
    fitter = lbs.LBSFitter(rig, random_state=0)
    fitter.pretrain(cache=True)
    result = fitter.fit_scan(scan.points)

    print(f"{result.status}: {result.message}; {result.evaluations} evaluations in {result.seconds:.1f} s")
    print("loss terms:", {name: float(f"{value:.3g}") for name, value in result.terms.items()})
    print(f"mean joint error:  {1000 * mean_distance(result.joints, scan.joints):.1f} mm")
    print(f"mean vertex error: {1000 * mean_distance(result.vertices, scan.vertices):.1f} mm")
    print(f"right labels:      {np.mean(result.labels == scan.labels):.0%} of the points")

    bend = result.pose[rig.joint_names.index("index2"), 0]  # about x, the first column of the joint's rest frame
    print(f"the index finger's middle joint is bent by {np.degrees(bend):.0f} degrees")

    # The fields give back vertices = scale · M(Θ, U + offsets) + translation, about the changed template's joints.
    again = rig.pose(result.pose, result.translation, result.scale, result.offsets, joints=result.rest_joints)
    np.testing.assert_allclose(again, result.vertices, atol=1e-9)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.fit.npz"
        result.save(path)
        assert np.array_equal(lbs.FitResult.load(path).pose, result.pose)


def mean_distance(a, b):
    return np.linalg.norm(a - b, axis=1).mean()


if __name__ == "__main__":
    main()
