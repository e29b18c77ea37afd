"""A rig card: coarser parts, a locked joint, narrower limits, without touching the rig's file.

From the command line: ``lbsfit rig card hand -o my.toml``, edit it, ``lbsfit rig show hand --card my.toml``.
"""

import tempfile
from pathlib import Path

import numpy as np

import lbsfit_np as lbs

CARD = """
[rig]
use_parts = "digits"

[lock]
joints = ["pinky3"]

[limits]
unit = "deg"
"thumb1" = [[0, 0, 0], [30, 20, 0]]

[parts.digits]
palm = ["wrist"]
thumb = ["thumb*"]
fingers = ["index*", "middle*", "ring*", "pinky*"]
"""


def main():
    plain = lbs.load_rig("hand")
    with tempfile.TemporaryDirectory() as folder:
        card = Path(folder) / "hand.card.toml"
        card.write_text(CARD, encoding="utf-8")
        rig = lbs.load_rig("hand", card=card)

        print(plain)
        print(rig)
        thumb = rig.joint_names.index("thumb1")
        print("limits of thumb1 in degrees:", np.degrees(rig.lower[thumb]).round(), np.degrees(rig.upper[thumb]).round())
        for part, count in zip(rig.parts, np.bincount(rig.vertex_labels)):
            print(f"{part:8} leads {count} of {len(rig.vertices)} vertices")

        # Neither locking nor grouping changes the rest shape: Θ = 0 gives back U.
        np.testing.assert_array_equal(rig.pose(np.zeros_like(rig.lower)), plain.vertices)

        # A name that the rig does not have is an error, which says which names are near.
        card.write_text('[lock]\njoints = ["pinkie3"]\n', encoding="utf-8")
        try:
            lbs.load_rig("hand", card=card)
        except lbs.LbsfitError as error:
            print("as it should be:", error)
        else:
            raise SystemExit("a card that names no joint was taken")


if __name__ == "__main__":
    main()
