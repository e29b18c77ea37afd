"""The words of errors, and the check that most arrays of users go through."""

import warnings

import numpy as np
import pytest

from lbsfit_np.errors import InputError, brief, check_array, check_unmasked, counted, did_you_mean, from_digits, in_words, listed
from lbsfit_np.losses.checks import check_set


def test_things_are_counted():
    assert [counted(n, "value") for n in (0, 1, 2)] == ["0 values", "1 value", "2 values"]


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (np.ma.masked_equal(np.arange(3.0), 1), "x: got a masked array with 1 of 3 rows masked; expected rows without a mask"),
        (list(np.ma.masked_equal(np.arange(3.0), 1)), "x: got a list with 1 of 3 rows masked"),
        (np.ma.masked_less(np.arange(12.0).reshape(4, 3), 4), "x: got a masked array with 2 of 4 rows masked"),
        (tuple(np.ma.masked_less(np.arange(12.0).reshape(4, 3), 4)), "x: got a tuple with 2 of 4 rows masked"),
        (np.ma.masked_less(np.arange(12.0).reshape(2, 2, 3), 4), "x: got a masked array with 1 of 2 rows masked"),
        (np.ma.masked, "x: got a masked array with 1 of 1 rows masked"),
    ],
)
def test_masked_entries_are_refused(value, words):
    for refuse in (check_unmasked, lambda name, value: check_array(name, value, (3,))):
        with warnings.catch_warnings(action="error"), pytest.raises(InputError) as error:
            refuse("x", value)
        assert str(error.value).startswith(words)


@pytest.mark.parametrize("value", [np.ma.arange(3), [*np.ma.arange(3)], [1, 2], np.arange(3), np.ma.masked_less([1.0, 2.0], 0)])
def test_masks_that_mask_nothing_are_none(value):
    check_unmasked("x", value)
    np.testing.assert_array_equal(check_array("x", value, (len(value),)), np.asarray(value, dtype=float))


@pytest.mark.parametrize("value", [np.ma.empty((0, 3)), np.ma.empty((0,)), np.ma.empty((3, 0)), []])
def test_where_there_is_nothing_nothing_is_masked(value):
    check_unmasked("x", value)
    with pytest.raises(InputError, match=r"points: got an empty set"):
        check_set("points", np.ma.empty((0, 3)))


def test_names_are_listed_up_to_a_number():
    assert listed([]) == ""
    assert listed(["a", "b"]) == "a, b"
    assert listed(list("abc"), 3) == "a, b, c"
    assert listed(list("abcde"), 3) == "a, b, c and 2 more"
    assert listed(list("abcdefghij")).endswith("h and 2 more")


@pytest.mark.parametrize(
    ("value", "words"),
    [("a", "'a'"), (None, "None"), ("a" * 200, "'" + "a" * 99 + "…"), ([10**5000], "a number of several thousand digits")],
)
def test_values_are_shown_in_brief(value, words):
    assert brief(value) == words


@pytest.mark.parametrize("given", ["zzz", pytest.param(10**5000, id="long"), None])
def test_what_is_like_no_name_is_no_question(given):
    assert did_you_mean(given, ["fast", "balanced"]) is None


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (InputError("rounds", "0", "1 or more"), "rounds: got 0; expected 1 or more"),
        (ValueError("nobody foresaw this"), "ValueError: nobody foresaw this"),
        (KeyError(), "KeyError"),
    ],
)
def test_errors_in_words(error, words):
    assert in_words(error).rstrip(".") == words


@pytest.mark.parametrize(
    ("text", "number"),
    [("0", 0), ("012", 12), ("-1", None), ("+1", None), ("1.0", None), ("", None), pytest.param("1" * 5000, None, id="long")],
)
def test_numbers_of_digits(text, number):
    assert from_digits(text) == number


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("abc", "pose: got str; expected an array of numbers of shape"),
        ([[1, 2], [3]], "pose: got list"),
        ([[10**400, 0], [0, 0]], "pose: got whole numbers beyond double precision"),
        (np.zeros((3, 2)), r"pose: got shape \(3, 2\); expected shape \(2, 2\)"),
        ([[np.nan, 0], [np.inf, 0]], "pose: got 2 values that are NaN or infinite"),
    ],
)
def test_arrays_that_are_none(value, words):
    with pytest.raises(InputError, match=words):
        check_array("pose", value, (2, 2))


def test_whole_numbers_become_floats():
    assert check_array("pose", [[10**30, 0], [0, 1]], (2, 2)).tolist() == [[1e30, 0.0], [0.0, 1.0]]


@pytest.mark.parametrize(
    ("given", "names", "words"),
    [
        ("efort", ["effort", "rounds"], "Did you mean 'effort'?"),
        ("Anna", ["anna", "ben"], "Did you mean 'anna'?"),
        ("up", ["--up"], "Did you mean '--up'?"),
        ("anna", ["ben"], None),
        ("--pic", ["--pictures", "--partial"], "Did you mean '--pictures'?"),
        ("--tra", ["--training", "--training-scans"], None),  # which of them?
        ("--p", ["--pictures"], None),
        ("", ["--pictures"], None),
        ("1", [1, 2], None),  # written the same: a question would offer what was given
        (1, ["1", "10"], None),
        ("ann", ["ann", "anna"], None),
        ("km", ["m", "cm", "mm"], None),  # following the question would put lengths wrong by a thousand
        ("MM", ["m", "cm", "mm"], "Did you mean 'mm'?"),
        ("z", ["+x", "-z"], "Did you mean '-z'?"),
    ],
)
def test_what_was_meant_is_not_what_was_given(given, names, words):
    assert did_you_mean(given, names) == words
