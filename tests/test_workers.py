"""The same work on many tasks, in this process or in others."""

import os
import pickle
import signal
import struct
import subprocess
import sys
from contextlib import nullcontext
from functools import partial
from multiprocessing import active_children, connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from worker_tasks import (
    TwoWords,
    a_lock,
    inverse,
    inverse_after_a_note,
    inverse_later,
    kills_itself,
    makes_an_error_of_ctrl_c,
    not_3,
    numbers_of_its_own_tasks,
    own_number,
    raises_two_words,
    squared,
    tells,
    threads,
)

from lbsfit_np import processes
from lbsfit_np.bench.study import run as study_run
from lbsfit_np.errors import InputError, MissingExtraError
from lbsfit_np.learning.loop import Loop
from lbsfit_np.processes import Workers, kept_processes
from lbsfit_np.workers import as_they_may, beside, each

pytestmark = pytest.mark.usefixtures("own_processes")


@pytest.mark.parametrize("jobs", [1, 2])
def test_answers_come_in_the_order_of_the_tasks(jobs):
    shares = []
    assert each(squared, range(7), jobs=jobs, done=shares.append) == [0, 1, 4, 9, 16, 25, 36]
    np.testing.assert_allclose(shares, np.arange(1, 8) / 7)
    assert each(squared, [], jobs=jobs) == [] and each(squared, [3], jobs=jobs) == [9]


def test_a_process_that_may_not_start_others_does_the_work_itself():
    for own, numbers in each(numbers_of_its_own_tasks, range(2), jobs=2):
        assert numbers == [own] * 3 and own != os.getpid()


@pytest.mark.parametrize("jobs", [1, 2])
def test_errors_of_tasks_pass_on(jobs):
    with pytest.raises(InputError, match="n: got 3; expected not 3") as error:
        each(not_3, range(6), jobs=jobs)
    assert error.value.argument == "n"
    with pytest.raises(ZeroDivisionError):
        each(inverse, [1, 2, 0], jobs=jobs)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no POSIX signals here")
def test_a_process_that_dies_is_said():
    words = "n_jobs: got a worker process that ended .*SIGKILL"
    with pytest.raises(InputError, match=words):
        each(kills_itself, [1, 2, 3], jobs=2)
    with beside(partial(kills_itself, 1)) as answer, pytest.raises(InputError, match=words):
        answer()


@pytest.mark.parametrize("jobs", [1, 2])
def test_errors_that_pickle_cannot_take_pass_on_in_words(jobs):
    with pytest.raises(TwoWords if jobs == 1 else RuntimeError, match="this and that"):
        each(raises_two_words, [1, 2], jobs=jobs)


def test_answers_that_pickle_cannot_take_are_said():
    words = "n_jobs: got more than 1 where an answer cannot be sent between processes .*lock.*n_jobs=1"
    with pytest.raises(InputError, match=words):
        each(a_lock, [1, 2], jobs=2)
    with beside(partial(a_lock, 1)) as answer, pytest.raises(InputError, match=words):
        answer()


def test_answers_that_came_before_ctrl_c_are_given_at_the_end(monkeypatch):
    """It comes as the second of two answers is read."""
    with Workers(squared, 2) as work:
        work.give(3)
        work.give(4)
        receive, calls = Workers._received, []

        def interrupted(self, worker):
            answer = receive(self, worker)
            calls.extend(answer)
            if len(calls) == 2:
                raise KeyboardInterrupt
            return answer

        monkeypatch.setattr(Workers, "_received", interrupted)
        wait = connection.wait
        monkeypatch.setattr(connection, "wait", lambda several: [one for each in several for one in wait([each])])  # for all
        with pytest.raises(KeyboardInterrupt):
            while True:
                assert not work.answers()  # both say first that they are ready
        monkeypatch.undo()
        assert work.stop() == calls[:1]


def test_a_task_waits_for_what_another_one_tells(tmp_path):
    """It is given to a second process while the first is still at work, which goes on when the second has begun."""
    left, told, answers = [("second", tmp_path / "begun"), ("first", tmp_path / "begun")], [], {}

    def take():
        return (left[-1][0], left.pop()) if left and (left[-1][0] == "first" or "first has begun" in told) else None

    as_they_may(tells, take, jobs=2, answered=answers.__setitem__, heard=told.append)
    assert not left and told[0] == "first has begun" and sorted(told[1:]) == ["first is done", "second is done"]
    assert set(answers) == {"first", "second"} and len(set(answers.values())) == 2 and not active_children()


def test_errors_of_tasks_end_nothing_where_they_are_asked_for():
    take, answers, wrong = iter([(0, 0), (1, 1), (2, 2), *[None] * 3]).__next__, {}, {}
    as_they_may(inverse, take, jobs=2, answered=answers.__setitem__, failed=wrong.__setitem__)
    assert answers == {1: 1.0, 2: 0.5} and list(wrong) == [0] and isinstance(wrong[0], ZeroDivisionError)


def test_an_unforeseen_error_says_where_in_the_other_process_it_came_from():
    with pytest.raises(ZeroDivisionError) as error:
        each(inverse, [0, 1], jobs=2)
    assert "in inverse" in str(error.value.__cause__)
    with pytest.raises(RuntimeError, match="this and that") as error:
        each(raises_two_words, [1, 2], jobs=2)
    assert "in raises_two_words" in str(error.value.__cause__)
    with pytest.raises(InputError) as error:  # which says itself what to do
        each(not_3, [3, 4], jobs=2)
    assert error.value.__cause__ is None


def test_notes_of_errors_go_along():
    for error in (InputError("n", "3", "not 3"), MissingExtraError("matplotlib", "viz", "drawing")):
        error.add_note("hand, seed 300")
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is type(error) and str(again) == str(error) and again.__notes__ == ["hand, seed 300"]


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_answers_that_have_come_are_given_when_all_ends(error, tmp_path):
    """Both tasks are done, as the first is taken up; what the second told is heard, too."""
    take, answers, told = iter([(k, (k, tmp_path / "begun")) for k in ("first", "second")]).__next__, [], []

    def answered(k, answer):
        answers.append(k)
        if len(answers) == 1:
            raise error

    with pytest.raises(error):
        as_they_may(tells, take, jobs=2, answered=answered, heard=told.append)
    assert sorted(answers) == ["first", "second"] and not active_children()
    assert sorted(told) == ["first has begun", "first is done", "second is done"]


@pytest.mark.usefixtures("patient")
def test_what_goes_wrong_with_one_of_those_answers_is_not_what_ended_all(tmp_path):
    """As on a disk that is full: another is taken up all the same, and Ctrl-C remains Ctrl-C."""
    take, answers = iter([(k, (k, tmp_path / "begun")) for k in ("first", "second")]).__next__, []

    def answered(k, answer):
        answers.append(k)
        if len(answers) == 1:
            raise KeyboardInterrupt
        raise OSError(28, "No space left on device")

    def heard(note):
        if answers:
            raise OSError(28, "No space left on device")

    with pytest.warns(UserWarning, match="could not be kept: OSError: .*No space left"), pytest.raises(KeyboardInterrupt):
        as_they_may(tells, take, jobs=2, answered=answered, heard=heard)
    assert sorted(answers) == ["first", "second"] and not active_children()


@pytest.mark.usefixtures("patient")
@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
def test_another_ctrl_c_waits_until_what_has_come_is_taken_up(tmp_path, monkeypatch):
    _interrupt_joins(monkeypatch)
    take, answers = iter([(k, (k, tmp_path / "begun")) for k in ("first", "second")]).__next__, []

    def answered(k, answer):
        answers.append(k)
        if len(answers) == 1:
            raise ZeroDivisionError

    with pytest.raises(KeyboardInterrupt):
        as_they_may(tells, take, jobs=2, answered=answered)
    assert sorted(answers) == ["first", "second"] and not active_children()


@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
def test_another_ctrl_c_waits_until_the_processes_have_ended(monkeypatch):
    _interrupt_joins(monkeypatch)
    with pytest.raises(KeyboardInterrupt), Workers(inverse_later, 2) as workers:
        workers.give(100.0)
        workers.give(100.0)
    assert not active_children()


def _interrupt_joins(monkeypatch):
    join = processes._Worker.join

    def interrupted(self):
        os.kill(os.getpid(), signal.SIGINT)
        join(self)

    monkeypatch.setattr(processes._Worker, "join", interrupted)


@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
@pytest.mark.parametrize("kept", [False, True])
def test_ctrl_c_as_work_is_sent_leaves_no_process(kept, monkeypatch):
    """Sending much takes as long as a process takes to start; it is not waited for that the rest of it comes."""
    killed, kill = [], BaseProcess.kill
    monkeypatch.setattr(BaseProcess, "kill", lambda self: (killed.append(self), kill(self)))
    with kept_processes() if kept else nullcontext():
        if kept:
            each(squared, [2, 3], jobs=2)
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt) as caught:  # as it holds what was there
            patch.setattr(connection.Connection, "_send_bytes", _half_of_it)
            each(squared, [2, 3], jobs=2)
        assert len(active_children()) == (1 if kept else 0) and caught
        assert each(squared, [2, 3], jobs=2) == [4, 9]
    assert not killed


def _half_of_it(self, data):
    self._send(struct.pack("!i", len(data)) + data[: len(data) // 2])
    signal.raise_signal(signal.SIGINT)


@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
def test_ctrl_c_as_a_process_starts_leaves_none(monkeypatch):
    def interrupted(self):
        start(self)
        signal.raise_signal(signal.SIGINT)

    start = BaseProcess.start
    monkeypatch.setattr(BaseProcess, "start", interrupted)
    with pytest.raises(KeyboardInterrupt) as caught:  # as it holds what was there
        each(squared, [2, 3], jobs=2)
    assert not active_children() and caught


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no POSIX signals here")
def test_a_process_that_is_killed_before_it_begins_costs_its_own_task_where_another_has_begun(monkeypatch):
    begin, begun = processes._Worker.take_up, []

    def killed(self, payload):
        begin(self, payload)
        begun.append(self)
        if len(begun) == 2:
            os.kill(self.process.pid, signal.SIGKILL)

    monkeypatch.setattr(processes._Worker, "take_up", killed)
    answers, wrong = {}, {}

    def take():  # the others wait until the first has begun
        return (len(begun), 2) if not begun or (begun[0].ready and len(begun) < 3) else None

    as_they_may(inverse_after_a_note, take, jobs=3, answered=answers.__setitem__, failed=wrong.__setitem__)
    assert answers == {0: 0.5, 2: 0.5} and list(wrong) == [1] and "killed by SIGKILL" in str(wrong[1])


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_an_error_of_what_hears_ends_the_work(error):
    def heard(note):
        raise error

    with pytest.raises(error):
        as_they_may(tells, iter([(0, ("first", Path(__file__))), None, None]).__next__, jobs=2, answered=None, heard=heard)
    assert not active_children()


@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
def test_ctrl_c_is_no_failure_of_a_task():
    """Where a library makes an error of it, and the work has that for its answer."""
    with pytest.raises(KeyboardInterrupt):
        each(makes_an_error_of_ctrl_c, [1, 2])


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no POSIX signals here")
def test_a_kept_process_that_is_killed_before_it_takes_up_other_work_costs_its_task(monkeypatch):
    wrong = {}
    with kept_processes():
        each(squared, [2, 3], jobs=2)
        begin = processes._Worker.take_up

        def killed(self, payload):
            os.kill(self.process.pid, signal.SIGKILL)
            begin(self, payload)

        monkeypatch.setattr(processes._Worker, "take_up", killed)
        as_they_may(squared, iter([(0, 2), None]).__next__, jobs=1, answered=None, failed=wrong.__setitem__)
    assert "killed by SIGKILL" in str(wrong[0])


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no POSIX signals here")
def test_a_process_that_is_killed_without_work_costs_none():
    with Workers(own_number, 1) as workers:
        came = []
        for k in range(2):
            workers.give(k)
            while workers.busy:
                came += workers.answers()
            os.kill(came[-1][1], signal.SIGKILL)
            assert workers._workers[0].process.join(20) is None and workers.idle
    assert len({number for _, number, death in came if death is None}) == 2


def test_notes_of_work_beside_other_work_are_left():
    with beside(partial(tells, ("first", Path(__file__)))) as answer:
        assert answer() != os.getpid()


def test_notes_and_answers_come_in_their_order():
    with Workers(tells, 1) as workers:
        workers.give(("first", Path(__file__)))
        come = []
        while workers.busy:
            come += workers.answers()
    assert [word.what for _, word, _ in come[:2]] == ["first has begun", "first is done"] and len(come) == 3
    answers = []
    take = iter([(0, ("first", Path(__file__))), None, None]).__next__
    as_they_may(tells, take, jobs=1, answered=lambda *answer: answers.append(answer))
    assert len(answers) == 1  # what nobody hears is left


def test_work_beside_other_work():
    with kept_processes():
        with beside(partial(own_number, None)) as answer:
            others = set(each(own_number, range(4), jobs=2))
            mine = answer()
            assert answer() == mine
        assert mine not in others | {os.getpid()}
        assert mine in set(each(own_number, range(6), jobs=3))  # kept for other work
        with pytest.raises(ZeroDivisionError), beside(partial(inverse, 0)) as answer:
            answer()
        with pytest.raises(KeyError), beside(partial(inverse_later, 100.0)):  # it need not be waited for
            raise KeyError
        with pytest.raises(InputError, match="n_jobs: got more than 1 with work that cannot be sent"), beside(lambda: 0):
            pass
    assert not active_children()


def test_processes_are_kept_for_other_work():
    with kept_processes():
        first = set(each(own_number, range(4), jobs=2))
        assert each(squared, [2, 3], jobs=2) == [4, 9]
        with kept_processes():
            assert set(each(own_number, range(4), jobs=2)) <= first
        assert set(each(own_number, range(4), jobs=2)) <= first
        with pytest.raises(ZeroDivisionError):
            each(inverse, [1, 2, 0, 3], jobs=2)
        assert each(inverse, [1, 2], jobs=2) == [1, 0.5]
    assert not first & {child.pid for child in active_children()}
    assert not first & set(each(own_number, range(4), jobs=2))


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no POSIX signals here")
def test_a_process_that_dies_while_it_is_kept_is_replaced():
    with kept_processes():
        for pid in set(each(own_number, range(2), jobs=2)):
            os.kill(pid, signal.SIGKILL)
            _wait_for_end(pid)
        dead = list(processes._SPARE)
        assert each(squared, [2, 3], jobs=2) == [4, 9]
        assert len(dead) == 2 and all(worker.connection.closed for worker in dead)


@pytest.mark.parametrize("whose", ["learning", "study"])
def test_all_steps_share_their_processes(whose, tube_rig, monkeypatch):
    used = []

    def steps(*given):
        used.extend(set(each(own_number, range(2), jobs=2)) for _ in range(2))
        raise InterruptedError

    monkeypatch.setattr(study_run, "to_go_on_with", steps)
    with pytest.raises(InterruptedError):
        if whose == "learning":
            Loop.run(SimpleNamespace(_first_fits=steps))
        else:
            study_run.study({"tube": tube_rig}, jobs=2)
    assert len(used) == 2 and used[0] == used[1]


def test_a_process_that_is_still_at_work_is_not_kept():
    with kept_processes():
        with pytest.raises(ZeroDivisionError):
            each(inverse_later, [0.8, 0.0, 0.8], jobs=2)
        assert each(squared, [2, 3], jobs=2) == [4, 9]


def test_a_process_that_never_got_its_task_is_not_kept():
    """What it says when it is ready would be taken for the next one's word."""
    with kept_processes():
        with Workers(squared, 2) as workers, pytest.raises((AttributeError, pickle.PicklingError)):
            workers.give(lambda: 0)
        assert each(squared, [2, 3], jobs=2) == [4, 9]


def test_processes_end_by_themselves_when_there_is_nothing_to_do(monkeypatch):
    killed = []
    monkeypatch.setattr("multiprocessing.process.BaseProcess.kill", killed.append)
    assert each(squared, [2, 3], jobs=2) == [4, 9] and not killed


def test_libraries_that_a_task_loads_have_one_thread_too(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    assert each(threads, range(3), jobs=2) == [{1}] * 3
    code = "from lbsfit_np.workers import each; from worker_tasks import threads; print(each(threads, [0]))"
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    run = subprocess.run([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
    assert run.stdout.strip() == "[{1}]", run.stderr


def _wait_for_end(pid):
    for child in active_children():
        if child.pid == pid:
            child.join(10)
