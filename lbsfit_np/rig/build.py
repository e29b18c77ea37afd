"""From a file's content to a rig: the card applied, everything checked once, what is missing derived, oddities noted."""

import os
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from ..errors import InputError, counted, listed
from ..rotations import nearest_rotvec
from ..triangles import face_areas
from .anomalies import mesh_notes, size_notes, skin_notes, unanswerable, unknown_notes
from .card import Card, matching, read_card
from .chains import subtrees
from .checks import (
    Reporter,
    check_directions,
    check_joints,
    check_limits,
    check_mask,
    check_mesh,
    check_names,
    check_poses,
    check_rotations,
    check_tree,
    check_weights,
    following_root,
)
from .clips import poses_of_clips, under_other_parents
from .frames import bone_directions, bone_frames, frames_along
from .hierarchy import parents_by_card
from .limits import DEFAULT_LIMIT, DEFAULT_ROOT_LIMIT, NO_LIMITS, OUTSIDE, derived_limits, without_rest
from .partition import check_partition, partition_names
from .regressor import exact_regressor, regressor_from_weights
from .rig import Rig
from .shapes import check_shapes
from .weld import proper

__all__ = ["build_rig"]

# Limits of so many joints that are all below this, radians, may have been written in radians and read as degrees.
_SEVERAL, _TINY = 3, np.radians(5.0)
# Of a face that has an area, in squares of the size.
_NO_AREA = 1e-14


def build_rig(data, card=None, *, normalize_weights=False, parts=None):
    """Build a validated Rig from what a file says and what a card adds.

    Parameters
    ----------
    data : RigData
        Left unchanged; the rig gets copies.
    card : Card or path-like, optional
        Overrides the file: hierarchy, merged and locked joints, frames, limits, partitions, unit, up, forward.
    normalize_weights : bool, default False
        Divide weight rows by their sums, whatever these are. Otherwise, sums within 1 % of 1 are put right, with a note, and
        others are an error.
    parts : str, optional
        The partition in use; by default the card's ``use_parts``, else the file's, else "joints".

    Returns
    -------
    Rig
        ``rig.notes`` lists anomalies and what was done about them; of notes that a saved rig has, those are left out that the
        card answers. Missing limits are derived; see :func:`.limits.derived_limits`. Joints that move no vertex of a face
        (neither they nor their descendants have weight there) are locked. So are joints that only repeat the root's turn (they
        and their descendants have all the weight), unless a card gives these joints limits by name. In the package's own files
        nothing is locked automatically; limits by name free what they lock, unless it moves no vertex.

    Raises
    ------
    InputError
        For anything that cannot be used (FileError, which names the file, where ``data.path`` is known).
    """
    card = _as_card(card)
    report = Reporter(data.path)
    notes = list(data.notes)
    names, parents, joints, frames = check_joints(report, data)
    vertices, faces = check_mesh(report, data.vertices, data.faces)
    weights = check_weights(report, data.weights, len(vertices), faces, names, normalize_weights, notes)
    unit, up, forward = (
        mine if mine is not None else theirs
        for mine, theirs in ((card.metres_per_unit, data.metres_per_unit), (card.up, data.up), (card.forward, data.forward))
    )
    said_by_card = card.metres_per_unit is not None or card.up is not None or card.forward is not None
    check_directions(report, unit, up, forward, card.where if said_by_card else "")

    parents = parents_by_card(parents, names, card)
    root = check_tree(report, parents, names, explained=bool(card.root or card.chains or card.parents))
    weights = following_root(root, weights, names, notes)
    if data.animated is not None and not np.array_equal(parents, data.parents):
        animated = report.array("animated", data.animated, (None, len(names), 3))
        data = replace(data, animated=under_other_parents(animated, frames, np.asarray(data.parents), parents))
    if data.bones is not None and ((up, forward) != (data.up, data.forward) or not np.array_equal(parents, data.parents)):
        frames = frames_along(data.bones, joints, parents, up, forward)
    frames, turned = _frames(frames, data.bones, joints, parents, names, card, up, forward)
    sound = proper(faces)  # what else there is of vertices says nothing of joints
    surface = np.unique(faces[sound] if sound.any() else faces)
    regressor = _regressor(report, data, vertices, weights, surface, parents, joints, names, notes)

    state = _states(report, data, weights[surface], parents, root, names, card, notes)
    if state.merged_now.any():
        weights = _merged_weights(weights, parents, state.merged)
    lower, upper = _limits(report, data, parents, root, names, turned, state, card, notes)
    notes[:] = [note for note in notes if not note.startswith(OUTSIDE)] + without_rest(lower, upper, names, root)
    poses, smpl_rest = _library(report, data, names, parents, root, turned, state, (lower, upper), notes)
    shapes = check_shapes(report, data.shapes, len(vertices), len(names))

    partitions = _partitions(report, data, names, card)
    granularity = next((p for p in (parts, card.use_parts, data.parts) if p is not None), "joints")
    argument = "parts" if parts is not None else f"{card.where}, use_parts" if card.use_parts is not None else "parts of the file"
    check_partition(argument, granularity, partitions)

    rig = Rig(
        name=str(data.name),
        vertices=vertices,
        faces=faces,
        weights=weights,
        parents=parents,
        joint_names=tuple(names),
        joints=joints,
        frames=frames,
        lower=lower,
        upper=upper,
        regressor=regressor,
        merged=state.merged,
        locked=state.locked,
        partitions=partitions,
        granularity=granularity,
        metres_per_unit=None if unit is None else float(unit),
        up=up,
        forward=forward,
        poses=poses,
        shapes=shapes,
        smpl_rest=smpl_rest,
    )
    if data.welding is not None:  # else by what is there
        rig.__dict__["_weld"] = data.welding
    if not len(rig.welded.faces):
        report.fail("faces", f"{len(faces)} faces, each with two corners at one point", "at least one proper triangle")
    if not (face_areas(rig.welded.vertices / rig.size, rig.welded.faces) > _NO_AREA).any():
        report.fail("faces", f"{len(faces)} faces, none of which has an area", "a surface")
    for partition in partition_names(partitions):
        _ = rig.with_parts(partition).parts  # raises where a vertex has no part, and says what is missing
    notes = unanswerable(notes) + mesh_notes(rig) + skin_notes(rig) + size_notes(rig) + unknown_notes(rig)
    return _with_notes(rig, notes)


@dataclass
class _States:
    """What each joint may do: (J,) bool arrays."""

    merged: np.ndarray
    merged_now: np.ndarray  # without those whose weights the file has moved already
    locked: np.ndarray


def _as_card(card):
    if card is None:
        return Card()
    if isinstance(card, Card):
        return card
    if isinstance(card, (str, os.PathLike)):
        return read_card(card)
    raise InputError("card", type(card).__name__, "a Card, or the path of a card file")


def _frames(frames, bones, joints, parents, names, card, up, forward):
    """Rest frames after the card's [frames], and (J, 3, 3) rotations from new to old axes (None where nothing changed)."""
    if not card.frames:
        return frames, None
    old, new, along = frames, frames.copy(), None
    for pattern, kind in card.frames:
        rows = matching(pattern, names, f"{card.where}, [frames]")
        if kind == "rig":
            new[rows] = np.eye(3)
            continue
        if along is None:
            if up is None or forward is None:
                raise InputError(
                    f"{card.where}, [frames]", f"'bone' for {pattern!r}, but no up and forward axes", "both, in the card's [rig]"
                )
            along = bone_frames(bone_directions(bones, joints, parents), up, forward)
        new[rows] = along[rows]
    changed = np.abs(new - old).max(axis=(1, 2)) > 1e-9
    return new, (np.swapaxes(new, 1, 2) @ old if changed.any() else None)


def _regressor(report, data, vertices, weights, surface, parents, joints, names, notes):
    """The file's regressor put right to R U = J, else one from the weights of the surface's vertices."""
    if data.regressor is None:
        return _derived_regressor(vertices, weights, surface, parents, joints)
    given = report.matrix("regressor", data.regressor, (len(joints), len(vertices)))
    if data.merged is not None:
        return given  # our own format: as good as it gets, to the last bit
    size = float(np.ptp(vertices, axis=0).max())
    miss = np.linalg.norm(given @ vertices - joints, axis=1)
    if miss.max() > 1e-4 * size:
        j = int(np.argmax(miss))
        notes.append(
            f"the file's joint regressor misses the file's joints by up to {100 * miss[j] / size:.2g} % of the size "
            f"({names[j]}); the positions were kept and the regressor was corrected"
        )
    made = exact_regressor(given, vertices, joints)
    lacking = np.linalg.norm(made @ vertices - joints, axis=1) > 1e-9 * size
    if lacking.any():  # no entries, or entries that cannot reach the joint
        derived = _derived_regressor(vertices, weights, surface, parents, joints)
        made = sparse.csr_array(sparse.vstack([(derived if bad else made)[[j]] for j, bad in enumerate(lacking)], format="csr"))
        if not (np.abs(miss[lacking]) <= 1e-9 * size).all():
            notes.append(
                f"the file's joint regressor cannot give the position of {_named(names, lacking)}: "
                "one derived from the weights is used there"
            )
    return made


def _derived_regressor(vertices, weights, surface, parents, joints):
    made = regressor_from_weights(vertices[surface], weights[surface], parents, joints)
    if len(surface) == len(vertices):
        return made
    columns = surface[made.indices].astype(made.indices.dtype)
    return sparse.csr_array((made.data, columns, made.indptr), shape=(len(joints), len(vertices)))


def _states(report, data, weights, parents, root, names, card, notes):
    """Merged and locked joints: the file's (our own format only), the card's, and those that could only confuse a fit."""
    J = len(names)
    ours = data.merged is not None or data.locked is not None
    before = np.zeros(J, dtype=bool) if data.merged is None else check_mask(report, "merged", data.merged, J)
    locked = np.zeros(J, dtype=bool) if data.locked is None else check_mask(report, "locked", data.locked, J)
    spoken_for = np.isin(names, [pattern for pattern, *_ in card.limits])  # by name: a glob means no joint in particular
    locked_before, merged, freed = locked.copy(), before.copy(), locked & spoken_for
    locked &= ~freed
    for pattern in card.merge:
        merged[matching(pattern, names, f"{card.where}, [merge] into_parent")] = True
    for pattern in card.lock:
        locked[matching(pattern, names, f"{card.where}, [lock] joints")] = True
    for word, mask, remedy in (
        ("merged", merged, "Leave it out of [merge]."),
        ("locked", locked, "Leave it out of [lock]; [limits] say how far sampled poses turn it."),
    ):
        if mask[root]:
            where = card.where if (card.merge or card.lock) else f"{word} joints"
            raise InputError(where, f"the root joint {names[root]!r} among the {word} joints", "any joint but the root", remedy)
    locked &= ~merged
    for word, now in (("merged into parents", merged & ~before), ("locked", locked & ~locked_before)):
        if now.any():
            notes.append(f"{_counted(now)} {word}: {_named(names, now)}")
    free = ~merged & ~locked & (freed | (not ours))  # our own format has said of the others
    if free.any():
        idle, rootlike = _powerless(weights, parents, root)
        idle, rootlike = idle & free, rootlike & free & ~spoken_for
        if idle.any():
            notes.append(f"{_counted(idle)} locked for moving no vertex: {_named(names, idle)}")
        if rootlike.any():
            notes.append(
                f"{_counted(rootlike)} locked for turning the whole mesh like the root: {_named(names, rootlike)} "
                "(freed by limits of their names in a card whose [lock] lacks them)"
            )
        locked |= idle | rootlike
    if (now := freed & ~merged & ~locked).any():
        notes.append(f"{_counted(now)} locked in the file but free, as limits name them: {_named(names, now)}")
    return _States(merged, merged & ~before, locked)


def _powerless(weights, parents, root):
    """Joints below the root that move no vertex, and joints that move all of them: (J,) bool each."""
    hangs = np.asarray((weights > 0).sum(axis=0)).ravel() > 0
    moved = subtrees(parents)[:, hangs] > 0
    idle, all_of_it = ~moved.any(axis=1), moved.all(axis=1)
    idle[root] = all_of_it[root] = False
    return idle, all_of_it


def _merged_weights(weights, parents, merged):
    """Each merged joint's column added to that of the nearest joint above it that is not merged."""
    J = len(parents)
    heir = np.arange(J)
    for j in range(J):
        while merged[heir[j]]:
            heir[j] = parents[heir[j]]
    moved = sparse.csr_array(weights @ sparse.csr_array((np.ones(J), (np.arange(J), heir)), shape=(J, J)))
    moved.sum_duplicates()
    moved.sort_indices()
    return moved


def _limits(report, data, parents, root, names, turned, state, card, notes):
    """Limits of all joints: the file's, else derived; then the card's; 0 for joints that do not turn."""
    J = len(names)
    moving = ~(state.merged | state.locked)
    animated = None if data.animated is None else report.array("animated", data.animated, (None, J, 3))
    before = np.asarray(data.parents)
    changed = (parents != before) & (before >= 0)
    if turned is not None:
        changed |= np.abs(turned - np.eye(3)).max(axis=(1, 2)) > 1e-9
        if animated is not None:
            animated = np.einsum("jab,kjb->kja", turned, animated)  # the same turns, about the new axes
    lower, upper, from_animation = derived_limits(root, J, animated)
    derived, own = np.ones(J, dtype=bool), data.lower is not None or data.upper is not None
    if own:
        low, high = check_limits(report, data.lower, data.upper, names)
        derived = changed & moving  # a box about other axes, or relative to another parent, says nothing about these
        lower[~derived], upper[~derived] = low[~derived], high[~derived]
    of_card = np.zeros(J, dtype=bool)
    for pattern, low, high in card.limits:
        rows = matching(pattern, names, f"{card.where}, [limits]")
        if pattern in names and not moving[rows].any():
            why = "is merged" if state.merged[rows].any() else "is locked ([lock], or it moves no vertex)"
            notes.append(f"{card.where}, [limits]: limits of {pattern!r} have no effect, because that joint {why}")
        lower[rows], upper[rows] = low, high
        of_card[rows] = True
    given = of_card & moving & (np.arange(J) != root)
    most = max(np.abs(lower[given]).max(initial=0.0), np.abs(upper[given]).max(initial=0.0))
    if np.count_nonzero(given) >= _SEVERAL and 0 < most < _TINY:
        words = f"none of the joints below the root that it names turns by more than {np.degrees(most):.2g}°"
        notes.append(f"{card.where}, [limits]: {words}: are these radians, with unit = \"deg\"?")
    derived &= ~of_card
    if of_card.any():  # a saved rig may say so of what the card now gives
        stale = [note for note in notes if note.startswith(NO_LIMITS)]
        notes[:] = [note for note in notes if note not in stale]
        if stale and not of_card[moving].all():
            notes.append(f"{NO_LIMITS} some of the moving joints; they were derived (a card's [limits] can replace them)")
    lower, upper = check_limits(report, lower, upper, names)
    lower[~moving] = upper[~moving] = 0.0
    derived &= moving
    if derived.any():
        ways = []
        if (derived & from_animation).any():
            ways.append(f"from the animations with a margin for {np.count_nonzero(derived & from_animation)}")
        plain = derived & ~from_animation
        plain[root] = False
        if plain.any():
            about = f"±{DEFAULT_LIMIT} rad about each axis ({np.degrees(DEFAULT_LIMIT):.0f}°)"
            beyond = max(-lower[plain].min(), upper[plain].max()) > DEFAULT_LIMIT
            about += ", or as far as the animations hold them," if beyond else ""
            ways.append(f"{about} for {np.count_nonzero(plain)} ({_named(names, plain, 4)})")
        if derived[root]:
            ways.append(f"±{DEFAULT_ROOT_LIMIT} rad for sampling the root ({np.degrees(DEFAULT_ROOT_LIMIT):.0f}°)")
        notes.append(
            f"{NO_LIMITS} {np.count_nonzero(derived)} of {np.count_nonzero(moving)} moving joints"
            f"{' with the parent or axes that the card gives' if own else ''}; "
            f"they were derived: {'; '.join(ways)} (a card's [limits] can replace them)"
        )
    return lower, upper


def _library(report, data, names, parents, root, turned, state, limits, notes):
    """The natural poses about the rig's axes, the file's or else its animations', without turns of joints that do not turn;
    and ``smpl_rest``.

    The file's own say how joints turn relative to their parents: where a card gives others they mean nothing any more.
    """
    poses, still = check_poses(report, data.poses, names), state.merged | state.locked
    own = bool(poses)
    if not own and data.animated is not None:
        poses = poses_of_clips(report.array("animated", data.animated, (None, len(names), 3)), root, still)
        if poses:
            notes.append(f"the file has no natural poses: {len(poses)} were taken from its animations")
    rest = None if data.smpl_rest is None else check_rotations(report, "smpl_rest", data.smpl_rest, names)
    if (own or rest is not None) and not np.array_equal(parents, data.parents):
        what = " and ".join(["natural poses"] * own + ["relation to SMPL"] * (rest is not None))
        notes.append(f"the file's {what} {'are' if own else 'is'} left out, because the card changes the hierarchy")
        poses, rest = {} if own else poses, None
    for name, theta in poses.items():
        if turned is not None:
            theta = np.einsum("jab,jb->ja", turned, theta)
        theta[still] = 0.0
        inside = ((theta >= limits[0]) & (theta <= limits[1])).all(axis=1, keepdims=True)
        poses[name] = theta if own else np.where(inside, theta, nearest_rotvec(theta, sum(limits) / 2))  # a card may have others
    return poses, rest


def _partitions(report, data, names, card):
    """The file's partitions and the card's, as plain dictionaries of joint names."""
    out = {}
    for partition, groups in data.partitions.items():
        unknown = [n for members in groups.values() for n in members if n not in names]
        if unknown:
            report.fail(f"partition {partition!r}", f"{unknown[0]!r}, which is no joint of the rig", "names of its joints")
        check_names(report, "partitions", [str(partition), *map(str, groups)])
        out[str(partition)] = {str(part): tuple(members) for part, members in groups.items()}
    for partition, groups in card.partitions.items():
        where = f"{card.where}, [parts.{partition}]"
        owner, expanded = {}, {}
        for part, patterns in groups.items():
            members = sorted({j for pattern in patterns for j in matching(pattern, names, where)})
            for j in members:
                if j in owner:
                    raise InputError(
                        where, f"joint {names[j]!r} in both {owner[j]!r} and {part!r}", "each joint in one part at most"
                    )
                owner[j] = part
            expanded[part] = tuple(names[j] for j in members)
        out[partition] = expanded
    return out


def _counted(mask):
    return counted(np.count_nonzero(mask), "joint")


def _named(names, mask, most=8):
    return listed([names[j] for j in np.flatnonzero(mask)], most)


def _with_notes(rig, notes):
    """The rig with each note once, in order; what was computed for them is not computed again."""
    object.__setattr__(rig, "notes", tuple(dict.fromkeys(str(note) for note in notes)))
    return rig
