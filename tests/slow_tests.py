"""Which tests run: slow ones only where they are asked for, or some of them along with the others."""

import pytest


def slow(*values):
    """Parameters with which a test is slow."""
    return pytest.param(*values, marks=pytest.mark.slow)


def pytest_addoption(parser):
    parser.addoption("--share", metavar="K/N", help="with the others run every Nth of the slow tests, from the Kth on")


def leave_out_slow_tests(config):
    """Unless they are asked for: by ``-m`` (``-m "slow or not slow"`` has all), by name or, some of them, by ``--share``."""
    slow = "slow: takes some five seconds, or asks of more values what quick tests ask; run by -m slow, some by --share"
    config.addinivalue_line("markers", slow)
    config.addinivalue_line("markers", "study: takes ten seconds to minutes; run by -m study")
    if not (config.option.markexpr or any("::" in a for a in config.args)):
        config.option.markexpr = "not study" if config.option.share else "not slow and not study"


def pytest_collection_modifyitems(config, items):
    """Keep the slow tests of the share only."""
    if not config.option.share:
        return
    k, n = map(int, config.option.share.split("/"))
    slow = [item for item in items if item.get_closest_marker("slow")]
    left_out = set(map(id, slow)) - set(map(id, slow[k % n :: n]))
    config.hook.pytest_deselected(items=[item for item in items if id(item) in left_out])
    items[:] = [item for item in items if id(item) not in left_out]
