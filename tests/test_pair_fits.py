"""Fits of the benchmark of pairs: what is kept and taken up again, and whose fits they are."""

import json
from dataclasses import replace

import numpy as np
import pytest
from registered_sets import fits_are_given, learning_is_given, result_of, what_fits_are_told, write_meshes

import lbsfit_np as lbs
from lbsfit_np.bench import pair_fits
from lbsfit_np.bench.pair_fits import fit_scans_of, made_files
from lbsfit_np.bench.truth import PairScan
from lbsfit_np.errors import InputError
from lbsfit_np.learning.archive import learned_digests, model_digest
from lbsfit_np.learning.checkpoint import Checkpoint, steps_in

pytestmark = [pytest.mark.usefixtures("own_cache"), pytest.mark.usefixtures("one_thread")]


@pytest.fixture
def fitter(tube_rig):
    return lbs.LBSFitter(tube_rig, random_state=0)


def test_fits_are_kept_and_taken_up(pair_scans, fitter, pair_meshes, tmp_path, monkeypatch):
    given = {s.name: v for s, v in zip(pair_scans, pair_meshes)} | {"s2": ValueError("bad"), "s3": KeyboardInterrupt()}
    asked = fits_are_given(monkeypatch, given)
    with pytest.raises(KeyboardInterrupt):
        fit_scans_of(fitter, pair_scans, tmp_path, settings={"seed": 0})
    assert sorted(p.name for p in (tmp_path / "fits").iterdir()) == ["s0.npz", "s1.npz"]
    asked.clear()
    given["s3"] = pair_meshes[3], {"status": "failed"}
    fits = fit_scans_of(fitter, pair_scans, tmp_path, settings={"seed": 0})
    assert asked == ["s2", "s3"] and [fits.entries[s.name].get("kept") for s in pair_scans] == [True, True, None, False]
    assert dict(fits.failures()) == {"s2": "ValueError: bad", "s3": "made up for 4 joints"}
    assert fits.has("s3") and not fits.has("s2") and np.array_equal(fits.load("s0").vertices, pair_meshes[0])


def test_where_nothing_was_made_other_settings_are_taken(pair_scans, fitter, pair_meshes, tmp_path, monkeypatch):
    """A run that could not learn may say how to, and then has to let that be done."""
    given = {s.name: v for s, v in zip(pair_scans, pair_meshes)}
    fits_are_given(monkeypatch, given)
    monkeypatch.setattr("lbsfit_np.bench.pair_fits._learn", lambda *a: (_ for _ in ()).throw(InputError("scans", "2", "3")))
    with pytest.raises(InputError, match="scans: got 2"):
        fit_scans_of(fitter, pair_scans, tmp_path, learn_from=pair_scans, settings={"held_out": 0.1})
    fits = fit_scans_of(fitter, pair_scans, tmp_path, settings={"held_out": 0.0})
    assert len(fits.entries) == len(pair_scans)


def test_fits_of_other_settings_or_scans_are_not_taken(pair_folder, fitter, tube_rig, pair_meshes, tmp_path, monkeypatch):
    copies = write_meshes(tmp_path / "in", tube_rig, pair_meshes[:2])
    scans = [PairScan(f"s{i}", copies / f"s{i}.ply", "ann") for i in range(2)]
    given = {s.name: v for s, v in zip(scans, pair_meshes)}
    asked = fits_are_given(monkeypatch, given)
    out = tmp_path / "out"
    out.mkdir()
    fit_scans_of(fitter, scans, out, settings={"seed": 0})
    asked.clear()
    with pytest.raises(InputError, match="fits made with seed 0; expected seed 1.*--existing replace"):
        fit_scans_of(fitter, scans, out, settings={"seed": 1})
    with pytest.raises(InputError, match="learned from nothing; expected fits that learned from 2 scans"):
        fit_scans_of(fitter, scans, out, learn_from=scans, settings={"seed": 0})
    assert asked == []
    write_meshes(copies, tube_rig, pair_meshes[2:3], "s1.ply")  # another scan of the same name
    given["s1"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        fit_scans_of(fitter, scans, out, settings={"seed": 0})
    given["s1"], asked[:] = pair_meshes[2], []
    fit_scans_of(fitter, scans, out, settings={"seed": 0})
    assert asked == ["s1"]
    (out / "fits" / "s0.npz").write_bytes(b"broken")
    fit_scans_of(fitter, scans, out, settings={"seed": 0})
    assert asked == ["s1", "s0"]
    result_of(tube_rig.subject(1), pair_meshes[1], 242).save(out / "fits" / "s1.npz")  # as of another run with the same names
    fit_scans_of(fitter, scans, out, settings={"seed": 0})
    assert asked == ["s1", "s0", "s1"]
    asked[:] = ["s1", "s0"]
    fit_scans_of(fitter, scans[:1], out, settings={"seed": 0})
    fit_scans_of(fitter, scans, out, settings={"seed": 0})  # fewer scans in between lose nothing
    assert asked == ["s1", "s0"]
    fit_scans_of(fitter, scans, out, settings={"seed": 1}, existing="replace")
    assert asked == ["s1", "s0", "s0", "s1"]
    (out / "fits.json").write_text("{}")
    with pytest.raises(InputError, match="fits.json.*cannot be read"):
        fit_scans_of(fitter, scans, out, settings={"seed": 1})


@pytest.mark.parametrize(
    "change, words",
    [
        ({"up": "+x"}, "rig's up [+]y; expected rig's up [+]x"),
        ({"forward": "-z"}, "rig's forward [+]z; expected rig's forward -z"),
        ({"metres_per_unit": 1.0}, "rig's metres per unit 0.25; expected rig's metres per unit 1.0"),
        ({"poses": {"wave": np.full((4, 3), 0.1)}}, "rig's poses .*; expected rig's poses "),
        ({"locked": np.arange(4) == 2}, "rig's joints that are still"),
    ],
)
def test_fits_of_a_rig_with_other_axes_are_not_taken(pair_scans, tube_rig, pair_meshes, tmp_path, monkeypatch, change, words):
    asked = fits_are_given(monkeypatch, {s.name: v for s, v in zip(pair_scans, pair_meshes)})
    still = np.arange(4)[:, None] == 2  # one that is locked has no limits
    limits = {name: np.where(still, 0.0, getattr(tube_rig, name)) for name in ("lower", "upper")}
    rig = replace(tube_rig, granularity="arm and fingers", **limits)
    other = replace(rig, **change)
    assert other.digest == rig.digest
    fit_scans_of(lbs.LBSFitter(rig), pair_scans[:2], tmp_path)
    with pytest.raises(InputError, match=words + ".*--existing replace"):
        fit_scans_of(lbs.LBSFitter(other), pair_scans[:2], tmp_path)
    assert asked == ["s0", "s1"]
    fit_scans_of(lbs.LBSFitter(other), pair_scans[:2], tmp_path, existing="replace")
    assert asked == ["s0", "s1", "s0", "s1"]


def test_what_was_learned_from_is_fitted_as_its_subjects(pair_scans, tube_rig, pair_meshes, tmp_path, monkeypatch):
    """Learning leaves s1; s3 was not learned from, and somebody of the same name may be another person."""
    given = {s.name: v for s, v in zip(pair_scans, pair_meshes)}
    asked = fits_are_given(monkeypatch, given)
    told = what_fits_are_told(monkeypatch)
    learned = learning_is_given(monkeypatch, given | {"s1": None})

    def fit(n_jobs=None):
        told.clear(), asked.clear()
        return fit_scans_of(lbs.LBSFitter(tube_rig, n_jobs=n_jobs), pair_scans, tmp_path, learn_from=pair_scans[:3])

    def subjects():
        return {name: subject for name, (subject, _) in told.items()}

    fit()
    assert learned == [[("s0", "ann"), ("s1", "ann"), ("s2", "bob")]] and subjects() == {"s1": "ann", "s3": None}
    assert [e["kept"] for e in fit().entries.values()] == [True] * 4 and asked == []
    for name in ("s0", "s2", "s3"):
        (tmp_path / "fits" / f"{name}.npz").unlink()
    fit(n_jobs=2)
    assert subjects() == {"s0": "ann", "s2": "bob", "s3": None} and {f.n_jobs for _, f in told.values()} == {2}
    assert [e["kept"] for e in fit().entries.values()] == [True] * 4 and asked == []
    assert list(json.loads((tmp_path / "fits.json").read_text())["learned_from"]) == ["s0", "s1", "s2"]
    # Fits of other models, of s3 as its namesake's, of ann as bob, and of ann as anybody, are not what would be made now.
    model = lbs.LBSFitter.load(tmp_path / "model.npz")
    named, learning = model_digest(model, "bob"), learned_digests(model)["bob"]
    anybody = dict.fromkeys(("s0", "s1", "s2"), model_digest(model))
    for others in ({"s0": "", "s2": "another", "s3": named}, {"s0": named}, anybody, {"s1": learning, "s3": learning}):
        for name, digest in others.items():
            replace(result_of(tube_rig, pair_meshes[0], 242), model_digest=digest).save(tmp_path / "fits" / f"{name}.npz")
        fit()
        whose = {"s0": "ann", "s1": "ann", "s2": "bob", "s3": None}
        assert subjects() == {name: whose[name] for name in others} and len(learned) == 1


def test_fits_of_another_state_of_the_code_are_not_mixed_with_others(pair_scans, fitter, pair_meshes, tmp_path, monkeypatch):
    fits_are_given(monkeypatch, {s.name: v for s, v in zip(pair_scans, pair_meshes)})
    fit_scans_of(fitter, pair_scans[:2], tmp_path)
    monkeypatch.setattr(pair_fits, "state_of_the_code", lambda: 64 * "f")
    with pytest.raises(InputError, match="fits made with code [0-9a-f]{12}….*expected code ffffffffffff….*--existing replace"):
        fit_scans_of(fitter, pair_scans, tmp_path)


@pytest.mark.parametrize("seed, kept", [(None, None), (3, "model.npz.unfinished")])
def test_without_a_seed_no_steps_are_kept(seed, kept, pair_scans, tube_rig, pair_meshes, tmp_path, monkeypatch):
    given = {s.name: v for s, v in zip(pair_scans, pair_meshes)}
    learning_is_given(monkeypatch, given)
    asked, fit = [], lbs.LBSFitter.fit
    monkeypatch.setattr(lbs.LBSFitter, "fit", lambda self, *a, **k: asked.append(k["checkpoint"]) or fit(self, *a, **k))
    fit_scans_of(lbs.LBSFitter(tube_rig, random_state=seed), pair_scans, tmp_path, learn_from=pair_scans)
    assert asked == [kept and tmp_path / kept]


def test_a_subject_of_whom_nothing_was_learned_is_anybody(pair_scans, fitter, pair_meshes, tmp_path, monkeypatch):
    given = {s.name: v for s, v in zip(pair_scans, pair_meshes)}
    fits_are_given(monkeypatch, given)
    told = what_fits_are_told(monkeypatch)
    learning_is_given(monkeypatch, given | {"s2": None, "s3": None})
    fit_scans_of(fitter, pair_scans, tmp_path, learn_from=pair_scans)
    assert {name: subject for name, (subject, _) in told.items()} == {"s2": None, "s3": None}


def test_a_model_of_somebody_else_is_not_what_was_learned(pair_scans, fitter, tube_rig, pair_meshes, tmp_path, monkeypatch):
    """A run that is stopped while it learns leaves no model that the next one takes for its own."""
    given = {s.name: v for s, v in zip(pair_scans, pair_meshes)}
    fits_are_given(monkeypatch, given)
    learned = learning_is_given(monkeypatch, given)
    foreign = lbs.LBSFitter(tube_rig, random_state=7).fit([lambda s=s: lbs.load_scan(s.path) for s in pair_scans[:1]], ["zoe"])
    foreign.save(tmp_path / "model.npz")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):

        def stopped(self, scans, subjects=None, **options):
            raise KeyboardInterrupt

        patch.setattr(lbs.LBSFitter, "fit", stopped)
        fit_scans_of(fitter, pair_scans, tmp_path, learn_from=pair_scans)
    assert (tmp_path / "fits.json").exists() and not (tmp_path / "model.npz").exists()
    learned.clear()
    fit_scans_of(fitter, pair_scans, tmp_path, learn_from=pair_scans)
    assert len(learned) == 1 and lbs.LBSFitter.load(tmp_path / "model.npz").template_.keys() == {"ann", "bob"}


@pytest.mark.parametrize("existing, kept", [("resume", 1), ("replace", 0)])
def test_a_loop_that_was_stopped_goes_on(existing, kept, pair_scans, fitter, pair_meshes, tmp_path, monkeypatch):
    """Its steps are no scans, and go with the model; a run that replaces takes none."""
    given = {s.name: v for s, v in zip(pair_scans, pair_meshes)}
    fits_are_given(monkeypatch, given)
    learning_is_given(monkeypatch, given)
    learn, found, folder = lbs.LBSFitter.fit, [], tmp_path / "model.npz.unfinished"

    def stopped(self, *args, checkpoint, **options):
        found.append(steps_in(checkpoint))
        Checkpoint(checkpoint).slot("first-fit").keep(1)
        if len(found) == 1:
            raise KeyboardInterrupt
        return learn(self, *args, **options)

    monkeypatch.setattr(lbs.LBSFitter, "fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        fit_scans_of(fitter, pair_scans, tmp_path, learn_from=pair_scans)
    assert set(made_files(tmp_path)) == set(folder.iterdir()) and steps_in(folder) == 1
    fit_scans_of(fitter, pair_scans, tmp_path, learn_from=pair_scans, existing=existing)
    assert found == [0, kept] and not folder.exists() and (tmp_path / "model.npz").is_file()
