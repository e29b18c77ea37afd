"""What the study learns from and is tested on: whose poses, which share of them natural, and what rows are given of it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from study_sizes import TINY

from lbsfit_np.bench.run import TRAINING_SEED
from lbsfit_np.bench.study import data
from lbsfit_np.bench.study.data import SCAN, SIZES, Size, kind_of, part_groups, sized, study_set
from lbsfit_np.bench.study.first_segmenter import first_scans, first_segmenter
from lbsfit_np.bench.study.measures import Registrations
from lbsfit_np.bench.study.rows import ROWS, Found
from lbsfit_np.bench.study.run import study
from lbsfit_np.errors import InputError
from lbsfit_np.io.rigs import load_rig
from lbsfit_np.learning.fitter import LBSFitter
from lbsfit_np.synthesis import synthesize

MANY = Size(train=300, test=200, train_subjects=2, test_subjects=2, pairs=1, training_scans=1, rounds=1, seeds=1)


@pytest.fixture
def drawn(monkeypatch):
    """Scans that are their poses alone; (the library that poses are near, or None; pose) of each in turn."""
    calls = []

    def recorded(draw, natural):
        def drawn(rig, n, rng):
            poses = draw(rig, n, rng)
            calls.append((rig.poses if natural else None, poses[0]))
            return poses

        return drawn

    monkeypatch.setattr(data, "natural_poses", recorded(data.natural_poses, True))
    monkeypatch.setattr(data, "uniform_poses", recorded(data.uniform_poses, False))
    monkeypatch.setattr(data, "synthesize_one", lambda rig, pose, *made_of: SimpleNamespace(pose=pose))
    return calls


@pytest.mark.parametrize("name, share", [("hand-coarse", 0.5), ("body-coarse", 20 / 23)])
def test_natural_poses_are_of_their_own_half_of_the_library_and_as_many_as_in_the_paper(name, share, drawn):
    rig = load_rig(name)
    given = study_set(rig, MANY, 300)
    scans = [*given.train, *given.test]
    assert [pose.tobytes() for _, pose in drawn] == [s.pose.tobytes() for s in scans]
    libraries = {"train": drawn[: MANY.train], "test": drawn[MANY.train :]}
    names = {}
    for purpose, calls in libraries.items():
        natural = [library for library, _ in calls if library is not None]
        assert len(natural) / len(calls) == pytest.approx(share, abs=0.08)
        (names[purpose],) = {tuple(library) for library in natural}  # one library for all of them
    train, test = map(set, names.values())
    assert not train & test and train == set(given.rig.poses) and train | test <= set(rig.poses)
    assert 0.15 < len(test) / len(rig.poses) < 0.35  # every fourth
    apart = [np.abs(rig.poses[a] - rig.poses[b]).max() for a in train for b in test]
    assert min(apart) >= 0.3


def test_a_rig_without_natural_poses_has_uniform_ones_alone(tube_rig, drawn):
    given = study_set(tube_rig, replace(MANY, train=5, test=5), 300)
    assert len([*given.train, *given.test]) == 10
    assert not tube_rig.poses and [library for library, _ in drawn] == [None] * 10


def test_scans_are_made_when_they_are_asked_for_and_are_the_same_each_time():
    """At the paper's size all of them with their truth would fill the memory."""
    scans = study_set(load_rig("hand-coarse"), replace(MANY, train=6), 300).train
    assert scans[1] is not scans[1] and len(scans) == 6 and len(scans[1:]) == 5
    assert np.array_equal(scans[1].points, scans[1].points) and np.array_equal(scans[-1].points, scans[5].points)
    assert np.array_equal(scans[1].template, scans.templates[scans.subjects[1]][0])
    with pytest.raises(IndexError):
        scans[6]


def test_every_scan_has_missing_areas_noise_and_a_shape_of_its_subject_alone():
    assert (SCAN.holes, SCAN.least_holes) == (2, 1)
    assert (SCAN.n_points, SCAN.noise, SCAN.density, SCAN.shape) == (2500, 0.004, 0.5, 0.0)
    assert (SCAN.turn, SCAN.scale, SCAN.clutter, SCAN.floor, SCAN.one_sided) == (0, 0, 0, 0, False)


# ---- what rows are given ----


def test_the_fitter_knows_nothing_of_the_test_and_trains_with_one_seed(monkeypatch):
    """Poses of the test in the fitter's rig would be a leak."""
    contexts = []

    def find(c):
        contexts.append(c)
        return Found(Registrations(*(np.array([getattr(s, what) for s in c.given.test]) for what in ("vertices", "joints"))))

    rig, size = load_rig("hand-coarse"), Size(3, 2, 1, 1, 2, 77, 5, 1)
    monkeypatch.setattr("lbsfit_np.bench.study.making.ROWS", {"joint": replace(ROWS["joint"], find=find, pretrained=False)})
    monkeypatch.setitem(data.SIZES, "small", size)
    monkeypatch.setattr(data, "SCAN", replace(SCAN, n_points=50))
    monkeypatch.setattr("lbsfit_np.bench.study.run.along_path", lambda rig: None)
    study({"hand": rig}, rows=("joint",), seeds=[1, 2])
    assert [c.seed for c in contexts] == [1, 2] and TRAINING_SEED not in (1, 2)
    for c in contexts:
        assert set(c.fitter.rig.poses) == set(c.given.rig.poses) < set(rig.poses) == set(c.source.poses)
        assert c.fitter.orientation == "aligned" and c.fitter.random_state == TRAINING_SEED
        assert (c.fitter.training_scans, c.fitter.rounds) == (77, 5)
    # The same scans for whoever asks with that seed.
    again = study_set(rig, size, 2)
    for a, b in zip([*contexts[1].given.train, *contexts[1].given.test], [*again.train, *again.test], strict=True):
        assert np.array_equal(a.points, b.points)


@pytest.mark.parametrize("name", ["hand", "body-coarse"])
def test_a_small_size_begins_with_the_packages_segmenter(name, monkeypatch):
    monkeypatch.setattr("lbsfit_np.learning.pretraining.pretrain_library", lambda *made_of, **how: None)  # which takes long
    rig = load_rig(name)
    (scan,), begun = synthesize(rig, 1, random_state=5, n_points=300), first_segmenter(rig, sized(rig, "small"))
    assert first_scans(rig, sized(rig, "small")) == LBSFitter(rig).training_scans == 4000
    shipped = LBSFitter(rig, random_state=TRAINING_SEED).pretrain().segmenter_
    assert np.array_equal(begun.predict_proba(scan.points, views=1), shipped.predict_proba(scan.points, views=1))


def test_a_size_of_more_scans_and_a_rig_without_a_segmenter_train_their_own():
    for rig, size, n in ((load_rig("hand"), "medium", 16000), (load_rig("hand-coarse"), "small", 200)):
        size = sized(rig, size)
        assert (first_scans(rig, size), first_segmenter(rig, size)) == (n, None)


def test_rows_learn_from_the_segmenter_that_the_report_tells_of(monkeypatch):
    contexts = []

    def find(c):
        contexts.append(c)
        return Found(Registrations(*(np.array([getattr(s, what) for s in c.given.test]) for what in ("vertices", "joints"))))

    monkeypatch.setattr("lbsfit_np.bench.study.making.ROWS", {"rand": replace(ROWS["rand"], find=find)})
    monkeypatch.setitem(data.SIZES, "small", Size(3, 2, 1, 1, 2, 20, 1, 1))
    monkeypatch.setattr("lbsfit_np.bench.study.run.along_path", lambda rig: None)
    rig = load_rig("hand")
    report = study({"hand": rig}, rows=("rand",), seeds=[1])
    ((scan, *_), s) = contexts[0].given.test, contexts[0].fitter._pretrained[0]
    begun = first_segmenter(rig, sized(rig, "small"))
    assert np.array_equal(s.predict_proba(scan.points), begun.predict_proba(scan.points))
    assert report["rigs"]["hand"]["first_scans"] == 4000
    # Rows that began otherwise are not mixed with these.
    for first in ({"first_scans": 20}, {}):
        entry = {key: value for key, value in report["rigs"]["hand"].items() if key != "first_scans"} | first
        with pytest.raises(InputError, match="'hand' whose segmenters began with other scans.* 4,000 synthetic scans"):
            study({"hand": rig}, rows=("rand",), seeds=[1], before=report | {"rigs": {"hand": entry}})


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        (("pelvis", "left_knee", "left_thumb1"), "body"),
        (("wrist", "Thumb_1", "index_1"), "hand"),
        *(((leg, "LeftHandThumb1"), "other") for leg in ("Hips", "LeftUpLeg", "thigh.L", "KneeLeft", "R_Foot", "Pelvis")),
        (("root", "tail"), "other"),
    ],
)
def test_a_body_with_thumbs_is_no_hand(names, kind):
    assert kind_of(SimpleNamespace(joint_names=names)) == kind


def test_training_and_test_share_neither_poses_nor_people(coarse_hand, tiny_study):
    names = set(tiny_study.rig.poses)
    assert 0.5 * len(coarse_hand.poses) < len(names) < len(coarse_hand.poses)  # the rest is for the test
    held_out = [pose for name, pose in coarse_hand.poses.items() if name not in names]
    apart = [np.abs(tiny_study.rig.poses[name] - pose).max() for name in names for pose in held_out]
    assert len(held_out) > 8 and np.sort(apart)[3] > 0.3
    templates = {s.template.tobytes() for s in tiny_study.train} & {s.template.tobytes() for s in tiny_study.test}
    assert not templates and len({s.template.tobytes() for s in tiny_study.train}) == TINY.train_subjects
    body = study_set(load_rig("body-coarse"), replace(TINY, train=1, test=1), 300).rig.poses
    assert all(name.removesuffix(" (mirrored)") in body for name in body)  # a pose and its mirror image are never apart


def test_scans_are_a_function_of_seed_and_number(coarse_hand, tiny_study):
    again, more = study_set(coarse_hand, TINY, 300), study_set(coarse_hand, TINY, 300, times=3)
    assert all(
        np.array_equal(a.points, b.points) for a, b in zip([*tiny_study.train, *tiny_study.test], [*again.train, *again.test])
    )
    assert len(more.train) == 12 and more.train_subjects[:4] == tiny_study.train_subjects and len(set(more.train_subjects)) == 6
    assert all(np.array_equal(a.points, b.points) for a, b in zip(tiny_study.train, more.train))
    assert not np.array_equal(study_set(coarse_hand, TINY, 301).train[0].points[:9], tiny_study.train[0].points[:9])
    # Missing areas in every scan.
    assert len(tiny_study.train[0].points) <= 2500 and np.abs(tiny_study.train[0].points).max() < 3 * coarse_hand.size


def test_sizes_are_the_papers(coarse_hand):
    assert (sized(coarse_hand, "paper").train, sized(coarse_hand, "paper").test) == (1500, 300)
    body = sized(load_rig("body-coarse"), "paper")
    assert (body.train, body.test, body.pairs) == (23000, 2300, 4000)
    assert sized(coarse_hand, "small") == SIZES["small"]
    with pytest.raises(InputError, match="'huge'.*small, medium, paper"):
        sized(coarse_hand, "huge")


def test_groups_of_parts_are_fingers_and_limbs(coarse_hand):
    groups = part_groups(coarse_hand)
    named = {}
    for part, group in zip(coarse_hand.parts, groups):
        named.setdefault(group, []).append(part)
    assert len(named) == 6 and sorted(map(len, named.values())) == [1, 3, 3, 3, 3, 3]
    assert any(all("index" in part for part in parts) for parts in named.values())
