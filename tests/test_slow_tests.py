"""Which slow tests run along with the others."""

from types import SimpleNamespace

import pytest
from slow_tests import leave_out_slow_tests, pytest_collection_modifyitems


def config(*args, share=None, markexpr=""):
    told = []
    hook = SimpleNamespace(pytest_deselected=lambda items: told.extend(items))
    option = SimpleNamespace(share=share, markexpr=markexpr)
    return SimpleNamespace(option=option, args=args, hook=hook, addinivalue_line=lambda *line: None, told=told)


def items(n):
    """Every third is slow."""
    return [SimpleNamespace(number=i, get_closest_marker=lambda name, i=i: name == "slow" and i % 3 == 0) for i in range(n)]


@pytest.mark.parametrize("n", [1, 2, 5, 40])
def test_each_slow_test_is_in_one_share(n):
    seen = []
    for k in range(n):
        made, kept = config(share=f"{k + n}/{n}"), items(50)  # of any whole number, such as of commits
        pytest_collection_modifyitems(made, kept)
        assert [i.number for i in kept if i.number % 3] == [i for i in range(50) if i % 3]
        seen += [i.number for i in kept if i.number % 3 == 0]
        assert sorted(i.number for i in kept + made.told) == list(range(50))
    assert sorted(seen) == list(range(0, 50, 3))


def test_slow_tests_run_where_they_are_asked_for():
    for given, expected in (
        (config("tests"), "not slow and not study"),
        (config("tests", markexpr="slow"), "slow"),
        (config("tests/test_fit.py::test_one"), ""),
        (config("tests", share="1/2"), "not study"),
    ):
        leave_out_slow_tests(given)
        assert given.option.markexpr == expected
