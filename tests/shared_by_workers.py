"""Folders that the processes of a test run have in common: what takes long is made by the first that asks for it."""

import os
import time

_LONGEST = 600.0  # seconds


def made_once(tmp_path_factory, name, make=None):
    """The folder ``name`` of this run of the tests, once ``make(folder)`` has filled it in this process or another."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent  # of pytest-xdist's processes, each of which has a folder of its own there
    folder, filled, failed = (root / f"{name}{what}" for what in ("", "-filled", "-failed"))
    try:
        folder.mkdir()
    except FileExistsError:
        began = time.monotonic()
        while not filled.exists():
            assert not failed.exists(), f"another process could not make {name!r}, see its error"
            assert time.monotonic() - began < _LONGEST, f"{name!r} is not there yet"
            time.sleep(0.05)
        return folder
    try:
        if make is not None:
            make(folder)
    except BaseException:
        failed.touch()
        raise
    filled.touch()
    return folder
