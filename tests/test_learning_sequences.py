"""Learning from sequences: starts from the scans before and after, and poses that are smooth in time."""

import os

import numpy as np
import pytest
from learning_runs import collected, learning_is_hurried, loop_over, mean_gap, rounds_are_short

import lbsfit_np as lbs
from lbsfit_np.cli.sequences import order_note, takes_note
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.learning import loop, tasks
from lbsfit_np.learning.collection import Collection
from lbsfit_np.learning.sequence import poses_beside
from lbsfit_np.optimize.frame import nearest_root
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.visibility import Coverage
from lbsfit_np.rotations import matrix_from_rotvec


@pytest.fixture(scope="module")
def walk(tube_rig, people):
    """Seven scans of a slow bend, seen by few noisy points."""
    t = np.linspace(0, 1, 7)[:, None, None]
    start, stop = 0.5 * tube_rig.lower, 0.7 * tube_rig.upper
    template = people["ann"].vertices, people["ann"].joints
    poses = (1 - t) * start + t * stop
    return lbs.synthesize(tube_rig, 7, poses=poses, templates=[template], random_state=7, n_points=200, noise=0.02, holes=0)


def _roughness(results):
    poses = np.array([r.pose for r in results])
    return np.abs(np.diff(poses, n=2, axis=0)).mean()


@pytest.mark.slow
def test_smooth_sequences_are_smoother_and_as_near(tube_rig, make_learner, walk, tmp_path, monkeypatch):
    """What comes before smoothing does not depend on it, and is made once."""
    rounds_are_short(monkeypatch)
    points, learner = [s.points for s in walk], {"variant": "cd", "sequence": True, "held_out": 0}
    rough, smooth = (make_learner(**learner, smooth=w).fit(points, checkpoint=tmp_path).results_ for w in (0.0, 2e-3))
    assert _roughness(smooth) < 0.4 * _roughness(rough)
    assert mean_gap(tube_rig, smooth, walk) < 1.1 * mean_gap(tube_rig, rough, walk)
    away = [np.mean([np.abs(r.pose - s.pose).mean() for r, s in zip(found, walk)]) for found in (smooth, rough)]
    assert away[0] < 0.75 * away[1]


@pytest.mark.slow
def test_smoothing_that_fails_leaves_what_was_found_before_it(make_learner, walk, tmp_path, monkeypatch):
    """Of one scan, at the first sweep or later, or of all: it is the poses that have been found, and no scan is lost."""
    learning_is_hurried(monkeypatch, turns=0)
    points, learner, call = [s.points for s in walk], {"variant": "cd", "sequence": True, "held_out": 0}, tasks.Held.__call__

    def poses(smooth=2e-3, sweeps=3, wrong=()):
        calls = []

        def careless(self, task):
            calls.append(task)
            if len(calls) in wrong:
                raise ZeroDivisionError("nobody foresaw this")
            return call(self, task)

        with monkeypatch.context() as patch:
            patch.setattr(loop, "_SWEEPS", sweeps)
            patch.setattr(tasks.Held, "__call__", careless)
            fitter = make_learner(**learner, smooth=smooth).fit(points, checkpoint=tmp_path)
        assert not fitter.failures_ and fitter.roles_ == ["learned from"] * 7
        return np.array([r.pose for r in fitter.results_])

    rough, once = poses(smooth=0.0), poses(sweeps=1)
    assert np.abs(rough - once).max() > 1e-3
    for wrong, sweeps, expected in (([3], 0, rough), (range(1, 8), 0, rough), ([8 + 2], 1, once)):
        with pytest.warns(UserWarning, match=f"^smoothing stopped after {sweeps} of 3 sweeps: .*nobody foresaw this"):
            np.testing.assert_array_equal(poses(wrong=wrong), expected)


def test_sequences_start_from_neighbours(tube_rig, few_scans, monkeypatch):
    collection = collected(tube_rig, [s.points for s in few_scans] * 2, [0, 1] * 5)
    for m in collection.members:
        m.state = type("State", (), {"theta": np.full((4, 3), float(m.index))})
    def found():
        return [[theta[1, 0] for theta in poses] for poses in poses_beside(tube_rig, collection.members)]

    beside = found()
    assert beside[:4] == [[2], [3], [0, 4], [1, 5]] and beside[-1] == [7]  # of one's own subject only
    collection.members[2].apart = True
    assert found()[:5:2] == [[4], [0, 4], [0, 6]]  # passed over, though it has neighbours itself
    collection.members[2].apart = False
    asked = []
    monkeypatch.setattr(Collection, "work", lambda self, work, given, **k: asked.extend(given) or [(t[2], 0.0, 0) for t in given])
    for sequence in (True, False):
        rounds = loop_over(tube_rig, collection, "cd", None, sequence=sequence)
        rounds._refit(1, dict.fromkeys((0, 1), (tube_rig.vertices, tube_rig.joints)))
    assert [[theta[1, 0] for theta in task[3]] for task in asked] == beside + [[]] * 10


def test_neighbours_that_are_turned_otherwise_are_seen_in_ones_own_frame(tube_rig, few_scans):
    collection = collected(tube_rig, [s.points for s in few_scans], held_out=0)
    for k, (m, s) in enumerate(zip(collection.members, few_scans)):
        m.state = type("State", (), {"theta": s.pose})
        m.use_frame(1.0, 1.0, matrix_from_rotvec(np.array([0.2, 1.3 * k, -0.1 * k])))
    pivot = tube_rig.joints[tube_rig.root]
    members = collection.members
    for m, beside, poses in zip(members[1:], members, poses_beside(tube_rig, members)[1:], strict=False):
        before = poses[0]
        outside = [(tube_rig.pose(t) - pivot) @ n.frame.turn.T for t, n in ((before, m), (beside.state.theta, beside))]
        np.testing.assert_allclose(*outside, atol=1e-12)


def test_turns_that_are_written_otherwise_are_neighbours_all_the_same():
    """3 rad and −3.2 rad about one axis are nearly one turn; their mean must not be −0.1."""
    axis = np.array([0.6, 0.0, 0.8])
    own, beside = np.zeros((3, 3)), np.ones((3, 3))
    own[1], beside[1] = 3.0 * axis, -3.2 * axis
    alike = nearest_root(beside, own, 1)
    np.testing.assert_allclose(alike[1], (2 * np.pi - 3.2) * axis)
    np.testing.assert_allclose(matrix_from_rotvec(alike), matrix_from_rotvec(beside), atol=1e-12)
    np.testing.assert_array_equal(alike[[0, 2]], 1.0)
    np.testing.assert_array_equal(beside[1], -3.2 * axis)
    still = np.zeros((3, 3))
    np.testing.assert_array_equal(nearest_root(still, own, 1), still)
    own[1], beside[1] = -7.0 * axis, 2.0 * axis
    np.testing.assert_allclose(nearest_root(beside, own, 1)[1], (2.0 - 2 * np.pi) * axis)
    own[1], beside[1] = 7.0 * axis, -5.5 * axis  # two whole turns apart
    np.testing.assert_allclose(nearest_root(beside, own, 1)[1], (-5.5 + 4 * np.pi) * axis)


def test_smoothing_looks_at_turns_as_the_scan_itself_writes_them(tube_rig, few_scans, monkeypatch):
    collection = collected(tube_rig, [s.points for s in few_scans], held_out=0)
    axis = np.array([0.6, 0.0, 0.8])
    for k, m in enumerate(collection.members):
        m.state = lbs.LBSFitter(tube_rig)._model().rest()
        m.state.theta[0] = (3.0 if k % 2 else -3.2) * axis
    rounds, asked = loop_over(tube_rig, collection, "cd", None, sequence=True, smooth=1e-3), []
    monkeypatch.setattr(Collection, "work", lambda self, work, tasks, **k: asked.extend(tasks) or [t[2] for t in tasks])
    rounds._smooth({0: (tube_rig.vertices, tube_rig.joints)}, None)
    assert asked
    for _, _, state, (wanted, weight), _ in asked:
        assert weight == 1e-3 and np.linalg.norm(wanted[0] - state.theta[0]) < 0.1


def test_scans_that_are_not_learned_from_neither_smooth_nor_are_smoothed(tube_rig, few_scans, monkeypatch):
    collection = collected(tube_rig, [s.points for s in few_scans], held_out=0)
    for k, m in enumerate(collection.members):
        m.state = lbs.LBSFitter(tube_rig)._model().rest()
        m.state.theta[1:] = 0.1 * k
    collection.members[1].apart = True
    rounds, asked = loop_over(tube_rig, collection, "cd", None, sequence=True, smooth=1e-3), []
    monkeypatch.setattr(Collection, "work", lambda self, work, tasks, **k: asked.extend(tasks) or [t[2] for t in tasks])
    rounds._smooth({0: (tube_rig.vertices, tube_rig.joints)}, None)
    wanted = {round(state.theta[1, 0], 3): wanted and wanted[0][1, 0] for _, _, state, wanted, _ in asked}
    assert wanted[0.1] is None and collection.members[1].prior is None
    assert wanted[0.0] == pytest.approx(0.1) and wanted[0.2] == pytest.approx((0.2 + 0.0 + 0.3) / 3)


def test_scans_of_one_side_are_smoothed_as_such(tube_rig, few_scans, monkeypatch):
    """Vertices on the other side do not pull them."""
    collection = collected(tube_rig, [s.points for s in few_scans[:3]], held_out=0)
    for m, s in zip(collection.members, few_scans):
        m.state = lbs.LBSFitter(tube_rig)._model().rest()
        m.state.theta[1:] = s.pose[1:]
        m.use_frame(1.0, tube_rig.size / 2)
    rounds = loop_over(tube_rig, collection, "cd", None, sequence=True, smooth=1e-3, fit_settings=FitSettings(partial=True))
    done = []

    def each(self, work, tasks, **options):
        done.extend((work.models[0], *task[1:], work(task)) for task in tasks)
        return [state for *_, state in done[-len(tasks) :]]

    monkeypatch.setattr(Collection, "work", each)
    rounds._smooth({0: (tube_rig.vertices, tube_rig.joints)}, None)
    model, X, state, prior, _, found = done[0]
    one_side, whole = (Refit(model, coverage=Coverage(p)).polish(Problem(X), state, prior=prior).theta for p in (True, False))
    np.testing.assert_array_equal(found.theta, one_side)
    assert np.abs(one_side - whole).max() > 1e-3


@pytest.mark.parametrize(
    "names, said",
    [
        (["f_1.ply", "f_2.ply", "f_10.ply"], ""),
        (["f_1.ply", "f_10.ply", "f_2.ply"], "f_2.ply is given after f_10.ply"),
        (["a/9.ply", "b/1.ply", "ann1_9_x.ply", "bob1_8_x.ply", "walk.ply"], ""),  # each has numbers of its own
        (["ann1_9_x.ply", "bob1_8_x.ply", "ann1_8_x.ply"], "ann1_8_x.ply is given after ann1_9_x.ply"),
        (["001.ply", "002.ply", "2.pcd"], ""),
        (["10_cam0.ply", "9_cam0.ply"], "9_cam0.ply is given after 10_cam0.ply"),
        (["f_10_v2.ply", "f_9_v2.ply"], "f_9_v2.ply is given after f_10_v2.ply"),
        (["t_0.10.ply", "t_0.9.ply", "t_1.05.ply"], ""),  # fractions
        (["t_0.9.ply", "t_0.10.ply"], ""),  # or the tenth after the ninth
        (["t_10.5.ply", "t_9.7.ply"], "t_9.7.ply is given after t_10.5.ply"),
        (["t_-2.ply", "t_-1.ply", "t_0.ply"], ""),
        (["t_1e-3.ply", "t_1e-2.ply", "t_2e+1.ply"], ""),
        (["f-10.ply", "f-9.ply"], "f-9.ply is given after f-10.ply"),  # a dash, no minus
        (["1e99999999999999999999.ply", "1e99999999999999999998.ply"], "1e99999999999999999998.ply is given after"),
        (["s2_f1.ply", "s2_f2.ply", "s1_f1.ply"], ""),  # one take after the other
        (["a_x.ply", "b_1.ply", "a_2.ply", "b_0.ply"], "b_0.ply is given after b_1.ply"),
    ],
)
def test_files_out_of_order_are_told(names, said):
    note = order_note(names)
    assert note.startswith(said) and bool(note) == bool(said)


def test_files_are_in_order_by_subject():
    names = ["f_3.ply", "f_1.ply", "f_4.ply", "f_2.ply"]
    assert order_note(names) and not order_note(names, ["ann", "bob", "ann", "bob"])
    assert order_note(names, ["ann", "bob", "bob", "ann"]).startswith("f_2.ply is given after f_3.ply")


def test_recordings_in_several_folders_are_one_sequence_and_told():
    names = ["walk/1.ply", "walk/2.ply", "run/1.ply", "run/2.ply"]
    assert "walk/2.ply and run/1.ply are neighbours" in takes_note(names)
    assert not takes_note(names[:2]) and not takes_note(names, ["a", "a", "b", "b"])
    assert "walk/1.ply and run/1.ply are neighbours" in takes_note(names, ["a", "b", "a", "b"])
    assert not takes_note(["walk/1.ply", "run/../walk/2.ply", os.path.abspath("walk/3.ply")])


def test_learn_says_that_files_are_out_of_order(tmp_path, tube_rig, run):
    tube_rig.save(tmp_path / "tube.npz")
    (tmp_path / "b").mkdir()
    names = [*(tmp_path / f"f{k}.npy" for k in (10, 9)), tmp_path / "b" / "f1.npy"]
    for name in names:
        np.save(name, np.zeros((2, 3)))
    told = {flag: run("learn", tmp_path / "tube.npz", *names, "-o", tmp_path / "m.npz", *flag) for flag in ((), ("--sequence",))}
    for flag, (code, out, err) in told.items():
        assert code == 2 and ("f9.npy is given after f10.npy" in out + err) == bool(flag)
        assert (f"f9.npy and {names[-1]} are neighbours" in out + err) == bool(flag)
