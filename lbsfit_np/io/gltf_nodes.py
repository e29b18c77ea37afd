"""The node graph of a glTF file: hierarchy, world matrices, and how the animations move them.

Sections named below are those of the glTF 2.0 specification. Matrices act on column vectors.
"""

import numpy as np

from ..rotations import matrix_from_quaternion

__all__ = ["NodeGraph"]

# Keys closer than this (seconds) are one moment: exporters write the same time with different rounding per channel.
_SAME_TIME = 1e-6
# Beyond this, determinants overflow: no transform of a real scene comes near.
_MOST = 1e100
_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}


class NodeGraph:
    """The nodes of a :class:`Document`, checked to be a forest.

    Attributes
    ----------
    parents : (N,) int array
        −1 for a root node.
    names : list of str or None
    translations, rotations, scales : (N, 3), (N, 4), (N, 3) arrays
        Local transforms at rest, T · R · S (3.5.3); quaternions xyzw of length 1.
    worlds : (N, 4, 4) array
        World matrices at rest, in the scene's frame: y up, z forward, metres (3.4).
    """

    def __init__(self, document):
        self._document = document
        nodes = document.items("nodes")
        n = len(nodes)
        self.names = [document.name(node, None) for node in nodes]
        self.parents = np.full(n, -1)
        for i, node in enumerate(nodes):
            for child in document.integers(node, "children", f"node {i}"):
                document.item("nodes", child, f"children of node {i}")
                if self.parents[child] >= 0 or child == i:
                    raise document.error(f"node {child} with two parents, or as its own parent", "nodes with one parent each")
                self.parents[child] = i
        self._order = self._parents_first()
        self.translations, self.scales, self.rotations = np.zeros((n, 3)), np.ones((n, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
        fixed = {}
        for i, node in enumerate(nodes):
            where = f"node {i}"
            if "matrix" in node:
                matrix = document.numbers(node, "matrix", 16, None, where).reshape(4, 4).T
                self.translations[i], self.rotations[i], self.scales[i] = _decomposed(matrix)
                fixed[i] = matrix
                continue
            self.translations[i] = document.numbers(node, "translation", 3, (0, 0, 0), where)
            self.scales[i] = document.numbers(node, "scale", 3, (1, 1, 1), where)
            rotation = document.numbers(node, "rotation", 4, (0, 0, 0, 1), where)
            if np.linalg.norm(rotation) < 1e-6:
                raise document.error(f"a rotation of length 0 in {where}", "a unit quaternion")
            self.rotations[i] = rotation / np.linalg.norm(rotation)
        self._local = _matrices(self.translations, self.rotations, self.scales)
        for i, matrix in fixed.items():
            self._local[i] = matrix  # as it stands: some files shear, against the specification
            self._local[i, 3] = 0.0, 0.0, 0.0, 1.0
        with np.errstate(over="ignore", invalid="ignore"):  # told below
            self.worlds = self.world_matrices()
        beyond = ~(np.abs(self.worlds) <= _MOST).all(axis=(1, 2))
        if beyond.any():
            i = int(beyond.argmax())
            raise document.error(f"node {i}, which is scaled or moved beyond {_MOST:.0e} in the scene", "smaller transforms")

    def label(self, i):
        """What people know a node by."""
        return f"{self.names[i]!r}" if self.names[i] else f"node {i}"

    def ancestors(self, i):
        """The nodes above node ``i``, nearest first."""
        above = []
        while self.parents[i] >= 0:
            i = self.parents[i]
            above.append(int(i))
        return above

    def shown(self):
        """The nodes of the default scene (the first, where none is the default; all nodes, where there are no scenes)."""
        document, n = self._document, len(self.parents)
        if not document.items("scenes"):
            return list(range(n))
        scene = document.item("scenes", document.integer(document.root, "scene", "the file", 0), "the file")
        roots = set(document.integers(scene, "nodes", "the scene"))
        return [i for i in range(n) if i in roots or roots.intersection(self.ancestors(i))]

    def world_matrices(self, posed=None):
        """World matrices, (N, 4, 4), or (T, N, 4, 4) where ``posed`` gives T values of some nodes' properties.

        ``posed`` maps (node, "translation" | "rotation" | "scale") to a (T, 3) or (T, 4) array.
        """
        local = self._local
        if posed:
            frames = len(next(iter(posed.values())))
            local = np.tile(local, (frames, 1, 1, 1))
            for i in {node for node, _ in posed}:
                rest = {"translation": self.translations[i], "rotation": self.rotations[i], "scale": self.scales[i]}
                values = [posed.get((i, path), np.broadcast_to(value, (frames, len(value)))) for path, value in rest.items()]
                local[:, i] = _matrices(*values)
        worlds = local.copy()
        for i in self._order:
            if self.parents[i] >= 0:
                worlds[..., i, :, :] = worlds[..., self.parents[i], :, :] @ local[..., i, :, :]
        return worlds

    def animated_worlds(self, joints, most):
        """World matrices of some nodes, sampled from all the animations that move them.

        Each animation is sampled at the key times of all its channels and halfway between them; where that is more than
        ``most`` moments in the whole file, evenly spaced ones of these are taken, first and last included.

        Parameters
        ----------
        joints : list of int
            Node indices.
        most : int

        Returns
        -------
        (k, J, 4, 4) array, or None where no animation moves them
        """
        relevant = set(joints).union(*(self.ancestors(j) for j in joints))
        clips = [c for c in (self._channels(i, relevant) for i in range(len(self._document.items("animations")))) if c]
        moments = [_moments([times for times, _, _ in clip.values()]) for clip in clips]
        total = sum(map(len, moments))
        if not total:
            return None
        kept = np.unique(np.linspace(0, total - 1, min(total, most)).round().astype(int))
        out, start = [], 0
        for clip, times in zip(clips, moments):
            mine = times[kept[(kept >= start) & (kept < start + len(times))] - start]
            start += len(times)
            if len(mine):
                posed = {target: _sampled(mine, target[1], *channel) for target, channel in clip.items()}
                out.append(self.world_matrices(posed)[:, joints])
        return np.concatenate(out)

    def _channels(self, index, relevant):
        """{(node, path): (key times, values, interpolation)} of one animation, for the nodes in ``relevant`` (3.11)."""
        document = self._document
        animation, where = document.items("animations")[index], f"animation {index}"
        samplers = document.objects(animation, "samplers", where)
        found = {}
        for channel in document.objects(animation, "channels", where):
            target = document.object(channel, "target", f"a channel of {where}")
            path = target.get("path")
            if "node" not in target or not isinstance(path, str) or path not in _WIDTHS:
                continue  # morph weights, or a target that an extension defines
            node = document.integer(target, "node", f"a channel of {where}")
            document.item("nodes", node, f"a channel of {where}")
            if node not in relevant:
                continue
            sampler = document.integer(channel, "sampler", f"a channel of {where}")
            if sampler >= len(samplers):
                raise document.error(f"a channel of {where} with sampler {sampler} of {len(samplers)}", "an existing sampler")
            found[node, path] = self._keys(samplers[sampler], path, f"sampler {sampler} of {where}")
        return found

    def _keys(self, sampler, path, where):
        document = self._document
        interpolation = sampler.get("interpolation", "LINEAR")
        if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
            raise document.error(f"interpolation {interpolation!r} in {where}", "LINEAR, STEP or CUBICSPLINE")
        times = document.accessor(document.integer(sampler, "input", where), f"input of {where}", ("SCALAR",)).astype(float)
        kind = f"VEC{_WIDTHS[path]}"
        values = document.accessor(document.integer(sampler, "output", where), f"output of {where}", (kind,)).astype(float)
        per_key = 3 if interpolation == "CUBICSPLINE" else 1
        if not len(times) or len(values) != per_key * len(times):
            raise document.error(
                f"{len(times)} times and {len(values)} values in {where}", f"{per_key} values for each of one or more times"
            )
        if np.any(np.diff(times) < 0):
            raise document.error(f"times that run backwards in {where}", "increasing times")
        return times, values.reshape(len(times), per_key, -1), interpolation

    def _parents_first(self):
        order, done = [], np.zeros(len(self.parents), dtype=bool)
        for i in range(len(self.parents)):
            chain, seen = [], set()
            while i >= 0 and not done[i]:
                if i in seen:
                    raise self._document.error(f"a cycle of nodes through node {i}", "a hierarchy without cycles")
                seen.add(i)
                chain.append(i)
                i = int(self.parents[i])
            for k in reversed(chain):
                done[k] = True
                order.append(k)
        return order


def _moments(key_times):
    """The key times of all channels, and the times halfway between neighbours."""
    times = np.unique(np.concatenate(key_times))
    times = times[np.append(True, np.diff(times) > _SAME_TIME)]
    return np.sort(np.concatenate([times, (times[1:] + times[:-1]) / 2]))


def _sampled(at, path, times, values, interpolation):
    """A channel's value at the given times (appendix C); before the first and after the last key it stands still.

    ``values`` is (n, 1, w), or (n, 3, w) for CUBICSPLINE: in-tangents a, values v, out-tangents b.
    """
    value = values[:, 1] if interpolation == "CUBICSPLINE" else values[:, 0]
    rotation = path == "rotation"
    if rotation and interpolation != "CUBICSPLINE":
        value = _unit(value)  # normalized integers are a little off
    at = np.clip(at, times[0], times[-1])
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, max(len(times) - 2, 0))
    after = np.minimum(k + 1, len(times) - 1)
    span = times[after] - times[k]
    t = np.divide(at - times[k], span, out=np.zeros(len(at)), where=span > 0)[:, None]
    if interpolation == "STEP":
        out = np.where(t >= 1.0, value[after], value[k])
    elif interpolation == "CUBICSPLINE":
        t2, t3, span = t * t, t * t * t, span[:, None]
        out = (2 * t3 - 3 * t2 + 1) * value[k] + span * (t3 - 2 * t2 + t) * values[k, 2]
        out = out + (3 * t2 - 2 * t3) * value[after] + span * (t3 - t2) * values[after, 0]
    elif rotation:
        out = _slerp(value[k], value[after], t)
    else:
        out = (1 - t) * value[k] + t * value[after]
    return _unit(out) if rotation else out


def _slerp(p, q, t):
    dot = np.einsum("ia,ia->i", p, q)[:, None]
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    near = angle < 1e-6  # there the limit is linear interpolation
    sine = np.where(near, 1.0, np.sin(angle))
    first = np.where(near, 1 - t, np.sin(angle * (1 - t)) / sine)
    second = np.where(near, t, np.sin(angle * t) / sine)
    return first * p + np.where(dot < 0, -1.0, 1.0) * second * q


def _unit(q):
    """Quaternions of length 1; the identity where a spline passes through 0 and no direction is left."""
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(length < 1e-9, [0.0, 0.0, 0.0, 1.0], q / np.maximum(length, 1e-9))


def _matrices(translation, rotation, scale):
    """T · R · S; (..., 3), (..., 4), (..., 3) → (..., 4, 4)."""
    out = np.zeros(rotation.shape[:-1] + (4, 4))
    out[..., :3, :3] = matrix_from_quaternion(*np.moveaxis(rotation, -1, 0)) * scale[..., None, :]
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def _decomposed(matrix):
    """Translation, rotation (xyzw) and scale of a node's matrix, which may not shear (3.5.3); x's scale takes a reflection."""
    linear = matrix[:3, :3]
    scale = np.linalg.norm(linear, axis=0)
    if np.linalg.det(linear) < 0:
        scale[0] = -scale[0]
    axes = linear / np.where(scale == 0, 1.0, scale)
    axes[:, scale == 0] = np.eye(3)[:, scale == 0]
    u, _, vt = np.linalg.svd(axes)
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0]) @ vt
    from scipy.spatial.transform import Rotation

    return matrix[:3, 3], Rotation.from_matrix(rotation).as_quat(), scale
