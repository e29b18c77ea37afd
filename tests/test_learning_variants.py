"""The paper's variants of learning: what each of them does, learns and trains on."""

from dataclasses import replace

import numpy as np
import pytest
from learning_runs import HURRIED, SMALL, collected, learning_is_hurried, loop_over, mean_gap, rounds_are_short
from slow_tests import slow

from lbsfit_np import LBSFitter
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.effort import EFFORTS
from lbsfit_np.learning import finish, pretraining
from lbsfit_np.learning.batch import fit_scans
from lbsfit_np.learning.parameters import learned_with
from lbsfit_np.learning.tasks import Told, with_right_poses
from lbsfit_np.learning.variants import VARIANTS, as_variant
from lbsfit_np.losses.objective import PRESETS
from lbsfit_np.optimize.model import Model
from lbsfit_np.rotations import matrix_from_rotvec


def test_variants_are_the_papers():
    assert list(VARIANTS) == ["joint", "pose-only", "rand", "cd", "free-form"]
    assert all(as_variant(name).name == name for name in VARIANTS)
    joint, pose_only, rand, cd, free = VARIANTS.values()
    assert joint.labels and joint.inferred_poses and joint.deformed and joint.skinning
    assert pose_only.labels and pose_only.inferred_poses and not pose_only.deformed
    assert rand.labels and not rand.inferred_poses and not rand.deformed
    assert not cd.labels and not cd.library and cd.skinning
    assert not free.skinning and not free.labels
    assert [v.prior for v in VARIANTS.values()] == [True, True, False, False, False]


@pytest.mark.parametrize("name", ["best", "", None])
def test_other_variants_are_refused(name):
    with pytest.raises(InputError, match="variant: got .*'joint' or 'pose-only' or 'rand' or 'cd' or 'free-form'"):
        as_variant(name)


@pytest.mark.parametrize("before, after", [("joint", "pose-only"), ("pose-only", "rand"), ("rand", "joint")])
def test_a_fitter_that_has_learned_keeps_its_variant(before, after, tube_rig, few_scans, tmp_path):
    """In another one sizes of templates would count otherwise, and a file would say that it was learned with."""
    fitter = LBSFitter(tube_rig, variant=before, random_state=0)
    fitter.template_, fitter.unit_, fitter._learned_with = {"ann": tube_rig}, {"ann": 1.0}, learned_with(fitter)
    fitter.set_params(variant=after)
    save = tmp_path / "model.npz"
    for use in (fitter.fit_scan, lambda x: fitter.transform([x]), lambda x: fit_scans(fitter, [x]), lambda _: fitter.save(save)):
        with pytest.raises(InputError, match=f"variant: got '{after}'; expected '{before}', as the fitter learned with. Set"):
            use(few_scans[0].points)


def test_free_vertices_come_nearer_to_the_scan_than_stiff_ones(tube_rig, make_learner, few_scans):
    """Their Laplacian has another weight by default than that of offsets, and the one that is asked for counts."""
    points = few_scans[0].points
    loose, stiff, asked = (
        make_learner(variant="free-form", **more).fit_scan(points)
        for more in ({}, {"weights": PRESETS["default"]}, {"weights": PRESETS["default"].replace(lam_lap=0.01)})
    )
    assert loose.terms["recon"] < 0.7 * stiff.terms["recon"]
    np.testing.assert_array_equal(asked.vertices, loose.vertices)


@pytest.fixture(scope="module")
def in_common(tmp_path_factory):
    """Where first fits are kept, which variants with labels have in common."""
    return tmp_path_factory.mktemp("kept")


@pytest.mark.parametrize("variant", ["free-form", *map(slow, ("pose-only", "rand", "cd"))])
def test_every_variant_learns(tube_rig, make_learner, few_scans, people_scans, variant, in_common, monkeypatch):
    rounds_are_short(monkeypatch)
    few = few_scans[:3]  # all learned from: of fewer, poses would tell nothing of each other
    if variant in ("cd", "free-form"):  # no labels anywhere: s is neither trained nor asked
        for name in ("learning.pretraining.train_segmenter", "learning.loop.train_segmenter"):
            monkeypatch.setattr(f"lbsfit_np.{name}", lambda *a, **k: pytest.fail("trained s"))
        monkeypatch.setattr("lbsfit_np.segmentation.segmenter.Segmenter.predict_proba", lambda *a, **k: pytest.fail("asked s"))
        monkeypatch.setattr("lbsfit_np.fitting.refit.start_from_parts", lambda *a, **k: pytest.fail("a start from parts"))
    fitter = make_learner(variant=variant, held_out=0).fit([s.points for s in few], checkpoint=in_common)
    assert list(fitter.template_) == [0] and all(r.status == "ok" for r in fitter.results_)
    # Without skinning angles stay those of the rest pose, which the results say.
    assert all((r.probability > 0) == bool(r.evidence) == (variant != "free-form") for r in fitter.results_)
    error = mean_gap(tube_rig, fitter.results_, few)
    new = fitter.fit_scan(people_scans[12].points)
    assert new.status == "ok" and len(new.labels) == len(people_scans[12].points)
    if variant == "free-form":
        assert fitter.history_ == [] and fitter.regressor_ is None and fitter.template_[0] is tube_rig
        assert fitter.unit_ == {0: 1.0}
        assert all((r.pose[1:] == np.clip(0.0, tube_rig.lower, tube_rig.upper)[1:]).all() for r in fitter.results_)
        assert 0.1 < error < 0.5  # the rest pose, put where the scan is
        for r in (new, *fitter.results_):  # of which nothing is said that goes by parts or joints
            assert r.message == "free-form, no skinning: joint angles are not fitted; scan and rig are in one unit"
            np.testing.assert_allclose(r.rest_joints, tube_rig.regressor @ (tube_rig.vertices + r.offsets), rtol=0, atol=1e-12)
            assert r.terms["chamfer"] == pytest.approx(r.terms["recon"] ** 2)  # no term of the undeformed template
    else:
        assert error < 0.05 and mean_gap(tube_rig, [new], [people_scans[12]]) < 0.06
        assert (fitter.segmenter_ is None) == (variant == "cd") and len(fitter.history_) == 2
    assert (fitter.pose_prior_ is not None) == (variant == "pose-only")
    if variant in ("cd", "free-form"):
        assert "structured" not in fitter.results_[0].terms and "structured" not in new.terms


@pytest.mark.slow
def test_no_labels_before_learning_either_where_there_are_none_in_learning(tube_rig, make_learner, people_scans, monkeypatch):
    monkeypatch.setattr("lbsfit_np.learning.pretraining.train_segmenter", lambda *a, **k: pytest.fail("trained s"))
    monkeypatch.setattr("lbsfit_np.segmentation.segmenter.Segmenter.predict_proba", lambda *a, **k: pytest.fail("asked s"))
    monkeypatch.setattr("lbsfit_np.fitting.search.start_from_parts", lambda *a, **k: pytest.fail("a start from parts"))
    s, trained = people_scans[0], make_learner()._pretrained
    fresh = LBSFitter(tube_rig, **SMALL | {"variant": "cd", "training_scans": 40})
    given = LBSFitter(tube_rig, **SMALL | {"variant": "cd", "training_scans": 40}).pretrain(segmenter=trained[0])
    changed = LBSFitter(tube_rig, **SMALL | {"variant": "cd"})
    changed.segmenter_, changed.regressor_ = trained
    pose = matrix_from_rotvec(np.array([0.0, 0.3, 0.0]))
    for fitter in (fresh, given, changed):
        assert fit_scans(fitter, [s.points])[0].result.terms.keys() == {"chamfer", "laplacian", "total", "recon"}
    assert fresh.segmenter_ is None and given.segmenter_ is None and fresh.regressor_ is not None
    started = changed.fit_scan(s.points @ pose.T, theta0=s.pose)
    assert "structured" not in started.terms and started.evidence["disagreement"] == 0
    assert np.linalg.norm(started.joints - s.joints @ pose.T, axis=1).mean() < 0.03 * tube_rig.size


@pytest.mark.usefixtures("hurried")
@pytest.mark.slow
def test_a_fitter_that_was_pretrained_without_labels_can_be_given_another_variant(tube_rig, unlearned, few_scans, monkeypatch):
    """Then s is trained, once; here it is one that is there."""
    calls, s = [], unlearned.segmenter_
    monkeypatch.setattr(pretraining, "train_segmenter", lambda *a, **k: calls.append(1) or s)
    small = {**SMALL, "training_scans": 20, "held_out": 0}
    points = [s.points for s in few_scans[:2]]
    for use in (lambda f: f.fit_scan(points[0]), lambda f: fit_scans(f, points[:1]), lambda f: f.fit(points)):
        fitter = LBSFitter(tube_rig, **small, variant="cd").pretrain()
        assert not calls
        use(fitter.set_params(variant="joint"))
        assert len(calls) == 1 and fitter.segmenter_ is not None
        calls.clear()


def test_without_the_library_limbs_are_not_tried_in_its_poses(make_learner, few_scans, monkeypatch):
    learning_is_hurried(monkeypatch)
    monkeypatch.setitem(EFFORTS, "fast", replace(HURRIED, generations=1))
    monkeypatch.setattr("lbsfit_np.starts.limbs.LimbPoses.proposals", lambda *a, **k: pytest.fail("asked the library"))
    fitter = make_learner(variant="cd")
    fitter.segmenter_, fitter.regressor_ = None, fitter._pretrained[1]
    fitter.fit_scan(few_scans[0].points)
    fitter.fit([s.points for s in few_scans[:3]]).fit_scan(few_scans[3].points)


@pytest.mark.parametrize("variant", ["cd", slow("joint")])
@pytest.mark.usefixtures("hurried")
def test_results_try_limbs_where_the_rounds_do(variant, make_learner, few_scans, monkeypatch):
    """Points are taken for those of a limb, of which Chamfer alone knows nothing."""
    tried, made = [], finish.TemplateFit

    def watched(*given, other_limbs=True):
        tried.append(other_limbs)
        return made(*given, other_limbs=other_limbs)

    monkeypatch.setattr(finish, "TemplateFit", watched)
    make_learner(variant=variant).fit([s.points for s in few_scans[:3]])
    assert set(tried) == {variant == "joint"}


def test_variants_train_on_what_they_say(tube_rig, make_learner, few_scans):
    """Which poses and templates a round's training scans are made of."""
    collection = collected(tube_rig, [s.points for s in few_scans])
    for m, s in zip(collection.members, few_scans):
        m.state = make_learner()._model().rest().replace(theta=s.pose)
    templates = {0: (tube_rig.vertices * 1.1, tube_rig.joints * 1.1)}
    for name, n_poses, n_templates in (("joint", 4, 1), ("pose-only", 4, 0), ("rand", 0, 0)):
        loop = loop_over(tube_rig, collection, name, None)
        made = loop._mixture(1, templates)
        assert (len(made.poses), len(made.templates)) == (n_poses, n_templates)
    next(m for m in collection.members if not m.held_out).apart = True
    poses = loop_over(tube_rig, collection, "joint", None)._mixture(1, templates).poses
    learning = [s.pose for m, s in zip(collection.members, few_scans) if not (m.held_out or m.apart)]
    assert len(learning) == 3
    np.testing.assert_array_equal(poses, learning)


def test_nothing_is_trained_on_templates_of_scans_held_out(tube_rig, few_scans):
    """Where people have one scan each, some are held out with all they have."""
    collection = collected(tube_rig, [s.points for s in few_scans], [f"{k}" for k in range(len(few_scans))])
    for m, s in zip(collection.members, few_scans):
        m.state = Model(tube_rig).rest().replace(theta=s.pose)
    templates = {m.subject: (tube_rig.vertices * (1 + k / 10), tube_rig.joints) for k, m in enumerate(collection.members)}
    made = loop_over(tube_rig, collection, "joint", None)._mixture(1, templates)
    taught = [m.subject for m in collection.members if not m.held_out]
    assert len(taught) == len(few_scans) - 1 == len(made.templates)
    for (vertices, _), subject in zip(made.templates, taught):
        np.testing.assert_array_equal(vertices, templates[subject][0])


def test_poses_that_are_most_likely_wrong_teach_nothing(tube_rig, few_scans, monkeypatch):
    """Those of scans that are explained much worse than their subject's others: neither rounds nor other poses go by them."""
    collection = collected(tube_rig, [s.points for s in few_scans], held_out=0.0)
    for m, s in zip(collection.members, few_scans):
        m.state, m.loss = Model(tube_rig).rest().replace(theta=s.pose), 1.0
    collection.members[1].loss = 1.7
    few = collection.members[:3]
    assert with_right_poses(few, 3) == few and [m.index for m in with_right_poses(few)] == [0, 2]
    assert [m.index for m in with_right_poses(collection.members)] == [0, 2, 3, 4][: len(collection.members) - 1]
    templates, asked = {0: (tube_rig.vertices, tube_rig.joints)}, []
    monkeypatch.setattr("lbsfit_np.learning.loop.pose_prior", lambda poses, *more: asked.extend(poses))
    for name in ("joint", "pose-only"):
        loop = loop_over(tube_rig, collection, name, None)
        right = [s.pose for k, s in enumerate(few_scans) if k != 1]
        np.testing.assert_array_equal(loop._mixture(1, templates).poses, right)

    def answers(work, tasks, *more):
        if isinstance(work, Told):
            return [(state, 1.0, np.eye(1) if is_asked else None) for _, _, state, is_asked in tasks]
        return [(state, 1.0, 1.0) for _, _, _, state, _ in tasks]

    monkeypatch.setattr(loop, "_work", answers)
    loop._last_steps(1, templates)
    np.testing.assert_array_equal(asked, right)
    collection.members[1].loss, collection.members[3:] = 1.7, []
    asked.clear()
    loop._last_steps(1, templates)  # two right ones would make no prior
    np.testing.assert_array_equal(asked, [s.pose for s in few_scans[:3]])


@pytest.mark.parametrize("variant, size", [("joint", 1.0), ("pose-only", 1.2), ("rand", 1.2)])
def test_labels_are_asked_for_at_the_size_that_the_segmenter_has_learned(variant, size, tube_rig, few_scans):
    """Of the rig where the subjects' templates do not teach; joint's has learned theirs."""
    asked = []

    class Said:
        half = tube_rig.size / 2

        def predict_proba(self, points, *, scale, views):
            asked.append(scale)
            return np.full((len(points), 4), 0.25)

    collection = collected(tube_rig, [s.points for s in few_scans])
    for m in collection.members:
        m.state = Model(tube_rig).rest()
        m.use_frame(1.0, tube_rig.size / 2)
    loop_over(tube_rig, collection, variant, Said())._label({0: (1.2 * tube_rig.vertices, 1.2 * tube_rig.joints)})
    assert asked == pytest.approx([size] * len(few_scans))
