"""Subjects: other people's templates with their own joints, from shape parameters and bone proportions."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data
from test_rig_shapes import space

from lbsfit_np import bundled_rigs, load_rig, synthesize
from lbsfit_np.errors import InputError
from lbsfit_np.rig.build import build_rig


@pytest.fixture(scope="module")
def shaped():
    smooth = space(vertices=np.zeros((2, 242, 3)), joints=np.zeros((2, 4, 3)))
    data = make_tube_data()
    D, E = np.array(smooth.vertices), np.array(smooth.joints)
    D[0, :, 1], E[0, :, 1] = data.vertices[:, 1], data.joints[:, 1]
    D[1, :, 0], E[1, :, 0] = 0.3 * data.vertices[:, 0], 0.3 * data.joints[:, 0]
    return build_rig(replace(data, shapes=replace(smooth, vertices=D, joints=E)))


def cosines(rig, other):
    """Of the angles between triangles' normals before and after: negative where one is turned over."""
    a, b = (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) for p in (r.vertices[r.faces] for r in (rig, other)))
    return np.einsum("fa,fa->f", a, b) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


# ---- what is given and what is drawn ----


def test_given_parameters_alone_are_exact(shaped):
    person = shaped.subject(amount=0, height=1.25, girth=-0.5)
    expected = shaped.vertices * [0.85, 1.25, 1]
    np.testing.assert_allclose(person.vertices, expected, atol=1e-12)
    np.testing.assert_allclose(person.joints, shaped.joints * [0.85, 1.25, 1], atol=1e-12)
    np.testing.assert_allclose(person.regressor @ person.vertices, person.joints, atol=1e-10)
    assert person.shapes.default.tolist() == [1.25, -0.5]
    assert person.name == shaped.name and np.array_equal(person.faces, shaped.faces)
    back = person.subject(amount=0, height=1.0, girth=0.0)  # its values are its own defaults
    np.testing.assert_allclose(back.vertices, shaped.vertices, atol=1e-12)


def test_amount_0_without_parameters_is_the_rig(shaped, tube_rig):
    assert shaped.subject(3, amount=0) is shaped and tube_rig.subject(amount=0) is tube_rig


def test_same_seed_same_person(shaped):
    a, b, c = shaped.subject(4), shaped.subject(4), shaped.subject(5)
    assert np.array_equal(a.vertices, b.vertices) and np.array_equal(a.joints, b.joints)
    assert not np.array_equal(a.vertices, c.vertices)
    one = shaped.subject(4, height=1.1)
    assert one.shapes.default[0] == 1.1 and one.shapes.default[1] == a.shapes.default[1]  # the others are drawn the same
    rng = np.random.default_rng(0)
    assert not np.array_equal(shaped.subject(rng).vertices, shaped.subject(rng).vertices)


@pytest.mark.parametrize("amount", [0.5, 1.0, 2.0])
def test_parameters_have_the_spread_of_people(shaped, amount):
    values = np.array([shaped.subject(s, amount=amount).shapes.default for s in range(300)])
    np.testing.assert_allclose(values.mean(axis=0), shaped.shapes.default, atol=0.15 * amount * shaped.shapes.spread.max())
    assert (values >= shaped.shapes.lower).all() and (values <= shaped.shapes.upper).all()
    assert values[:, 0].std() == pytest.approx(0.1 * amount, rel=0.15)
    # The girth's range is ±2 deviations at amount 1 and ±1 at amount 2, where cutting leaves less.
    left = {0.5: 1.0, 1.0: 0.88, 2.0: 0.54}[amount]
    assert values[:, 1].std() == pytest.approx(0.5 * amount * left, rel=0.15)


def bone_lengths(rig, joints):
    child = np.flatnonzero(rig.parents >= 0)
    return np.linalg.norm(joints[child] - joints[rig.parents[child]], axis=1)


def test_bones_vary_on_top(shaped, tube_rig):
    for rig, deviation in ((shaped, 0.03), (tube_rig, 0.08)):
        base = bone_lengths(rig, rig.joints)
        free = {} if rig.shapes is None else {"height": 1.0, "girth": 0.0}
        ratios = np.array([bone_lengths(rig, rig.subject(s, **free).joints) / base for s in range(200)])
        assert 0.5 * deviation < ratios.std() < 1.1 * deviation
        assert np.abs(ratios - 1).max() <= 2 * deviation + 1e-9
        twice = np.array([bone_lengths(rig, rig.subject(s, amount=2, **free).joints) / base for s in range(200)])
        np.testing.assert_allclose(twice.std() / ratios.std(), 2, rtol=0.05)


def test_left_and_right_limbs_are_alike():
    data = replace(make_tube_data(), joint_names=["root", "elbow", "left_finger", "right_finger"], partitions={})
    rig = build_rig(data)
    length = rig.proportions.length
    for seed in range(5):
        person = rig.subject(seed)
        # Stretch of each finger along itself, from how far its vertices moved.
        c = np.linalg.lstsq(
            rig.proportions.basis.reshape(-1, len(length)), (person.vertices - rig.vertices).ravel(), rcond=None
        )[0]
        owner = rig.proportions.owner
        np.testing.assert_allclose(c[owner == 2], c[owner == 3], atol=1e-6)
        assert np.abs(c[owner == 1][:2] - c[owner == 2]).max() > 1e-4


def test_people_are_templates_for_synthesis(shaped):
    people = [shaped.subject(s) for s in range(2)]
    scans = synthesize(shaped, 2, templates=[(p.vertices, p.joints) for p in people], n_points=300, random_state=0)
    for scan, person in zip(scans, people):
        np.testing.assert_allclose(person.pose(scan.pose), scan.vertices, atol=1e-12)


# ---- the bundled rigs ----


@pytest.mark.parametrize("name", bundled_rigs())
def test_no_triangle_is_turned_over(name):
    rig = load_rig(name)
    for seed in range(25):
        person = rig.subject(seed)
        assert cosines(rig, person).min() > 0.3, seed
        assert np.abs(person.vertices - rig.vertices).max() > 0.002 * rig.size


@pytest.mark.parametrize("name", [name for name in bundled_rigs() if load_rig(name).shapes is not None])
def test_no_triangle_is_turned_over_at_the_ends_of_ranges(name):
    rig = load_rig(name)
    s = rig.shapes
    for k, parameter in enumerate(s.names):
        for value in (s.lower[k], s.upper[k]):
            assert cosines(rig, rig.subject(amount=0, **{parameter: value})).min() > 0.3, parameter


def test_subjects_of_all_hands_are_the_same_people():
    hand = load_rig("hand")
    person = hand.subject(7)
    left = load_rig("hand-left").subject(7)
    np.testing.assert_allclose(left.vertices, person.vertices * [-1, 1, 1], atol=1e-9)
    np.testing.assert_allclose(left.joints, person.joints * [-1, 1, 1], atol=1e-9)
    coarse = load_rig("hand-coarse").subject(7)
    assert np.array_equal(coarse.shapes.default, person.shapes.default)
    # Bones vary about axes found from the skin, which is another one here.
    assert np.linalg.norm(coarse.joints - person.joints, axis=1).max() < 0.01 * hand.size


def test_lengths_of_hands_are_as_asked():
    hand = load_rig("hand")
    for length in (0.165, 0.205):
        assert hand.subject(amount=0, length=length).vertices[:, 1].max() == pytest.approx(length, abs=0.001)
    rest = hand.vertices[:, 1].max()
    fingers = hand.subject(amount=0, fingers=1.08)
    assert fingers.vertices[:, 1].max() == pytest.approx(rest, abs=0.001)  # the palm makes up for it
    row = hand.joint_names.index
    assert bone_lengths(hand, fingers.joints)[row("middle2") - 1] == pytest.approx(
        1.08 * bone_lengths(hand, hand.joints)[row("middle2") - 1], rel=1e-6
    )
    thumb = hand.subject(amount=0, thumb=1.1)
    moved = np.abs(thumb.joints - hand.joints).max(axis=1) > 1e-9
    assert [n for n, m in zip(hand.joint_names, moved) if m] == ["thumb2", "thumb3"]
    middle = np.linalg.norm(hand.vertices - hand.joints[row("middle2")], axis=1) < 0.011  # around a finger
    for parameter, axis in (("thickness", 2), ("breadth", 0)):
        changed = hand.subject(amount=0, **{parameter: 1.15 * hand.shapes.default[hand.shapes.names.index(parameter)]})
        ratio = np.ptp(changed.vertices[middle], axis=0) / np.ptp(hand.vertices[middle], axis=0)
        assert ratio[axis] == pytest.approx(1.15, abs=0.02)
        assert np.delete(ratio, axis) == pytest.approx([1, 1], abs=0.04)


# ---- what is refused ----


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"amount": -0.1}, "amount: got -0.1; expected a number from 0 to 2"),
        ({"amount": 2.5}, "amount: got 2.5; expected a number from 0 to 2"),
        ({"amount": "much"}, "amount: got 'much'"),
        ({"amount": True}, "amount: got True"),
        ({"height": 2.5}, "height: got 2.5; expected a number from 0.5 to 2 m"),
        ({"wight": 1.0}, "wight: .*one of: height 0.5 to 2 m; girth -1 to 1"),
        ({"random_state": -1}, "random_state: got -1"),
    ],
)
def test_bad_input(shaped, options, words):
    with pytest.raises(InputError, match=words):
        shaped.subject(**options)


def test_parameters_of_a_rig_without_any(tube_rig):
    with pytest.raises(InputError, match="height: got a shape parameter; expected none, as the rig 'tube'.*amount="):
        tube_rig.subject(height=1.0)


