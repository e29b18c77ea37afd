"""Fits of hands with arms whose ends are made, not found: what a second look at a scan does with them."""

from dataclasses import make_dataclass
from types import SimpleNamespace

import numpy as np

from lbsfit_np.bench.conditions import CONDITIONS, condition_scan
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.fitting.second_look import looked_at_again
from lbsfit_np.optimize.frame import root_turn, turned_root
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts.beyond import end_of


def hands_with_arms(rig):
    """Scans of hands with arms of several lengths, turned about the up axis."""
    return [condition_scan(rig, CONDITIONS["arm"], i, np.random.default_rng(i)) for i in range(6)]


def true_fit(rig, scan):
    """As a fit that has found the truth has it."""
    return SimpleNamespace(
        offsets=scan.template - rig.vertices,
        rest_joints=scan.template_joints,
        pose=scan.pose,
        joints=scan.joints,
        vertices=scan.vertices,
        scale=scan.scale,
    )


class MadeFits:
    """Fits whose ends, where they are and how probable, hang on what of a scan they are of."""

    def __init__(self, rig, scan, **ends):
        self.hand, self.scan, self.arm = rig, scan, scan.labels < 0
        self.ends, self.of, self.once = ends, [], []

    def taking_part(self, among, sure):
        rows = np.arange(len(self.scan.points))
        return SimpleNamespace(rows=rows if among is None else rows[among], among=among, doubtful=None)

    def fit(self, part, once):
        self.of.append(self._of(part.among))
        self.once.append(once)
        where, probability, *guesses = self.ends[self.of[-1]]
        std = np.where(np.arange(len(self.hand.parents)) < sum(guesses), 0.1, 0.001) * self.hand.size
        status = "ok" if probability >= 0.5 else "suspect"
        known = {"status": status, "probability": probability, "seconds": float(len(self.of)), "evaluations": 10}
        known |= {"joint_std": std, "evidence": {"unexplained": 0.1}, "confidence": np.ones(len(self.arm))}
        fields = vars(self._found(where)) | known
        return make_dataclass("Result", list(fields), frozen=True, eq=False)(**fields)

    def _of(self, among):
        if among is None:
            return "all"
        hand, arm = among[~self.arm].mean(), among[self.arm].mean()
        return "hand" if hand == 1 and arm < 0.4 else "hand_end" if hand > arm else "arm_end"

    def _found(self, where):
        found, root = true_fit(self.hand, self.scan), self.hand.root
        found.vertices = found.vertices.copy()  # each fit has its own
        if where == "turned":  # by 180 degrees about the wrist, the fingers in the arm
            axis = np.cross(root_turn(self.hand, found.pose) @ end_of(self.hand).direction, [1.0, 2.0, 3.0])
            turn, wrist = matrix_from_rotvec(np.pi * axis / np.linalg.norm(axis)), found.joints[root]
            found.pose = turned_root(self.hand, found.pose, turn)
            found.joints = (found.joints - wrist) @ turn.T + wrist
            found.vertices = (found.vertices - wrist) @ turn.T + wrist
        return found

    def __call__(self, *, given=(), **settings):
        known = {"settings": FitSettings(**settings), "given": given}
        return looked_at_again(self.taking_part(None, False), self.taking_part, self.fit, self.scan.points, self.hand, **known)
