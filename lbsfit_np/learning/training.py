"""The synthetic scans of pretraining, and how they are made: the parameter ``training`` of a fitter as settings."""

from dataclasses import asdict, dataclass

from ..errors import InputError
from ..seeds import generator
from ..synthesis import (
    Synthesis,
    make_settings,
    natural_poses,
    synthesize_nth,
    synthesize_one,
    training_poses,
    with_random_proportions,
)

__all__ = ["StartScans", "TrainingScans", "training_settings"]

# Beside Synthesis' own defaults: the reference scale is a guess, and people are not of the rig's size.
_DEFAULTS = {"scale": 0.05}
# The most that is cut off of scans of a part of the body.
_CROPPED = 0.6


def training_settings(training, *, partial=False, cropped=False):
    """The settings of training scans.

    Parameters
    ----------
    training : None, mapping of fields of Synthesis, or Synthesis
    partial, cropped : bool, default False
        Whether scans show one side only, or end before the body does, where a mapping does not say.

    Returns
    -------
    Synthesis

    Raises
    ------
    InputError
        A field that is not known, or out of its range.
    """
    shows = {"one_sided": bool(partial), "cropped": _CROPPED * bool(cropped)}
    given = asdict(training) if isinstance(training, Synthesis) else _DEFAULTS | shows | dict(training or {})
    try:
        return make_settings(given)
    except InputError as error:
        raise InputError("training", f"{error.argument}: {error.got}", error.expected, error.remedy) from None


@dataclass(frozen=True)
class TrainingScans:
    """i → (points, labels, 1.0): the i-th scan for training s, the same in any process."""

    rig: object
    settings: Synthesis
    random_state: int | None

    def __call__(self, i):
        scan = synthesize_nth(self.rig, i, self.settings, poses=training_poses, random_state=self.random_state)
        return scan.points, scan.labels, 1.0


@dataclass(frozen=True)
class StartScans:
    """i → the i-th SyntheticScan for the library of starts, facing the rig's way; half have natural poses, if the rig has any."""

    rig: object
    settings: Synthesis
    random_state: int | None

    def __call__(self, i):
        rng = generator(self.random_state, "start", i)
        poses = natural_poses if i % 2 and self.rig.poses else training_poses
        template = with_random_proportions(self.rig, self.settings.shape, rng)
        return synthesize_one(self.rig, poses(self.rig, 1, rng)[0], template, self.settings, rng)
