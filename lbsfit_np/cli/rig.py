"""``lbsfit rig``: look at a rig, draw its joints' angles, write a card or its mirror image, list the rigs of the package."""

from pathlib import Path

from ..errors import InputError
from .fit import RIG_OPTIONS, load_rig_with
from .models import about_model, is_model, model_in_words
from .outputs import check_file
from .parsing import Option, add_options, formatter, settings
from .same_files import same_file

__all__ = ["add_parser"]

_FROM_FILE = tuple(o for o in RIG_OPTIONS if o.name in ("shape", "skin"))
_CARD_OPTIONS = (
    Option("output", "the card to write (required)", metavar="CARD", flag="-o"),
    *_FROM_FILE,
    Option("existing", "what to do if CARD already exists", default="error", choices=("error", "replace")),
)
_TURN_OPTIONS = (
    Option("output", "the picture to write (required), NAME.png", metavar="PNG", flag="-o"),
    Option("view", "from where: the sides are the subject's own", default="oblique",
           choices=("front", "back", "left", "right", "top", "bottom", "oblique")),
    *RIG_OPTIONS,
    Option("existing", "what to do if PNG already exists", default="error", choices=("error", "replace")),
)  # fmt: skip
_MIRROR_OPTIONS = (
    Option("output", "the rig to write (required), NAME.npz", metavar="NPZ", flag="-o"),
    Option("axis", "which coordinate changes its sign", default="x", choices=("x", "y", "z")),
    *RIG_OPTIONS,
    Option("existing", "what to do if NPZ already exists", default="error", choices=("error", "replace")),
)
_SHOW_OPTIONS = (*RIG_OPTIONS, Option("degrees", "show limits in degrees instead of radians", bool, False))

_CARD_EPILOG = """\
example:
  lbsfit rig card hand.glb -o hand.card.toml     then edit it; a card of this name beside hand.glb is used automatically
  lbsfit rig show hand.glb                       see what it does
"""


def add_parser(commands):
    """Add ``lbsfit rig`` and its actions to the subparsers ``commands``."""
    parser = commands.add_parser("rig", help="show a rig, write a card for it or its mirror image", formatter_class=formatter)
    parser.description = (
        "Look at rigs, write their mirror images, and write cards: small text files that say what a rig's format cannot."
    )
    actions = parser.add_subparsers(metavar="ACTION", required=True, title="actions")

    show = actions.add_parser(
        "show",
        help="print joints, limits, parts and anomalies",
        description="Print a rig's joint tree with limits, parts and weights, and every anomaly found.",
        epilog="example:\n  lbsfit rig show body.glb --card body.toml --degrees\n",
        formatter_class=formatter,
    )
    rigs = "a rig file (.npz .glb .gltf .pkl), a bundled rig (see: lbsfit rig list), or a model written by lbsfit learn"
    show.add_argument("file", metavar="FILE", help=rigs)
    add_options(show, _SHOW_OPTIONS)
    show.set_defaults(run=_show)

    card = actions.add_parser(
        "card",
        help="write a card to edit",
        description="Write a rig's settings as a card to edit: hierarchy, limits, locked and merged joints, parts, unit, axes.",
        epilog=_CARD_EPILOG,
        formatter_class=formatter,
    )
    card.add_argument("file", metavar="FILE", help="a rig file, or a bundled rig")
    add_options(card, _CARD_OPTIONS)
    card.set_defaults(run=_card)

    turn = actions.add_parser(
        "turn",
        help="draw what the angles of a joint do",
        description="Draw the rig with one joint at its lower limit, at rest, and at its upper limit, in a row of pictures for\n"
        "each of the joint's axes x, y and z. What moves with the joint is orange. An axis that does not turn has the rest\n"
        "pose alone.",
        epilog="example:\n  lbsfit rig turn hand index1 -o index1.png\n",
        formatter_class=formatter,
    )
    turn.add_argument("file", metavar="FILE", help=rigs)
    turn.add_argument("joint", metavar="JOINT", help="the joint's name (see: lbsfit rig show FILE)")
    add_options(turn, _TURN_OPTIONS)
    turn.set_defaults(run=_turn)

    mirror = actions.add_parser(
        "mirror",
        help="write the mirror image, such as a left hand of a right one",
        description="Write a rig's mirror image, such as a left hand of a right one. The same angles give the mirrored pose;\n"
        "left and right are exchanged in names.",
        epilog="example:\n  lbsfit rig mirror right.glb -o left.npz\n",
        formatter_class=formatter,
    )
    mirror.add_argument("file", metavar="FILE", help=rigs)
    add_options(mirror, _MIRROR_OPTIONS)
    mirror.set_defaults(run=_mirror)

    bundled = actions.add_parser(
        "list",
        help="list the bundled rigs",
        description="List the rigs that come with the package.",
        epilog="example:\n  lbsfit rig list\n",
        formatter_class=formatter,
    )
    bundled.set_defaults(run=_list)


def _show(arguments):
    from ..rig.describe import describe

    values = settings(arguments, _SHOW_OPTIONS)
    print(describe(load_rig_with(arguments.file, values, quiet=True), degrees=values["degrees"]), end="")
    model = about_model(arguments.file)
    if model is not None:
        print(f"The file is {model_in_words(model)}.")
    return 0


def _card(arguments):
    from ..io.rigs import CARD_SUFFIX, rig_for_card
    from ..rig.card import write_card
    from ..rig.data import RigData

    values = settings(arguments, _CARD_OPTIONS)
    path = values["output"]
    if path is None:
        raise InputError("-o/--output", "nothing", "the card to write", "Add -o CARD.")
    check_file(path, inputs=[(arguments.file, "the rig itself")], existing=values["existing"])
    found = rig_for_card(arguments.file, shape=values["shape"], skin=values["skin"])
    write_card(found, path)
    rig = Path(arguments.file)
    beside = rig.with_name(rig.stem + CARD_SUFFIX)
    of_model = is_model(arguments.file)
    by_itself = rig.is_file() and same_file(path, beside) and not of_model
    if rig.is_file() and not by_itself and not of_model and beside.is_file():
        print(f"note: the card describes {rig.name} without {beside.name}, which was not read")
    if of_model:
        print(f"{path} written: the rig as the model keeps it; to change it, edit a card of the rig's own file, and learn again")
        return 0
    edit = "check its [hierarchy], which is a guess" if isinstance(found, RigData) else "edit it"
    print(f"{path} written; {edit}; {f'it is used automatically with {rig}' if by_itself else f'pass it with --card {path}'}")
    return 0


def _turn(arguments):
    import numpy as np

    from ..report.render import write_png
    from ..report.turn_picture import turn_picture

    values = settings(arguments, _TURN_OPTIONS)
    path = _output(values, arguments.file, "the picture to write", ".png")
    rig = load_rig_with(arguments.file, values, quiet=True)
    write_png(path, turn_picture(rig, arguments.joint, view=values["view"]))
    j = rig.joint_names.index(arguments.joint)
    for axis, lower, upper in zip("xyz", np.degrees(rig.lower[j]), np.degrees(rig.upper[j])):
        held = f"held at {lower:.0f} degrees" if lower else "does not turn"
        print(f"{axis}: " + (f"{lower:.0f} to {upper:.0f} degrees" if upper > lower else held))
    if j == rig.root:
        print("note: these limits of the root are for sampled poses; fits turn it freely")
    elif (rig.lower[j] > 0).any() or (rig.upper[j] < 0).any():
        print("note: the rest pose is outside these limits")
    print(f"{path} written: rows x, y, z; from left to right the lower limit, the rest pose, the upper limit")
    return 0


def _mirror(arguments):
    values = settings(arguments, _MIRROR_OPTIONS)
    path = _output(values, arguments.file, "the rig to write", ".npz")
    mirrored = load_rig_with(arguments.file, values).mirrored(axis=values["axis"])
    mirrored.save(path)
    print(f"{path} written: {mirrored.name!r}")
    return 0


def _output(values, rig, what, suffix):
    """The file that ``-o`` names, checked before any work: it is not what is read, and ends as it has to."""
    path = values["output"]
    if path is None:
        raise InputError("-o/--output", "nothing", what, f"Add -o NAME{suffix}.")
    inputs = [(rig, "the rig itself")] + [(values["card"], "the card")] * (values["card"] not in (None, "none"))
    check_file(path, inputs=inputs, existing=values["existing"])
    if not path.lower().endswith(suffix):
        raise InputError("-o/--output", path, f"a name that ends in {suffix}", f"Call it {path}{suffix}.")
    return path


def _list(arguments):
    from ..io.rigs import about_bundled, bundled_rigs, load_rig

    rows = [("name", "vertices", "joints", "poses", "what it is")]
    for name in bundled_rigs():
        rig = load_rig(name)
        rows.append((name, f"{len(rig.vertices)}", f"{len(rig.parents)}", f"{len(rig.poses)}", about_bundled(name)))
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    for name, *numbers, about in rows:
        cells = [name.ljust(widths[0]), *(number.rjust(width) for number, width in zip(numbers, widths[1:])), about]
        print("  ".join(cells).rstrip())
    return 0
