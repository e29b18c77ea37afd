"""Check the losses against their definitions, written out as brute force, to compare the numbers with other code.

Everything is in units in which the template's longest half-extent is 1, as in the paper.
"""

import numpy as np

import lbsfit_np as lbs


def main():
    rig = lbs.load_rig("hand")
    scan = lbs.synthesize(rig, n_scans=1, random_state=1, n_points=600)[0]
    half = rig.size / 2
    rng = np.random.default_rng(0)
    theta = rig.lower + rng.random(rig.lower.shape) * (rig.upper - rig.lower)
    offsets = 0.01 * half * rng.standard_normal(rig.vertices.shape)

    X, V, Vd = scan.points / half, rig.pose(theta) / half, rig.pose(theta, offsets=offsets) / half
    s_x, s_v = scan.labels, rig.vertex_labels
    K = lbs.losses.cotangent_matrix(rig.vertices, rig.faces)

    check("L_c   chamfer", lbs.losses.chamfer(X, V)[0], chamfer(X, V))
    check("L_s   structured_chamfer", lbs.losses.structured_chamfer(X, V, s_x, s_v)[0], structured(X, V, s_x, s_v))
    check("L_c²  composite_chamfer", lbs.losses.composite_chamfer(X, Vd, V, lam=0.5)[0], chamfer(X, Vd) + 0.5 * chamfer(X, V))
    check(
        "L_s²  composite_structured_chamfer",
        lbs.losses.composite_structured_chamfer(X, Vd, V, s_x, s_v, lam=0.5)[0],
        structured(X, Vd, s_x, s_v) + 0.5 * structured(X, V, s_x, s_v),
    )
    dense = cotangents(rig.vertices, rig.faces)
    check("L_lap laplacian_posed", lbs.losses.laplacian_posed(Vd, K)[0], np.linalg.norm(dense @ Vd))
    check("L_lap laplacian_offsets", lbs.losses.laplacian_offsets(offsets, K)[0], np.linalg.norm(dense @ offsets))
    other = theta + 0.1
    check("L_Θ   loopback", lbs.losses.loopback(other, theta)[0], np.sum((other - theta) ** 2))

    # Gradients are exact wherever every nearest neighbour is unique; the step h must be small enough to change none.
    direction, h = rng.standard_normal(V.shape), 1e-8
    slope = (chamfer(X, V + h * direction) - chamfer(X, V - h * direction)) / (2 * h)
    check("∂L_c/∂V along a direction", np.vdot(lbs.losses.chamfer(X, V)[1], direction), slope, rtol=1e-5)


def chamfer(X, V):
    """1/n Σ_i min_j ‖x_i − v_j‖² + 1/m Σ_j min_i ‖v_j − x_i‖²."""
    D = squared_distances(X, V)
    return D.min(axis=1).sum() / len(X) + D.min(axis=0).sum() / len(V)


def structured(X, V, s_x, s_v):
    """The same within each part; a part that is empty on one side contributes 0, and the divisors stay n and m."""
    D = np.where(s_x[:, None] == s_v[None], squared_distances(X, V), np.inf)
    from_X, from_V = D.min(axis=1), D.min(axis=0)
    return from_X[np.isfinite(from_X)].sum() / len(X) + from_V[np.isfinite(from_V)].sum() / len(V)


def squared_distances(X, V):
    return ((X[:, None] - V[None]) ** 2).sum(axis=2)


def cotangents(U, faces):
    """K_ij = −½ (cot α_ij + cot β_ij), K_ii = −Σ_j K_ij, one triangle corner after the other."""
    K = np.zeros((len(U), len(U)))
    for triangle in faces:
        for corner in range(3):
            i, j, k = np.roll(triangle, corner)  # the angle at k is opposite to the edge ij
            a, b = U[i] - U[k], U[j] - U[k]
            half_cot = 0.5 * (a @ b) / np.linalg.norm(np.cross(a, b))
            K[i, j] -= half_cot
            K[j, i] -= half_cot
            K[i, i] += half_cot
            K[j, j] += half_cot
    return K


def check(name, value, by_force, rtol=1e-9):
    print(f"{name:36}{value:14.8f}   by brute force {by_force:14.8f}")
    np.testing.assert_allclose(value, by_force, rtol=rtol)


if __name__ == "__main__":
    main()
