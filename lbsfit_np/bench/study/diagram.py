"""The method's diagram: boxes and arrows in the paper's symbols."""

from .canvas import GREY, INK, axes_at, sheet

__all__ = ["diagram"]

_W, _H = 1180, 590
_DATA, _FOUND, _GIVEN, _LOSS = "#ffffff", "#d3e5f2", "#ece9e1", "#fbe3cf"
_FIT, _SELF = "#f7f9fb", "#fdf9f2"
# Centre x, y (pixels from the upper left), width, height, colour, text.
_BOXES = (
    (70, 205, 84, 58, _DATA, "scan\n$X$"),
    (240, 95, 150, 58, _FOUND, "segmenter\n$s(x;\\,X)$"),
    (240, 205, 150, 58, _FOUND, "joint angles\n$\\Theta = f(X)$"),
    (450, 335, 112, 58, _GIVEN, "template\n$U$"),
    (640, 335, 150, 58, _FOUND, "deformation\n$U^d = d(X, U)$"),
    (640, 205, 150, 76, _GIVEN, "linear blend skinning\n$M(\\cdot\\,;\\, w, K)$\nangles in $(R_l, R_u)$"),
    (840, 165, 140, 46, _DATA, "$V^d = M(\\Theta,\\, U^d)$"),
    (840, 245, 140, 46, _DATA, "$V = M(\\Theta,\\, U)$"),
    (
        1059,
        190,
        190,
        150,
        _LOSS,
        "least loss\n"
        "$\\mathcal{L}_{c^2,\\,\\lambda}$  nearest of all\n"
        "$\\mathcal{L}_{s^2,\\,\\lambda}$  nearest of the part\n"
        "$\\mathcal{L}_{lap}$  smooth $U^d$",
    ),
    (1010, 505, 262, 86, _DATA, "mixture $\\Theta'$\n(1) uniform in $(R_l, R_u)$\n(2) $f(X_i) + \\epsilon_i$,  small noise"),
    (735, 505, 150, 58, _GIVEN, "skinning\n$M(\\Theta',\\, U^d)$"),
    (520, 505, 170, 58, _DATA, "synthetic scans $V^d$\nwith true labels $Y$"),
    (
        240,
        505,
        250,
        76,
        _LOSS,
        "learning\n"
        "$s$: cross-entropy of $s(V^d)$ and $Y$\n"
        "$f$: $\\mathcal{L}_\\Theta = \\|f(V^d) - \\Theta'\\|^2$",
    ),
)
# Corners of each arrow's line, what it carries, and where that stands.
_ARROWS = (
    ([(112, 190), (165, 110)], None, None),
    ([(112, 205), (165, 205)], None, None),
    ([(70, 176), (70, 48), (1059, 48), (1059, 115)], "$X$", (560, 40)),
    ([(315, 95), (1020, 95), (1020, 115)], "labels of parts", (560, 84)),
    ([(315, 205), (565, 205)], "$\\Theta$", (470, 195)),
    ([(506, 335), (565, 335)], None, None),
    ([(490, 306), (565, 235)], "$U$", (514, 266)),
    ([(640, 306), (640, 243)], "$U^d$", (658, 275)),
    ([(715, 190), (770, 170)], None, None),
    ([(715, 220), (770, 240)], None, None),
    ([(910, 165), (964, 165)], None, None),
    ([(910, 245), (964, 225)], None, None),
    ([(1010, 265), (1010, 379), (280, 379), (280, 234)], "steps on $\\Theta$ and $U^d$ that lower it", (860, 368)),
    ([(640, 379), (640, 364)], None, None),
)
_LOOP = (
    ([(1059, 265), (1059, 462)], "$\\Theta,\\, U^d$ found", (1112, 345)),
    ([(879, 505), (810, 505)], None, None),
    ([(660, 505), (605, 505)], None, None),
    ([(435, 505), (365, 505)], None, None),
    ([(240, 467), (240, 234)], "new $f$", (212, 345)),
    ([(345, 467), (345, 110), (315, 110)], "new $s$", (373, 275)),
)


def diagram(path):
    """Draw the diagram; returns its caption."""
    with sheet(path, _W, _H) as figure:
        from matplotlib.patches import FancyBboxPatch  # once the sheet has said whether there is a Matplotlib

        ax = axes_at(figure, 0, 0, _W, _H, xlim=(0, _W), ylim=(_H, 0))
        ax.axis("off")
        for top, height, color, title in (
            (12, 378, _FIT, "fitting each scan"),
            (404, 174, _SELF, "self-supervision, once a round"),
        ):
            shape = "round,pad=0,rounding_size=10"
            ax.add_patch(FancyBboxPatch((12, top), _W - 24, height, shape, fc=color, ec="#dddddd", lw=0.8))
            ax.text(26, top + 18, title, color=GREY, va="center", style="italic")
        for lines, color, style in ((_ARROWS, INK, "-"), (_LOOP, "#c1571b", (0, (5, 2)))):
            for corners, said, at in lines:
                _arrow(ax, corners, color, style)
                if said:
                    ax.text(*at, said, ha="center", va="center", color=color, fontsize=10)
        for x, y, width, height, color, text in _BOXES:
            shape = "round,pad=0,rounding_size=6"
            corner = (x - width / 2, y - height / 2)
            ax.add_patch(FancyBboxPatch(corner, width, height, shape, fc=color, ec="#666666", lw=1.0, zorder=3))
            ax.text(x, y, text, ha="center", va="center", fontsize=9.5, linespacing=1.5, zorder=4)
    return (
        "The method in the paper's symbols: blue boxes are what is sought, grey ones are given by the rig, orange ones are "
        "losses, white ones data. Above, a fit: the angles Θ and the deformed template U^d of least loss, by L-BFGS and "
        "Levenberg–Marquardt steps. Below, once a round: synthetic scans from the mixture of uniform and inferred poses on "
        "inferred templates teach the segmenter s and the first guesses of f. In the paper f, d and s are networks; here f is a "
        "library of poses with a regressor, from which a fit starts, d are proportions and offsets of the vertices, and s is a "
        "small classifier."
    )


def _arrow(ax, corners, color, style):
    """A line through all corners with a head at the last one."""
    xs, ys = zip(*corners)
    ax.plot(xs[:-1], ys[:-1], color=color, lw=1.3, ls=style, solid_joinstyle="round")
    head = {"arrowstyle": "-|>,head_width=0.28,head_length=0.55", "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", corners[-1], corners[-2], arrowprops=head | {"color": color, "lw": 1.3, "ls": style})
