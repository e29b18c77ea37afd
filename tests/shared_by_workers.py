"""Folders that the processes of a test run have in common: what takes long is made by the first that asks for it."""

import os
import pickle
import time

try:
    import fcntl
except ImportError:  # on Windows
    import msvcrt

_LONGEST = 600.0  # seconds


def made_once(tmp_path_factory, name, make=None):
    """The folder ``name`` of this run of the tests, once ``make(folder)`` has filled it in this process or another."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent  # of pytest-xdist's processes, each of which has a folder of its own there
    folder, filled, failed, lock = (root / f"{name}{what}" for what in ("", "-filled", "-failed", "-lock"))
    with open(lock, "w") as file:
        began = time.monotonic()
        while not _locked(file):
            assert time.monotonic() - began < _LONGEST, f"{name!r} is not there yet"
            time.sleep(0.05)
        if folder.exists():
            assert not failed.exists(), f"another process could not make {name!r}, see its error"
            assert filled.exists(), f"the process that was to make {name!r} has died"
            return folder
        folder.mkdir()
        try:
            if make is not None:
                make(folder)
        except BaseException:
            failed.touch()
            raise
        filled.touch()
        return folder


def found_once(tmp_path_factory, name, find):
    """What ``find()`` gives, as pickle has it, found by the first process of this run of the tests that asks for it."""
    made = made_once(tmp_path_factory, name, lambda folder: (folder / "found").write_bytes(pickle.dumps(find())))
    return pickle.loads((made / "found").read_bytes())


def _locked(file):
    """Lock a file for this process, until it closes the file or ends; False where another process has locked it.

    The system unlocks what a process that dies has locked. Its number would not tell: until its parent asks how it ended, which
    pytest-xdist does not, a process that has died answers to it like one that lives.
    """
    try:
        if os.name == "nt":
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True
