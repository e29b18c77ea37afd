"""The files that a checkpoint keeps steps in: what comes back of them, where they can be, and what is removed."""

from pathlib import Path

import numpy as np
import pytest

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.learning.checkpoint import Checkpoint, each_kept, remove_checkpoint, steps_in
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.state import State


@pytest.fixture(scope="module")
def points(few_scans):
    return [s.points for s in few_scans[:4]]


def test_answers_come_back_exactly(tmp_path, learned_people):
    rng = np.random.default_rng(0)
    state = State(rng.normal(size=(4, 3)), rng.normal(size=3), 1 / 3, rng.normal(size=2).astype(np.float32), None)
    frame = Frame(rng.normal(size=3), np.float64(0.1), np.eye(3))
    more = {"a": (), "b": [{}], "array": rng.normal(size=2)}
    given = (frame, state, 0.1 + 0.2, None), [True, 7, "é\0", np.inf, np.nan, -0.0], more
    slot = Checkpoint(tmp_path / "deep" / "er").slot("result", 1)
    assert slot.known() is None and slot.keep(given) is given
    _assert_equal(slot.known(), given)
    result = learned_people.results_[0]
    _assert_equal(slot.keep((result, None)) and slot.known(), (result, None))


def _assert_equal(a, b):
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, (tuple, list)):
        assert len(a) == len(b)
        for x, y in zip(a, b):
            _assert_equal(x, y)
    elif isinstance(a, dict):
        assert list(a) == list(b)
        _assert_equal(list(a.values()), list(b.values()))
    elif isinstance(a, (State, Frame, FitResult)):
        _assert_equal(vars(a), vars(b))
    else:
        assert repr(a) == repr(b)


@pytest.mark.parametrize(
    "one, other",
    [
        (np.zeros(2), np.zeros(2, dtype=np.float32)),
        (np.zeros((2, 1)), np.zeros((1, 2))),
        ([1, [2, 3]], [[1, 2], 3]),
        (1, "1"),
        (1, True),
        (None, "None"),
        (("ab", "c"), ("a", "bc")),
        ({"a": 1}, {"a": 2}),
        (Frame(np.zeros(3), 1.0), Frame(np.zeros(3), 2.0)),
    ],
)
def test_what_differs_has_another_place(one, other, tmp_path):
    for made in (lambda x: Checkpoint(tmp_path, x).slot("result"), lambda x: Checkpoint(tmp_path).slot("result", x)):
        made(one).keep(1)
        assert (made(one).known(), made(other).known()) == (1, None)
    narrowed = Checkpoint(tmp_path).narrowed(one).slot("result")
    narrowed.keep(2)
    assert Checkpoint(tmp_path).narrowed(other).slot("result").known() is None
    assert Checkpoint(tmp_path).slot("first-fit", one).known() is None


def test_the_order_of_a_dict_does_not_matter(tmp_path):
    Checkpoint(tmp_path, {"a": 1, "b": 2}).slot("result").keep(3)
    assert Checkpoint(tmp_path, {"b": 2, "a": 1}).slot("result").known() == 3


@pytest.mark.parametrize("content", [b"", b"PK\3\4 cut short", None])
def test_files_that_are_broken_are_made_again(content, tmp_path):
    slot = Checkpoint(tmp_path).slot("result")
    slot.keep((1, 2))
    (path,) = tmp_path.iterdir()
    if content is None:
        np.savez(path, value=np.array('{"record": "Unknown", "fields": {}}'))
    else:
        path.write_bytes(content)
    assert slot.known() is None
    assert each_kept(lambda task: (task, task), [5], [slot], jobs=1, done=lambda p: None) == [(5, 5)] and slot.known() == (5, 5)


def test_shares_begin_with_what_is_kept(tmp_path):
    slots, told = [Checkpoint(tmp_path).slot("result", k) for k in range(4)], []
    slots[2].keep("two")
    answers = each_kept(lambda task: f"{task}", range(4), slots, jobs=1, done=told.append, keep=lambda a: a != "3")
    assert answers == ["0", "1", "two", "3"] and told == [0.25, 0.5, 0.75, 1.0]
    assert [slot.known() for slot in slots] == ["0", "1", "two", None]


def test_a_folder_that_cannot_be_written_to_is_told_once_and_no_error(make_learner, points, tmp_path, monkeypatch):
    def full(path, *given, **more):
        raise FileError(str(path), "a full disk", "room")

    monkeypatch.setattr("lbsfit_np.learning.checkpoint._write", full)
    with pytest.warns(UserWarning) as told:
        fitter = make_learner(variant="free-form").fit(points, checkpoint=tmp_path / "kept")
    words = [str(w.message) for w in told if "kept" in str(w.message)]
    expected = f"finished steps cannot be kept in {tmp_path / 'kept'} (a full disk): an interrupted run will repeat them"
    assert words == [expected]
    assert len(fitter.results_) == len(points)


def test_nothing_is_kept_unless_asked_for(make_learner, points, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_learner(variant="free-form").fit(points)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("given", [3, True, ["a"]])
def test_a_checkpoint_that_is_no_path(given, make_learner, points):
    with pytest.raises(InputError, match=f"checkpoint: got a {type(given).__name__}; expected the path of a folder, or None"):
        make_learner().fit(points, checkpoint=given)


@pytest.mark.parametrize("name", ["file", "file/in/it"])
def test_a_checkpoint_that_is_a_file(name, make_learner, points, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="checkpoint: got .*file, a file; expected a folder to write to, or a name"):
        make_learner().fit(points, checkpoint=tmp_path / name)


@pytest.mark.parametrize(
    "name, why",
    [("new/" + 300 * "x", "File name too long"), ("a\0b", "embedded null byte|null character"), ("link", "File exists")],
)
def test_a_checkpoint_by_a_name_that_no_folder_can_have(name, why, make_learner, points, tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    words = f"checkpoint: got .*, a folder that cannot be made .({why}).; expected a folder to write to"
    with pytest.raises(InputError, match=words):
        make_learner().fit(points, checkpoint=tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["link"]


def test_a_checkpoint_makes_nothing_before_its_first_step(tmp_path):
    """Two runs may begin at once, in one new folder."""
    slot = Checkpoint(tmp_path / "new" / "er").slot("result")
    assert not list(tmp_path.iterdir())
    slot.keep(1)
    assert steps_in(tmp_path / "new" / "er") == 1


def test_a_checkpoint_that_is_nowhere(make_learner, points):
    with pytest.raises(InputError, match="checkpoint: got an empty path; expected the path of a folder, or None"):
        make_learner().fit(points, checkpoint="")


def test_a_checkpoint_where_nothing_can_be_written_is_said_first(make_learner, points, tmp_path, monkeypatch):
    def denied(**options):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("tempfile.TemporaryFile", denied)
    words = r"checkpoint: got .*, a folder that cannot be written to \(Read-only file system\); expected a folder to write to"
    with pytest.raises(InputError, match=words):
        make_learner().fit(points, checkpoint=tmp_path / "new" / "er")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("seed", [None, np.random.default_rng(0)])
def test_a_checkpoint_without_a_seed(seed, make_learner, points, tmp_path):
    with pytest.raises(InputError, match="checkpoint: got random_state (None|Generator).*; expected a seed.*random_state=0"):
        make_learner(random_state=seed).fit(points, checkpoint=tmp_path)


def test_what_is_removed_is_what_was_written(tmp_path):
    folder = tmp_path / "kept"
    remove_checkpoint(folder)  # where there is none, nothing
    assert steps_in(folder) == 0
    for name in ("first-fit", "round-12-pose", "result", "free-form"):
        Checkpoint(folder).slot(name).keep(1)
    (folder / ".result-0.0123.tmp.npz").write_bytes(b"killed while it was written")
    (folder / "mine.npz").write_bytes(b"")
    assert steps_in(folder) == 4
    remove_checkpoint(folder)
    assert [path.name for path in folder.iterdir()] == ["mine.npz"] and steps_in(folder) == 0
    (folder / "mine.npz").unlink()
    remove_checkpoint(folder)
    assert not folder.exists()


def test_what_cannot_be_removed_stays_and_is_no_error(tmp_path, monkeypatch):
    Checkpoint(tmp_path / "kept").slot("result").keep(1)

    def denied(self, **_):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", denied)
        remove_checkpoint(tmp_path / "kept")
    assert steps_in(tmp_path / "kept") == 1
