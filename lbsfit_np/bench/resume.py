"""Reports of runs that go on where an earlier one stopped."""

from copy import deepcopy

from ..errors import InputError
from ..learning.checkpoint import digest_of

__all__ = ["REMEDY", "begun", "described"]

REMEDY = "Choose another folder, or --existing replace."


def begun(before, empty, *, same=("settings",)):
    """The report to go on with.

    Parameters
    ----------
    before : dict or None
        What an earlier run has written.
    empty : dict
        The report of a run without results: "benchmark", what has to be the same, and what else every report has.
    same : sequence of str
        Keys of what has to be the same; of dicts, each key of theirs.

    Returns
    -------
    dict
        ``empty`` itself where there is no earlier report, else a copy of that.

    Raises
    ------
    InputError
        A report of another benchmark or of other settings, or one that lacks what every report has.
    """
    if before is None:
        return empty
    theirs, ours = before.get("benchmark", "an unknown benchmark"), empty["benchmark"]
    if theirs != ours:
        raise InputError("before", f"results of {theirs}", f"results of {ours}", REMEDY)
    lacking = [key for key, value in empty.items() if key not in before or not _alike(before[key], value)]
    if lacking:
        got = f"results of {theirs} without {', '.join(map(repr, lacking))}"
        raise InputError("before", got, f"all that a run of this version writes: {', '.join(empty)}", REMEDY)
    theirs, ours = ({k: v for name in same for k, v in _named(name, of[name])} for of in (before, empty))
    other = [key for key in ours if theirs.get(key) != ours[key]]
    if other:
        got, expected = (", ".join(f"{key} {known.get(key)}" for key in other) for known in (theirs, ours))
        raise InputError("before", f"results with {got}", expected, REMEDY)
    return deepcopy(before)


def described(rig):
    """Of a rig all that fits depend on: its digest, and what that does not cover, much of it a card's; plain data for JSON."""
    still = [sorted(name for name, on in zip(rig.joint_names, mask, strict=True) if on) for mask in (rig.locked, rig.merged)]
    return {
        "digest": rig.digest,
        "up": rig.up,
        "forward": rig.forward,
        "metres_per_unit": rig.metres_per_unit,
        "joints_that_are_still": digest_of(still),
        "poses": rig.poses_digest,
    }


def _alike(theirs, ours):
    """Whether a dict stands where one belongs."""
    return isinstance(theirs, dict) or not isinstance(ours, dict)


def _named(name, value):
    return value.items() if isinstance(value, dict) else [(name, value)]
