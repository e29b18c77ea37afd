"""Learning again: with other processes, after a stop, with other seeds and parameters, and on the same fitter."""

import numpy as np
import pytest
from learning_runs import learning_is_hurried, rounds_are_short

from lbsfit_np.learning.checkpoint import steps_in


@pytest.fixture(scope="module")
def points(few_scans):
    """Every other point: these tests ask whether fits are the same. Other processes know nothing of a hurry here."""
    return [s.points[::2] for s in few_scans]


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_processes(make_learner, points, monkeypatch):
    rounds_are_short(monkeypatch)
    found = [make_learner(n_jobs=jobs).fit(points[:3]) for jobs in (1, 2)]
    _assert_alike(*found)
    np.testing.assert_array_equal(found[0].template_[0].vertices, found[1].template_[0].vertices)


@pytest.mark.slow
def test_processes_find_what_one_has_kept(make_learner, points, tmp_path, monkeypatch):
    rounds_are_short(monkeypatch)

    def stop(stage, share, figures=None):
        if stage == "first fits" and share > 0:
            raise KeyboardInterrupt

    points = points[:3]
    with pytest.raises(KeyboardInterrupt):
        make_learner(variant="cd").fit(points, checkpoint=tmp_path, progress=stop)
    assert steps_in(tmp_path) == 1  # two are left to two processes
    found = make_learner(variant="cd", n_jobs=2).fit(points, checkpoint=tmp_path)
    assert steps_in(tmp_path) > 1
    _assert_alike(found, make_learner(variant="cd").fit(points))


def _assert_alike(found, expected):
    for a, b in zip(found.results_, expected.results_, strict=True):
        for name in ("pose", "vertices", "joints", "offsets", "labels", "confidence"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        assert (a.terms, a.message, a.model_digest) == (b.terms, b.message, b.model_digest)
    assert found.roles_ == expected.roles_ and found.unit_ == expected.unit_
    h, g = ([{k: v for k, v in e.items() if k != "seconds"} for e in f.history_] for f in (found, expected))
    assert h == g


@pytest.mark.slow
def test_a_seed_decides_all_and_other_kinds_of_seeds_work(make_learner, few_scans, monkeypatch):
    learning_is_hurried(monkeypatch)
    points = [s.points for s in few_scans[:2]]
    drawn = {"max_points": 200}  # by the seed, as it decides nothing of fits without labels otherwise
    first = make_learner(variant="cd", held_out=0, random_state=5, **drawn).fit(points).results_[0].vertices
    for seed, more in ((None, {}), (np.random.default_rng(0), {}), (np.int64(5), drawn)):
        fitter = make_learner(variant="cd", held_out=0, random_state=seed, **more).fit(points)
        assert all(r.status == "ok" for r in fitter.results_)
    np.testing.assert_array_equal(fitter.results_[0].vertices, first)  # the last seed was 5 again
    joint = make_learner(random_state=np.random.default_rng(1), held_out=0, training_scans=40).fit(points)
    assert len(joint.results_) == 2 and joint.history_[0]["recon_held_out"] is None
    assert joint.fit_scan(few_scans[4].points).status == "ok"


@pytest.mark.slow
def test_learning_again_starts_anew(make_learner, few_scans, monkeypatch):
    learning_is_hurried(monkeypatch)
    fitter = make_learner(variant="cd")
    first = fitter.fit([s.points for s in few_scans[:3]]).results_[0].vertices
    fitter.set_params(variant="free-form").fit([s.points for s in few_scans[:4]], list("abcd"))
    assert len(fitter.results_) == 4 and list(fitter.template_) == list("abcd")
    fitter.set_params(variant="cd").fit([s.points for s in few_scans[:3]])
    assert len(fitter.results_) == 3 and list(fitter.template_) == [0]
    np.testing.assert_array_equal(fitter.results_[0].vertices, first)
