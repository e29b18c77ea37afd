"""The benchmark of learning: its scans, and its table."""

import numpy as np
import pytest

from lbsfit_np.bench.hand import hand_rig, natural_poses
from lbsfit_np.bench.learn import collection, learn_bench, learn_table, touching_pose
from lbsfit_np.errors import InputError


def test_the_scans_are_of_three_subjects_and_the_same_for_one_seed(shared_rigs):
    rig, scans, subjects, others = collection("hand", shared_rigs, 9, seed=3)
    again = collection("hand", shared_rigs, 9, seed=3)[1]
    assert subjects == [0, 1, 2] * 3 and len(others) == 3
    assert np.array_equal(scans[0].template, scans[3].template) and not np.array_equal(scans[0].template, scans[1].template)
    assert all(np.array_equal(a.points, b.points) for a, b in zip(scans, again, strict=True))
    assert len(rig.parts) == 16


def test_touching_poses_bring_two_fingertips_together(shared_rigs):
    rig = hand_rig(shared_rigs)
    theta = touching_pose(rig, natural_poses(rig, shared_rigs), np.random.default_rng(0))
    assert np.all(theta >= rig.lower - 1e-12) and np.all(theta <= rig.upper + 1e-12)


def test_the_table_has_a_row_a_variant():
    entry = {"joint_error": 0.02, "vertex_error": 0.03, "template_gap": 0.01, "seconds": 5.0}
    report = {
        "unit": "half size",
        "settings": {"n_scans": 6, "subjects": 3},
        "rows": {"before": {"1": {"template_gap": 0.05, "label_error": 0.2}}, "cd": {"1": entry}},
    }
    text = learn_table(report)
    assert "before" in text and "0.0500" in text
    assert "cd" in text and "0.0200" in text and "–" in text


@pytest.mark.parametrize("bad", [{"variants": ("other",)}, {"seeds": (1, 1)}, {"seeds": ()}])
def test_bad_arguments_are_named_before_any_work(bad):
    with pytest.raises(InputError, match="variants|seeds"):
        learn_bench("hand", "nowhere", **bad)
