"""How much is tried for a scan: of how many hypotheses, how far, how often."""

from dataclasses import dataclass

__all__ = ["EFFORTS", "Effort"]


@dataclass(frozen=True)
class Effort:
    """How many hypotheses go how far.

    Attributes
    ----------
    starts : int
        Poses of the library that go the first steps.
    facings : int
        Under how many turns labels are read.
    survivors : int
        Of them, and of the others, that go the last steps.
    finals : int
        Of these, that proportions are found for.
    generations : int
        How often, at most, limbs are tried in other poses.
    parents : int
        Of how many survivors.
    proposals : int
        Poses tried for each limb, at most.
    closer : bool
        Whether they may be others than the library's.
    bends : bool
        Whether other bends of joints are tried in the end.
    again : str or None
        The effort of a second look where the first leaves the pose in doubt; None for none. With the effort of the first, only
        where other up axes are to be tried.
    """

    starts: int
    facings: int
    survivors: int
    finals: int
    generations: int
    parents: int
    proposals: int
    closer: bool
    bends: bool
    again: str | None = None


EFFORTS = {
    "fast": Effort(6, 2, 2, 1, 1, 1, 1, closer=False, bends=False),
    "balanced": Effort(16, 4, 4, 2, 3, 1, 2, closer=False, bends=True, again="thorough"),
    "thorough": Effort(48, 8, 8, 3, 8, 4, 3, closer=True, bends=True, again="thorough"),
}
