"""A rig in words: what ``lbsfit rig show`` prints."""

import numpy as np

from ..errors import listed
from .frames import up_axis
from .units import unit_name

__all__ = ["describe"]


def describe(rig, *, degrees=False):
    """The rig's size, axes, poses and shape parameters, its joint tree with limits, parts and weights, and every anomaly.

    Parameters
    ----------
    rig : Rig
    degrees : bool, default False
        Limits in degrees instead of radians; what was noted has both.

    Returns
    -------
    str
        Several lines. Of each joint: its state (root, moves, locked, merged, still), its part, the share of the skinning weight
        that it carries (of all vertices), and its limits about x, y, z; axes that do not turn are shown as a dash.
    """
    lines = [f"Rig {rig.name}", *(f"  {label:<10}{value}" for label, value in _facts(rig)), ""]
    unit = "degrees" if degrees else "radians"
    table = [("joint", "state", "part", "weight", f"limits x, y, z ({unit})"), *_joint_rows(rig, degrees)]
    widths = [max(len(row[k]) for row in table) for k in range(4)]
    for row in table:
        cells = [row[0].ljust(widths[0]), row[1].ljust(widths[1]), row[2].ljust(widths[2]), row[3].rjust(widths[3])]
        lines.append("  ".join([*cells, row[4]]).rstrip())
    lines.append("")
    if rig.notes:
        lines += ["Noted:", *(f"  - {note}" for note in rig.notes)]
    else:
        lines.append("No anomalies.")
    return "\n".join(lines) + "\n"


def _facts(rig):
    m, n, loose = len(rig.vertices), len(rig.welded.vertices), np.count_nonzero(rig.loose)
    besides = ", ".join([f"{n} distinct"] * int(n != m - loose) + [f"{loose} loose"] * bool(loose))
    yield "vertices", f"{m}" + (f" ({besides})" if besides else "")
    yield "faces", f"{len(rig.faces)}"
    influences = np.diff(rig.weights.indptr)
    more = np.count_nonzero(influences > 4)  # of which some programs show four
    yield "skin", f"up to {influences.max()} joints per vertex" + (f", more than 4 at {more} vertices" if more else "")
    still = f", {np.count_nonzero(rig.locked)} locked, {np.count_nonzero(rig.merged)} merged"
    yield "joints", f"{len(rig.parents)}: {np.count_nonzero(rig.moving)} move{still}"
    others = [name for name in ("joints", *rig.partitions) if name != rig.granularity]
    yield "parts", f"{len(rig.parts)}, partition {rig.granularity!r}" + (f" (others: {', '.join(others)})" if others else "")
    unit = rig.metres_per_unit
    name = unit_name(unit)
    words = "unknown" if unit is None else name or f"{unit:g} m"
    sides = " × ".join(f"{side:.4g}" for side in rig.sides)
    yield "unit", words
    yield "size", f"{sides}" + (f" {name}" if name else "" if unit is None else " units")
    yield "axes", f"up {rig.up or 'unknown'}, forward {rig.forward or 'unknown'}"
    if rig.up:  # which tells a hand that hangs from one whose fingers point up
        height = rig.vertices[~rig.loose] @ up_axis(rig)
        above = (height.max() - rig.joints[rig.root] @ up_axis(rig)) / max(np.ptp(height), np.finfo(float).tiny)
        yield "stands", f"{np.clip(above, 0, 1):.0%} of its height above the root joint, {np.clip(1 - above, 0, 1):.0%} below"
    if rig.poses:
        yield "poses", f"{len(rig.poses)} natural: {listed(list(rig.poses), 6)}"
    if rig.shapes is not None:
        for k, d in enumerate(rig.shapes.default):
            yield "shape" if k == 0 else "", f"{rig.shapes.words(k)}, here {d:.4g}"
    if rig.smpl_rest is not None:
        yield "SMPL", "to_smpl_pose and from_smpl_pose convert poses"
    yield "digest", rig.digest[:16]


def _joint_rows(rig, degrees):
    """Rows of the table, depth first from the root."""
    carried = np.asarray(rig.weights.sum(axis=0)).ravel()
    waiting = [(rig.root, 0)]
    while waiting:
        j, depth = waiting.pop()
        state = (
            "root"
            if j == rig.root
            else "merged"
            if rig.merged[j]
            else "locked"
            if rig.locked[j]
            else "moves"
            if rig.moving[j]
            else "still"
        )
        share = "-" if carried[j] == 0 else f"{100 * carried[j] / len(rig.vertices):.1f} %"
        part = "-" if rig.merged[j] else rig.parts[rig.part_of_joint[j]]
        yield (
            "  " * depth + rig.joint_names[j],
            state,
            part,
            share,
            _limits(rig, j, degrees) if state in ("root", "moves") or rig.lower[j].any() else "",
        )
        waiting += [(child, depth + 1) for child in np.flatnonzero(rig.parents == j)[::-1]]


def _limits(rig, j, degrees):
    factor, digits = (180 / np.pi, 0) if degrees else (1.0, 2)
    out = []
    for low, high in zip(rig.lower[j] * factor, rig.upper[j] * factor):
        out.append("-" if low == high == 0 else f"{low:+.{digits}f}..{high:+.{digits}f}")
    return ", ".join(text.rjust(13) for text in out)
