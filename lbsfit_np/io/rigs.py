"""``load_rig``: a rig from any file that the package reads, or one of the rigs that come with it."""

import importlib
import os
from pathlib import Path

import numpy as np

from ..bundled import bundled_files
from ..errors import FileError, InputError, brief, likeliest
from ..rig.build import build_rig
from ..rig.chains import loose_joints
from ..rig.mirror import mirrored
from .npz import MODEL_KEY, RESULT_KEY, npz_keys
from .scans import SCAN_EXTENSIONS

__all__ = ["CARD_SUFFIX", "about_bundled", "bundled_rigs", "load_rig", "read_rig_data", "rig_for_card"]

# A card named like the rig, in the rig's folder, is used without being asked for.
CARD_SUFFIX = ".card.toml"

_ENDINGS = (".npz", ".glb", ".gltf", ".pkl")
_SMPL_KEYS = ("v_template", "kintree_table")

# Bundled rigs that have no file of their own, as each is the mirror image of another.
_MIRRORED = {"hand-left": "hand", "hand-left-coarse": "hand-coarse"}

# What the bundled rigs are; names that end in -coarse are the same with fewer vertices.
_ABOUT = {
    "body": "a person in A-pose, SMPL's 24 joints",
    "hand": "a right hand, MANO's 16 joints",
    "hand-left": "a left hand, the mirror image of hand",
}
_COARSE = "-coarse"


def load_rig(path_or_name, *, card=None, shape=None, skin=None, normalize_weights=False, parts=None):
    """Load a rig.

    Parameters
    ----------
    path_or_name : path-like or str
        A file: ``.npz`` (the package's own, SMPL-family, or bodies with the keys verts, faces, weights, joints,
        joint_names, parents), ``.glb`` or ``.gltf``, ``.pkl`` (SMPL-family). Or the name of a bundled rig;
        see :func:`bundled_rigs`.
    card : path-like or Card, optional
        The rig card: what the file cannot say or gets wrong. By default ``STEM.card.toml`` beside the file, if there is one
        (``rig.notes`` then says so) and the file is no learned model; "none" ignores it.
    shape : str or int, optional
        Which shape to take from a file of several; the first by default.
    skin : str or int, optional
        Which skin to take from a glTF file of several.
    normalize_weights : bool, default False
        Divide weight rows by their sums instead of refusing rows that are more than 1 % off.
    parts : str, optional
        The partition in use; by default the card's, else the file's, else one part per moving joint.

    Returns
    -------
    Rig

    Raises
    ------
    FileError, InputError
        The error says what was given, what was expected, and what to do.
    """
    if not isinstance(normalize_weights, (bool, np.bool_)):
        raise InputError("normalize_weights", brief(normalize_weights), "True or False")
    data = read_rig_data(path_or_name, shape=shape, skin=skin)
    if isinstance(card, str) and card == "none":
        card = None
    elif card is None and data.path is not None:
        beside = data.path.with_name(data.path.stem + CARD_SUFFIX)
        name = data.path.name  # models have these notes, too: "the file" would be theirs
        if os.path.isfile(beside) and _is_model(data.path):
            data.notes.append(f"the card {beside.name} beside {name} was not used: a learned model keeps its rig as it was")
        elif os.path.isfile(beside):
            card = beside
            data.notes.append(f"the card {beside.name} beside {name} was used")
        elif other := _of_another_case(beside):
            data.notes.append(f"{other} beside {name} was not used: a card of this rig is called {beside.name}")
    return build_rig(data, card, normalize_weights=normalize_weights, parts=parts)


def _is_model(path):
    return path.suffix.lower() == ".npz" and MODEL_KEY in npz_keys(path)


def _of_another_case(path):
    """The name of a file in the same folder that differs from a path's in capitals alone; None where there is none."""
    try:
        names = os.listdir(path.parent)
    except OSError:
        return None
    return next((name for name in sorted(names) if name.casefold() == path.name.casefold()), None)


def read_rig_data(path_or_name, *, shape=None, skin=None):
    """What a rig file says, neither checked nor changed by a card; arguments as in :func:`load_rig`.

    Returns
    -------
    RigData
    """
    if _is_mirrored(path_or_name):
        name = str(path_or_name)
        return mirrored(read_rig_data(_MIRRORED[name], shape=shape, skin=skin), name)
    path = _found(path_or_name)
    ending = path.suffix.lower()
    if ending not in _ENDINGS:
        got = f"the ending {path.suffix!r}" if path.suffix else "a file without an ending"
        remedy = None
        if ending in (".fbx", ".blend", ".dae", ".obj", ".ply"):
            remedy = "Export the rig as glTF 2.0 (.glb), which keeps its skin."
        if ending in SCAN_EXTENSIONS:
            remedy = " ".join(filter(None, [remedy, "If this is a scan, give the rig before the scans."]))
        raise FileError(str(path), got, f"a rig file: {', '.join(_ENDINGS)}", remedy)
    reader = _npz_reader(path) if ending == ".npz" else {".pkl": "smpl"}.get(ending, "gltf")
    if shape is not None and reader != "body":
        raise InputError("shape", repr(shape), f"no shape, because {path} holds only one", "Leave it out.")
    if skin is not None and reader != "gltf":
        raise InputError("skin", repr(skin), f"no skin, because {path} is not a glTF file", "Leave it out.")
    if reader == "gltf":
        return _reader("gltf").read_gltf(path, skin=skin)
    if reader == "smpl":
        return _reader("smpl").read_smpl(path)
    if reader == "own":
        return _reader("npz_rig").read_rig_npz(path)
    return _reader("npz_rig").read_body_npz(path, shape=shape)


def rig_for_card(path_or_name, *, shape=None, skin=None):
    """What ``write_card`` starts from: the rig as it loads without a card, or the file's bare content where it needs one.

    Weight rows are normalised, whatever they sum to: a card says nothing about weights.

    Returns
    -------
    Rig or RigData
        RigData where the file's joints are not one tree, which only a card can make of them.
    """
    data = read_rig_data(path_or_name, shape=shape, skin=skin)
    parents, n = np.asarray(data.parents), len(data.joint_names)
    known = parents.shape == (n,) and parents.dtype.kind in "iu" and (parents < n).all()  # else build_rig says what is wrong
    if known and len(loose_joints(parents)) > 1:
        return data
    return build_rig(data, normalize_weights=True)


def bundled_rigs():
    """Return the names of the rigs that come with the package, for ``load_rig``, as a sorted list of str."""
    files = bundled_files("*.npz")
    return sorted([*files, *(name for name, original in _MIRRORED.items() if original in files)])


def about_bundled(name):
    """What a bundled rig is, in a few words."""
    about = _ABOUT.get(name.removesuffix(_COARSE), "")
    return about + ", with fewer vertices" if about and name.endswith(_COARSE) else about


def _is_mirrored(name):
    known = isinstance(name, (str, os.PathLike)) and str(name) in _MIRRORED
    return known and _MIRRORED[str(name)] in bundled_files("*.npz") and not os.path.isfile(name)


def _found(path_or_name):
    """The path of a file, or of the bundled rig of that name."""
    if not isinstance(path_or_name, (str, os.PathLike)):
        raise InputError("path_or_name", type(path_or_name).__name__, "the path of a rig file, or the name of a bundled rig")
    if not str(path_or_name):
        raise InputError("path_or_name", "an empty text", "the path of a rig file, or the name of a bundled rig")
    path = Path(path_or_name)
    bundled = bundled_files("*.npz")
    if str(path_or_name) in bundled and not os.path.isfile(path):
        return bundled[str(path_or_name)]
    if os.path.isdir(path):
        raise FileError(str(path_or_name), "a folder", f"a rig file: {', '.join(_ENDINGS)}")
    if not os.path.isfile(path):  # os.path's tests, unlike Path's, raise for no name, be it too long or impossible
        names = bundled_rigs()
        expected = "the path of a rig file" + (f", or a bundled rig: {', '.join(names)}" if names else "")
        remedy = likeliest(str(path_or_name), names) if names and not path.suffix and len(path.parts) == 1 else None
        raise FileError(str(path_or_name), "no such file", expected, remedy)
    return path


def _npz_reader(path):
    from .npz_rig import BODY_KEYS, OWN_KEY

    keys = npz_keys(path)
    if OWN_KEY in keys:
        return "own"
    if any(key in keys for key in _SMPL_KEYS):
        return "smpl"
    if "verts" in keys:
        return "body"
    if RESULT_KEY in keys:
        remedy = "Give the rig that the scan was fitted with; lbs.FitResult.load reads this file."
        raise FileError(str(path), "the result of a fit", "a rig, or a learned model", remedy)
    shown = ", ".join(sorted(keys)[:10]) or "nothing"
    expected = f"a rig: the package's own ({OWN_KEY}, ...), SMPL-family ({', '.join(_SMPL_KEYS)}, ...), or {', '.join(BODY_KEYS)}"
    raise FileError(str(path), f"an NPZ with {shown}", expected)


def _reader(module):
    return importlib.import_module(f".{module}", __package__)
