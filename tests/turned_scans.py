"""Scans that are turned, and how far what a scout has found is from their truth."""

import numpy as np

from lbsfit_np.optimize.model import Model
from lbsfit_np.rotations import matrix_from_rotvec

CLEAN = {"noise": 0.0, "holes": 0, "density": 0.0, "shape": 0.0, "n_points": 600}


def any_turn(seed):
    from scipy.spatial.transform import Rotation

    return Rotation.random(random_state=seed).as_matrix()


def upright(angle):
    return matrix_from_rotvec(np.array([0.0, angle, 0.0]))


def error_of(rig, found, scan, turn=None, unit=1.0, shift=0.0):
    """Mean distance of the joints, in the scan's frame, in half sizes of the rig as large as the scan."""
    joints = found.frame.outside(Model(rig).pose(found.state)[0].joints)
    true = unit * scan.joints @ (np.eye(3) if turn is None else turn).T + shift
    return np.linalg.norm(joints - true, axis=1).mean() / (unit * rig.size / 2)
