"""Truth of the benchmark of pairs that lies beside its scans: it is asked about, in the right frame it is not."""

import json
import shutil

import numpy as np
import pytest
from registered_sets import fits_are_given

import lbsfit_np as lbs
from lbsfit_np.bench.truth import Landmarks, Registrations, note_on_truth
from lbsfit_np.starts.scale import extent
from lbsfit_np.synthesis import sample_surface

pytestmark = [pytest.mark.usefixtures("own_cache"), pytest.mark.usefixtures("one_thread")]

SHIFTS = [np.array(axis) / 2 for axis in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))]  # in extents


@pytest.fixture(scope="module")
def body():
    return lbs.load_rig("body-coarse")


@pytest.fixture(scope="module")
def points(body):
    return sample_surface(body.vertices, body.faces, 3000, np.random.default_rng(0))[0]


def _registered(body, points, shift=0.0, **options):
    return Registrations((body.vertices + shift * extent(points),), body.faces, **options).off(0, points)


def _named(places, points):
    return Landmarks(({f"p{k}": tuple(map(float, x)) for k, x in enumerate(places)},), ({},)).off(0, points)


@pytest.mark.parametrize("shift", SHIFTS)
def test_a_truth_that_is_shifted_by_half_the_extent_lies_beside(body, points, shift):
    assert _registered(body, points, shift) > 0.05
    some = np.random.default_rng(1).choice(len(points), 30, replace=False)
    assert _named(points[some] + shift * extent(points), points) > 0.05


def test_registrations_of_scans_that_show_a_part_or_a_floor_lie_on_them(body, points):
    """Or whose points are mostly unreliable."""
    head, front = points[:, 1] > np.quantile(points[:, 1], 0.8), points[:, 2] > np.median(points[:, 2])
    for part in (head, front):
        assert _registered(body, points[part]) < 0.01
    floor = np.random.default_rng(2).uniform(-1, 1, (6000, 3)) * (2.0, 0.0, 2.0) + (0, points[:, 1].min(), 0)
    assert _registered(body, np.vstack([points, floor])) < 0.05
    away = np.vstack([points, points + 5.0])
    assert _registered(body, away, reliable=(np.arange(len(away)) < len(points),)) < 0.01
    assert Registrations((None,), body.faces).off(0, points) == 0.0


def test_named_places_of_scans_that_show_a_part_lie_on_them(points):
    """Where some do: others are where nothing was scanned. Vertices always do."""
    part = points[points[:, 1] > np.quantile(points[:, 1], 0.6)]
    some = points[np.random.default_rng(3).choice(len(points), 60, replace=False)]
    assert _named(some, part) == 0.0 and _named(some, points) == 0.0
    assert Landmarks(({"a": 3},), ({},)).off(0, points) == 0.0 == _named(some, np.ones((9, 3)))


def test_the_note_names_scans_and_how_far():
    assert note_on_truth("registrations", {"a": 0.02, "b": 0.05}) == []
    words = note_on_truth("registrations", {"a": 0.4, "b": 0.01, "c": 0.52})
    where = "registrations of a, c lie 46 % of the extent off the points (median)"
    assert words == [f"{where}: are they in the scans' frame and unit? Errors are measured from them"]


@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_the_command_asks_before_it_fits(shift, pair_folder, pair_meshes, tube_rig, tmp_path, run, monkeypatch):
    from registered_sets import write_meshes

    folder = tmp_path / "scans"
    shutil.copytree(pair_folder, folder)
    write_meshes(folder / "reg", tube_rig, [v + (shift * extent(v), 0, 0) for v in pair_meshes])
    lines = ["scan,subject,registration", *(f"s{i},ann,reg/s{i}.ply" for i in range(4))]
    (folder / "truth.csv").write_text("\n".join(lines))
    fits_are_given(monkeypatch, {f"s{i}": v for i, v in enumerate(pair_meshes)})
    command = ("bench", "pairs", folder, "--truth", folder / "truth.csv", "--rig", folder / "tube.npz", "-o", tmp_path / "out")
    code, out, err = run(*command, "--no-learn", "--pictures", 0)
    notes = json.loads((tmp_path / "out" / "results.json").read_text())["notes"]
    assert (code, err) == (0, "")
    asked = "note: registrations of s0, s1, s2, s3 lie "
    assert (asked in out) == any(f"note: {note}".startswith(asked) for note in notes) == bool(shift)
    assert not shift or out.index(asked) < out.index("s0: fitted")
