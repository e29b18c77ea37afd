"""What other processes do in the tests of them; apart, as each of them reads this file first and little else."""

import os
import signal
import threading
import time

from lbsfit_np.errors import InputError
from lbsfit_np.processes import tell
from lbsfit_np.workers import each


class TwoWords(Exception):
    """Pickles, and cannot be made again: its message is made of what pickle does not know."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def own_number(_):
    return os.getpid()


def numbers_of_its_own_tasks(_):
    return os.getpid(), each(own_number, range(3), jobs=2)


def threads(_):
    import scipy.linalg  # noqa: F401 (its BLAS is not NumPy's)
    from threadpoolctl import threadpool_info

    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def raises_two_words(k):
    raise TwoWords("this", "that")


def a_lock(k):
    return threading.Lock()


def makes_an_error_of_ctrl_c(task):
    assert task == 1
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
    except KeyboardInterrupt:
        return "a TypeError"


def tells(task):
    which, begun = task
    if which == "first":
        tell("first has begun")
        while not begun.exists():
            time.sleep(0.01)
    else:
        begun.touch()
    tell(f"{which} is done")
    return os.getpid()


def squared(x):
    return x * x


def not_3(n):
    if n == 3:
        raise InputError("n", "3", "not 3")
    return n


def inverse_later(x):
    time.sleep(x)
    return 1.0 / x


def inverse_after_a_note(x):
    tell("begun")
    time.sleep(1)
    return 1 / x


def inverse(x):
    return 1 / x


def kills_itself(x):
    os.kill(os.getpid(), signal.SIGKILL)


def ends_at_1(x):
    if x == 1:
        kills_itself(x)
    return x


def two_words_at_1(x):
    return raises_two_words(x) if x == 1 else x


class EndsItsProcess:
    """A fitter that ends the process that it is in."""

    def fit_scan(self, scan):
        os._exit(3)
