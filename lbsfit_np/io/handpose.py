"""Hand poses in the ``.handpose`` form: the 25 joints of a WebXR hand as matrices relative to the wrist."""

import numpy as np

from ..errors import FileError, InputError

__all__ = ["WEBXR_JOINTS", "read_handpose"]

# The joints in the order of the WebXR Hand Input specification, which is the order of the file.
WEBXR_JOINTS = (
    "wrist",
    *(f"thumb-{bone}" for bone in ("metacarpal", "phalanx-proximal", "phalanx-distal", "tip")),
    *(
        f"{finger}-finger-{bone}"
        for finger in ("index", "middle", "ring", "pinky")
        for bone in ("metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip")
    ),
)
_J = len(WEBXR_JOINTS)
_COUNT = 1 + 2 * 16 * _J + 2 * _J


def read_handpose(path, hand="left"):
    """Read one hand of a ``.handpose`` file.

    The file is 851 little-endian float32: the number of joints, 25; 25 matrices of 16 values, column after column, for the
    left hand; as many for the right hand; 25 weights for each hand, which matter only for recognising poses.

    Parameters
    ----------
    path : path-like
    hand : {"left", "right"}, default "left"

    Returns
    -------
    (25, 4, 4) array
        T_wrist_joint for each of :data:`WEBXR_JOINTS`: coordinates in the joint's frame to coordinates in the wrist's, metres.
        Each joint's x axis is that of flexion, −z points to the finger's tip.

    Raises
    ------
    FileError
        Missing file, another size or number of joints, or matrices that are not rigid motions.
    """
    if hand not in ("left", "right"):
        raise InputError("hand", repr(hand), "'left' or 'right'")
    name = str(path)
    try:
        with open(path, "rb") as file:
            raw = file.read(4 * _COUNT + 1)
    except OSError as e:
        raise FileError(name, e.strerror or str(e), "a readable .handpose file") from None
    if len(raw) != 4 * _COUNT:
        size = f"{len(raw)} bytes" if len(raw) < 4 * _COUNT else f"more than {4 * _COUNT} bytes"
        remedy = "The file may be truncated or of another kind."
        raise FileError(name, size, f"the {4 * _COUNT} bytes of two hands with {_J} joints", remedy)
    values = np.frombuffer(raw, "<f4").astype(float)
    if values[0] != _J:
        raise FileError(name, f"{values[0]:g} joints", f"{_J}", "Is this a .handpose file?")
    start = 1 + (0 if hand == "left" else 16 * _J)
    matrices = values[start : start + 16 * _J].reshape(_J, 4, 4).swapaxes(1, 2)
    R = matrices[:, :3, :3]
    rigid = np.isfinite(matrices).all(axis=(1, 2))
    rigid &= np.abs(matrices[:, 3] - [0, 0, 0, 1]).max(axis=1) < 1e-3
    with np.errstate(invalid="ignore", over="ignore"):
        rigid &= (np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2)) < 1e-2) & (np.linalg.det(R) > 0)
    if not rigid.all():
        first = WEBXR_JOINTS[int(np.argmin(rigid))]
        raise FileError(name, f"a matrix that is not a rotation and a translation ({first})", "rigid motions of 25 joints")
    return matrices
