"""Scans whose unit is said: their size stays free, and no other unit is claimed."""

import copy
import warnings
from dataclasses import replace

import numpy as np
import pytest
from animated_files import Viewer
from learning_runs import SMALL, rounds_are_short
from slow_tests import slow
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.fitting import assemble
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.fitting.scout import Scout
from lbsfit_np.fitting.several import odd_scales, unit_of
from lbsfit_np.learning.reading import read_collection
from lbsfit_np.learning.sizes import allowed_unit, of_a_size_allowed
from lbsfit_np.optimize.model import Model
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.units import WORDS
from lbsfit_np.starts.clean import taking_part
from lbsfit_np.starts.scale import reference_scale, sizes_in, unit_note
from lbsfit_np.starts.turns import facing_of

# One unit of the tube rig is 0.25 m.
CM, MM = 25.0, 250.0


@pytest.fixture(scope="module")
def unknown_rig():
    """The tube rig, without its unit."""
    return build_rig(replace(make_tube_data(), metres_per_unit=None))


# ---- the reference scale, and what is said ----


def test_what_labels_name_is_compared_with_its_own_part_of_the_rig(tube_rig, tube_scan):
    """A finger's extent says nothing of the whole body's unit or size."""
    of, shown = tube_scan.labels == 3, tube_rig.vertex_labels == 3
    for size in (0.6, 1.0, 1.5):
        assert reference_scale(size * tube_scan.points[of], tube_rig, "estimate", shown=shown).scale == 1.0
    tiny = 0.2 * CM * tube_scan.points[of]  # a small subject's
    with pytest.raises(InputError, match="unit: got 'cm', in which the scan's extent is"):
        reference_scale(tiny, tube_rig, "estimate", "cm")
    assert reference_scale(tiny, tube_rig, "estimate", "cm", shown=shown).scale == pytest.approx(0.2 * CM, rel=0.5)
    none = reference_scale(tube_scan.points, tube_rig, "estimate", shown=np.zeros(len(shown), dtype=bool))
    assert none == reference_scale(tube_scan.points, tube_rig, "estimate")
    how = {"most": 100, "scale": "estimate", "labels": tube_scan.labels[of]}
    for size in (0.6, 1.5):  # the first would be another unit, were it of all of the body
        assert taking_part(size * tube_scan.points[of], tube_rig, rng=np.random.default_rng(0), **how).scale == 1.0


@pytest.mark.parametrize("options", [{}, {"unit": "m"}, {"scale": "fixed"}])
def test_labelled_parts_may_be_far_from_each_other(options):
    """Feet apart are further from each other than at rest, but no further than the rig is long."""
    rig = lbs.load_rig("body-coarse")
    (scan,) = lbs.synthesize(rig, 1, poses=rig.poses["yoga warrior"][None], shape=0.0, holes=0, noise=0.0, random_state=0)
    feet = np.isin(scan.labels, [k for k, name in enumerate(rig.parts) if "ankle" in name or "foot" in name])
    kept = {"most": 500, "rng": np.random.default_rng(0), "labels": scan.labels[feet]} | {"scale": "estimate"} | options
    assert taking_part(scan.points[feet], rig, **kept).scale == 1.0


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)])
def test_the_reference_scale_is_the_conversion(tube_rig, tube_scan, unit, metres):
    one = tube_rig.metres_per_unit / metres
    for size in (0.7, 1.0, 1.5):
        assert reference_scale(size * one * tube_scan.points, tube_rig, "estimate", unit).scale == one
        assert reference_scale(one * tube_scan.points, tube_rig, "fixed", unit).scale == one
    for size in (0.25, 4.0):  # as far from the rig's as animals are
        found = reference_scale(size * one * tube_scan.points, tube_rig, "estimate", unit)
        assert 0.5 < found.scale / (size * one) < 1.8 and found.note == f"the scan is in {WORDS[unit]}"


@pytest.mark.parametrize("size", [0.04, 15.0])
def test_a_scan_in_another_unit_than_said_is_an_error(tube_rig, tube_scan, size):
    words = r"^unit: got 'cm', in which the scan's extent is [\d.]+ times the rig's; expected .* 0\.1 to 7\.2 .*\(--unit auto\)"
    with pytest.raises(InputError, match=words):
        reference_scale(size * CM * tube_scan.points, tube_rig, "estimate", "cm")


def test_a_fixed_scale_wants_the_rigs_size(tube_rig, tube_scan):
    words = r"^scale: got 'fixed' for a scan in 'cm' whose extent is .*; expected a scan of the rig's size. Check unit \(--unit\)"
    for points in (0.25 * CM * tube_scan.points, tube_scan.points):
        with pytest.raises(InputError, match=words):
            reference_scale(points, tube_rig, "fixed", "cm")


def test_starts_are_of_sizes_that_subjects_have(tube_rig, quick_fitter, tube_scan):
    """0.25 to 4 times the rig's, where the scan's unit is known; about as large, where its size is."""
    library, points, turns = quick_fitter.regressor_, CM / tube_scan.scale * tube_scan.points, np.eye(3)[None]

    def sizes(size, **known):
        return np.array([s.scale / CM for s in library.starts(size * points, turns, 10, **known)])

    known = sizes_in(tube_rig, "cm")
    assert sizes_in(tube_rig, None) == {} and sizes(4.2).max() > 4.1 > 4 > sizes(4.2, **known).max()
    assert sizes(0.24).min() < 0.245 < 0.25 < sizes(0.24, **known).min()
    np.testing.assert_array_equal(sizes(1.5, **known), sizes(1.5))
    assert sizes(1.5, unit=CM).max() < 1.35 < sizes(1.5).max()
    for scale, expected in (("estimate", known), ("fixed", {"unit": CM})):
        scout = Scout(Model(tube_rig), library, facing_of(tube_rig, "aligned"), None, FitSettings(unit="cm", scale=scale))
        assert scout._sizes == expected


@pytest.mark.parametrize(
    "scale, size, mode, words",
    [
        (0.57, 1.0, "estimate", "the scan is in centimetres, and the subject is 0.57 times as large as the rig"),
        (2.0, 1.0, "estimate", "the scan is in centimetres, and the subject is 2.00 times as large as the rig"),
        (1.0, 1.2, "estimate", "the scan is in centimetres, and the subject is 1.20 times as large as the rig"),
        (9.0, 1.0, "estimate", "and the subject is 9.00 times as large as the rig (is the scan in centimetres?)"),
        (1.0, 1.0, "fixed", "the scan is in centimetres, and its size is fixed at the rig's"),
    ],
)
def test_the_message_says_the_size(tube_rig, scale, size, mode, words):
    rig = replace(tube_rig, metres_per_unit=0.01)
    assert unit_note(scale, rig, mode, unit="cm", size=size).endswith(words)


@pytest.mark.parametrize(
    "scale, metres, words, sizes",
    [
        (0.57, 0.01, "seems to be in inches: one rig unit is 0.57 scan units", "in centimetres 0.57"),
        (2.0, 0.01, "is in another unit or of another size: one rig unit is 2 scan units", "in centimetres 2.00"),
        (20.0, 1.0, "is in another unit or of another size: one rig unit is 20 scan units", "in inches 0.51"),
        (
            *(2.7, 0.015, "is in another unit or of another size: one rig unit is 2.7 scan units"),
            "in centimetres 1.80 or in the rig's unit 2.70",
        ),
        (
            *(2.0, 0.25, "is in another unit or of another size: one rig unit is 2 scan units"),
            "in feet 2.44 or in the rig's unit 2.00",
        ),
        (5.0, 1.0, "is in another unit or of another size: one rig unit is 5 scan units", "in feet 1.52"),
        (12.0, 1.0, "is in another unit or of another size: one rig unit is 12 scan units", None),
        (2.0, None, "is in another unit or of another size: one rig unit is 2 scan units", None),
        (96.0, 1.0, "seems to be in centimetres: one rig unit is 96 scan units", None),
    ],
)
def test_without_a_unit_sizes_in_those_that_are_near_are_told(tube_rig, scale, metres, words, sizes):
    also = f" ({sizes} times as large as the rig: if the unit is known, pass unit or --unit)" if sizes else ""
    assert unit_note(scale, replace(tube_rig, metres_per_unit=metres), "estimate") == f"the scan {words}{also}"


# ---- fits ----


@pytest.mark.parametrize("size", [0.5, slow(2.5)])
def test_the_size_is_found_in_the_unit_that_was_said(tube_rig, quick_fitter, tube_scan, size, tmp_path):
    points = size * MM * tube_scan.points
    plain = quick_fitter.fit_scan(points)
    fitter = copy.copy(quick_fitter).set_params(unit="mm")
    r = fitter.fit_scan(points)
    found = r.scale / MM
    assert (r.unit, plain.unit) == ("mm", "") and found == pytest.approx(size * tube_scan.scale, rel=0.05)
    assert r.scale == pytest.approx(plain.scale, rel=0.01)
    assert f"the scan is in millimetres, and the subject is {found:.2f} times as large as the rig" in r.message
    assert f"(in millimetres {plain.scale / MM:.2f} " in plain.message
    r.save(tmp_path / "a.npz")
    assert lbs.FitResult.load(tmp_path / "a.npz").unit == "mm"
    lbs.save_animation(tmp_path / "a.glb", tube_rig, r)
    drawn = Viewer(tmp_path / "a.glb").draw()
    lengths = [np.linalg.norm(np.ptp(v, axis=0)) for v in (drawn, r.vertices)]
    assert lengths[0] == pytest.approx(lengths[1] / 1000, rel=0.05)


@pytest.mark.slow
def test_a_fixed_scale_is_the_conversion(quick_fitter, tube_scan):
    fitter = copy.copy(quick_fitter).set_params(unit="cm", scale="fixed")
    r = fitter.fit_scan(CM / tube_scan.scale * tube_scan.points)
    assert r.scale == pytest.approx(CM, rel=1e-12) and r.unit == "cm" and "its size is fixed at the rig's" in r.message
    same = copy.copy(quick_fitter).set_params(scale="fixed").fit_scan(tube_scan.points / tube_scan.scale)
    apart = np.linalg.norm(r.joints / CM - same.joints, axis=1).max() / fitter.rig.size
    assert apart < 0.005  # rounding alone, which decides between points that are as near


@pytest.mark.parametrize("given", ["theta0", "labels"])
def test_a_start_or_labels_are_taken_in_the_unit_that_was_said(fitter, tube_scan, given):
    known = {"theta0": tube_scan.pose} if given == "theta0" else {"labels": tube_scan.labels}
    fitter.set_params(unit="cm")
    r = fitter.fit_scan(0.5 * CM * tube_scan.points, **known)
    assert r.unit == "cm" and r.scale / CM == pytest.approx(0.5 * tube_scan.scale, rel=0.1)
    assert "the scan is in centimetres, and the subject is 0.5" in r.message or "subject is 0.4" in r.message


def test_a_fit_without_skinning_says_the_unit_alone(fitter, tube_scan):
    fitter.set_params(unit="cm", variant="free-form")
    r = fitter.fit_scan(0.5 * CM * tube_scan.points)
    assert r.unit == "cm" and r.message.endswith("; the scan is in centimetres")


@pytest.mark.parametrize("unit", ["inches", "CM", "", 0.01, ["cm"]])
def test_a_unit_is_one_of_a_cards(fitter, tube_scan, unit):
    with pytest.raises(InputError, match=r"^unit: got .*; expected 'm', 'cm', 'mm', 'in', 'ft' or None"):
        fitter.set_params(unit=unit).fit_scan(tube_scan.points)


def test_a_unit_needs_a_rig_whose_own_is_known(unknown_rig, tube_scan):
    words = r"^unit: got 'cm' with the rig 'tube', whose own unit is not known; expected .*card \(\[rig\] unit\), before learning"
    with pytest.raises(InputError, match=words):
        lbs.fit_scan(unknown_rig, tube_scan.points, unit="cm")
    with pytest.raises(InputError, match=words):
        lbs.LBSFitter(unknown_rig, unit="cm").fit([tube_scan.points])


def test_a_wrong_unit_is_told_before_training(tube_rig, tube_scan):
    with pytest.raises(InputError, match="^unit: got 'mm', in which the scan's extent is 0.0"):
        lbs.LBSFitter(tube_rig, unit="mm").fit_scan(tube_scan.points)  # 4,000 scans to train on would take minutes


def test_a_file_with_a_unit_that_is_none_is_refused(tube_result, tmp_path):
    replace(tube_result, unit="ell").save(tmp_path / "a.npz")
    with pytest.raises(FileError, match="unit is 'ell'"):
        lbs.FitResult.load(tmp_path / "a.npz")


# ---- animations ----


def test_fits_say_the_unit_of_an_animation(tube_rig, tube_result, tmp_path):
    said = [replace(tube_result, unit="cm", scale=scale) for scale in (10.0, 60.0)]
    assert unit_of(tube_rig, said) == unit_of(tube_rig, [said[0], tube_result]) == ("centimetres", 0.01)
    assert odd_scales(said) == []  # young and old
    assert odd_scales([said[0], replace(said[1], unit="")]) == [1]
    mixed = [said[0], replace(tube_result, unit="mm")]
    words = r"^results: got fits of scans in cm \(results\[0\]\), mm \(results\[1\]\); expected scans in one unit"
    with pytest.raises(InputError, match=words):
        lbs.save_animation(tmp_path / "a.glb", tube_rig, mixed)
    with pytest.raises(InputError, match="^results: got a fit with the unit 'ell'"):
        lbs.save_animation(tmp_path / "a.glb", tube_rig, replace(tube_result, unit="ell"))
    assert not (tmp_path / "a.glb").exists()
    with pytest.warns(UserWarning, match="are all scans in one unit"):  # they are in what is said at last
        lbs.save_animation(tmp_path / "a.glb", tube_rig, [*said, replace(mixed[1], scale=1e3)], metres_per_unit=0.01)


# ---- collections, and what was learned ----


def test_scans_in_a_known_unit_may_be_of_any_size(tube_rig, few_scans):
    scans = [size * CM * s.points for size, s in zip((0.3, 0.3, 1.0, 3.0, 3.0), few_scans)]
    known = {"max_points": 300, "held_out": 0.0, "scale": "estimate", "random_state": 0}
    with pytest.raises(InputError, match="different units"):
        read_collection(tube_rig, scans, None, **known)
    found = read_collection(tube_rig, [*scans, 100 * scans[0]], None, **known, unit="cm")
    assert len(found.members) == 5 and {m.unit for m in found.members} == {CM}
    assert found.failures[5].startswith("unit: got 'cm', in which")


@pytest.fixture(scope="module")
def kit_and_fox(make_learner, people_scans):
    """A fitter that has learned from scans in centimetres of two subjects, half and 1.6 times as large as the rig."""
    scans, subjects = [], []
    for k in range(4):
        scans.append((0.5, 1.6)[k % 2] * CM * people_scans[k].points)
        subjects.append(("kit", "fox")[k % 2])
    fitter = make_learner(unit="cm", variant="cd")
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        rounds_are_short(patch)
        warnings.filterwarnings("error", message=".*in another unit")
        return fitter.fit(scans, subjects)


def test_subjects_sizes_are_told(tube_rig, kit_and_fox, tmp_path):
    assert kit_and_fox.learned_unit_ == "cm"
    for r in kit_and_fox.results_:
        size = r.scale / CM * kit_and_fox.template_[r.subject].size / tube_rig.size
        assert size == pytest.approx({"kit": 0.5, "fox": 1.6}[r.subject], rel=0.12)  # people differ, too
        assert r.unit == "cm" and f"the scan is in centimetres, and the subject is {size:.2f} times as large as" in r.message
    kit_and_fox.save(tmp_path / "m.npz")
    again = lbs.LBSFitter.load(tmp_path / "m.npz")
    assert (again.unit, again.learned_unit_) == ("cm", "cm")


@pytest.mark.parametrize(("unit", "factor"), [("cm", 1.0), ("mm", 10.0)])
def test_a_subjects_size_is_known_in_any_unit(kit_and_fox, people_scans, unit, factor):
    fitter = copy.copy(kit_and_fox).set_params(unit=unit)
    r = fitter.fit_scan(factor * 0.5 * CM * people_scans[8].points, subject="kit")
    assert r.scale == pytest.approx(factor * fitter.unit_["kit"], rel=1e-9)  # as learned, not found anew
    size = r.scale / (factor * CM) * fitter.template_["kit"].size / fitter.rig.size  # the template takes up part of it
    assert r.unit == unit and f"the scan is in {WORDS[unit]}, and the subject is {size:.2f} times" in r.message
    with pytest.raises(InputError, match=f"^unit: got {unit!r}, in which the scan's extent is"):
        fitter.fit_scan(100 * factor * CM * people_scans[8].points, subject="kit")


@pytest.mark.parametrize("unit", ["cm", None])
def test_a_subject_of_another_size_than_learned_is_asked_about(kit_and_fox, people_scans, unit):
    """The unit that was said may be that of other scans, as the model's own is where none is said."""
    fitter = copy.copy(kit_and_fox).set_params(unit=unit)
    r = fitter.fit_scan(3 * 0.5 * CM * people_scans[8].points, subject="kit")
    ratio = r.scale / fitter.unit_["kit"]
    assert ratio == pytest.approx(3.0, rel=0.15)
    asked = f" times as large as the rig, and {ratio:.3g} times as large as learned (is the scan in centimetres?)"
    assert (asked in r.message) == (unit == "cm") and ("as large as learned" in r.message) == (unit == "cm")


def test_a_subject_that_is_much_larger_than_the_rig_and_than_learned_is_asked_about_once(kit_and_fox, people_scans):
    r = kit_and_fox.fit_scan(4 * 1.6 * CM * people_scans[9].points, subject="fox")
    assert r.scale / CM * kit_and_fox.template_["fox"].size / kit_and_fox.rig.size > 5  # of which the size alone would ask
    assert r.message.count("is the scan in centimetres?") == 1 and "as large as learned (is" in r.message


def test_learned_sizes_are_converted_where_both_units_were_said(kit_and_fox):
    learned = kit_and_fox.unit_["kit"]
    for then, now, factor in (("cm", "mm", 10.0), ("cm", None, 1.0), (None, "mm", 1.0), ("in", "in", 1.0)):
        fitter = copy.copy(kit_and_fox)
        fitter.learned_unit_ = then
        assert allowed_unit(fitter, "kit", factor * learned, FitSettings(unit=now)) == pytest.approx(factor * learned)
        assert allowed_unit(fitter, "kit", 3 * factor * learned, FitSettings(unit=now)) is None


@pytest.mark.slow
def test_a_fixed_scale_is_not_that_of_a_subject_of_another_size(kit_and_fox, people_scans):
    """Whose template is none for scans of anybody then, either; sizes are those that results tell."""
    fitter = copy.copy(kit_and_fox).set_params(scale="fixed", unit="mm")
    sizes = {s: fitter.unit_[s] / CM * fitter.template_[s].size / fitter.rig.size for s in ("kit", "fox")}
    points, words = 10 * CM * people_scans[8].points, "^scale: got 'fixed', the rig's size, for "
    with pytest.raises(InputError, match=f"{words}subject 'kit', who is {sizes['kit']:.2f} times as large"):
        fitter.fit_scan(points, subject="kit")
    low, high = sorted(sizes.values())
    with pytest.raises(InputError, match=f"{words}the 2 subjects, who are {low:.2f} to {high:.2f} times as large"):
        fitter.fit_scan(points)
    fitter.unit_ = {"kit": CM, "fox": fitter.unit_["fox"]}
    allowed = of_a_size_allowed(fitter, ["fox", "kit"], FitSettings(scale="fixed", unit="mm"))
    assert allowed == ["kit"] and allowed_unit(fitter, "kit", 1.0, FitSettings(scale="fixed", unit="mm")) == MM
    assert fitter.fit_scan(points).scale == pytest.approx(MM) and fitter.transform([points]).shape[0] == 1
    fitter.learned_unit_ = None  # of what size nobody knows
    for known in ({"scale": "fixed", "unit": "mm"}, {"scale": "fixed"}, {"unit": "mm"}):
        assert of_a_size_allowed(fitter, ["fox", "kit"], FitSettings(**known)) == ["fox", "kit"]


def test_the_unit_is_part_of_what_was_learned(kit_and_fox):
    from lbsfit_np.learning.archive import model_digest

    other = copy.copy(kit_and_fox)
    other.learned_unit_ = "mm"
    assert model_digest(other) != model_digest(kit_and_fox)


@pytest.mark.usefixtures("hurried")
def test_collections_of_the_rigs_size_may_have_it_fixed(tube_rig, small_segmenter, people_scans):
    fitter = lbs.LBSFitter(tube_rig, **SMALL | {"unit": "cm", "scale": "fixed", "held_out": 0.0, "training_scans": 40})
    fitter.pretrain(segmenter=small_segmenter)
    fitter.fit([CM * s.points for s in people_scans[:4:2]])
    assert list(fitter.unit_.values()) == [CM] and {r.scale for r in fitter.results_} == {CM}
    assert all("its size is fixed at the rig's" in r.message for r in fitter.results_)


def test_collections_without_skinning_have_units(tube_rig, few_scans):
    scans = [size * CM * s.points for size, s in zip((0.3, 1.0, 3.0), few_scans)]
    fitter = lbs.LBSFitter(tube_rig, **SMALL | {"unit": "cm", "variant": "free-form"}).fit(scans)
    assert [r.unit for r in fitter.results_] == ["cm"] * 3 and fitter.learned_unit_ == "cm"
    assert not any("Convert" in r.message or "inches" in r.message for r in fitter.results_)


@pytest.mark.parametrize("unit, large, first", [("cm", 0.1, True), ("cm", 9.0, False), (None, 0.1, False)])
def test_of_a_subject_that_would_be_too_large_is_asked_first_what_the_scan_shows(
    unit, large, first, quick_fitter, tube_scan, monkeypatch
):
    """Rooms and people side by side are: their unit and how they stand may well be as was said."""
    monkeypatch.setattr(assemble, "_LARGE", large)
    points = CM * tube_scan.points / tube_scan.scale * [1.0, 1.0, -1.0]
    points[::2] += 40.0
    r = copy.copy(quick_fitter).set_params(unit=unit, effort="fast").fit_scan(points)
    asked = next(words for words in r.message.split("; ") if "is it the right rig" in words)
    assert r.status == "failed" and asked.startswith("does the scan show only the body") == first
