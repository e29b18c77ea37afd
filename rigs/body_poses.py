"""Natural poses of the bundled body, as joint angles in degrees.

Angles are (x, y, z) about the axes that :mod:`rigs.body_skeleton` defines, from the A-pose: flexion, abduction, outward twist for
limbs; forward, to the figure's left, tilted to its right for the trunk. Knees, hands and feet turn about x alone and have one
number. A limb's name without a side stands for both sides, with mirrored angles. What is not named keeps its rest angle, 0.
Where a hand rests on a thigh, a hip or the other arm, the angles were solved for that contact and rounded.
"""

import numpy as np

__all__ = ["POSES", "mirrored_pose", "pose_angles", "pose_library"]

_LIMBS = ("collar", "shoulder", "elbow", "wrist", "hand", "hip", "knee", "ankle", "foot")
_MIRRORED = " (mirrored)"
_SYMMETRIC = 20.0  # degrees: poses nearer to their own mirror image than this get no mirrored twin
_NO_TWIN = ("looking left", "looking right")  # each other's, by name


def _pose(**angles):
    return angles


POSES = {
    "standing": _pose(shoulder=(5, -36, -12), elbow=(3, 0, 13), wrist=(6, 0, 0), hand=22),
    "standing, feet apart": _pose(
        shoulder=(0, -28, -6), elbow=(3, 0, -12), wrist=(12, 6, 0), hand=30, hip=(0, 10, 6), ankle=(0, 0, -11),
    ),
    "standing, hands behind the back": _pose(
        spine3=(-3, 0, 0), head=(-2, 0, 0), collar=(0, 3, 0), shoulder=(-9, -40, -67), elbow=(67, 0, -45), wrist=(0, 19, 0),
        hand=25,
    ),
    "contrapposto": _pose(
        pelvis=(0, -5, -7), spine1=(0, 2, 6), spine2=(2, 3, 7), spine3=(0, 3, 4), neck=(3, -6, -4), head=(0, -12, -5),
        left_shoulder=(8, -38, -12), right_shoulder=(6, -23, -27), left_elbow=(30, 0, -8), right_elbow=(5, 0, 31),
        left_wrist=(-8, 0, 0), right_wrist=(6, 0, 0), left_hand=30, right_hand=22, left_hip=(9, 10, 26), right_hip=(0, -14, 0),
        left_ankle=(-10, 0, 0), right_ankle=(0, 0, -7),
    ),
    "walking": _pose(
        pelvis=(3, -5, 0), spine2=(0, 4, 0), spine3=(0, 6, 0), head=(-2, -3, 0), left_shoulder=(-7, -37, -19),
        right_shoulder=(27, -30, -12), left_elbow=(13, 0, 4), right_elbow=(15, 0, 24), left_wrist=(6, 0, 0),
        right_wrist=(-4, 0, 0), hand=28, left_hip=(35, -4, 4), right_hip=(0, -4, -6), left_knee=16, right_knee=41,
        left_ankle=(-2, 0, 0), right_ankle=(0, 0, -2), right_foot=37,
    ),
    "walking, one foot passing": _pose(
        pelvis=(3, 0, -3), spine1=(0, 0, 2), spine3=(0, -2, 0), left_shoulder=(6, -37, -13), right_shoulder=(16, -35, -21),
        left_elbow=(12, 0, 16), right_elbow=(9, 0, 25), left_wrist=(5, 0, 0), right_wrist=(3, 0, 0), hand=28,
        left_hip=(16, 0, -2), right_hip=(25, -8, 0), left_knee=18, right_knee=60, left_ankle=(6, 0, -3),
        right_ankle=(16, 0, 0),
    ),
    "running": _pose(
        pelvis=(11, -8, 0), spine1=(3, 2, 0), spine2=(3, 6, 0), spine3=(2, 9, 0), neck=(-8, -3, 0), head=(-6, -5, 0),
        left_shoulder=(-19, -29, -40), right_shoulder=(48, -13, 0), left_elbow=(91, 0, 22), right_elbow=(99, 0, 21),
        left_wrist=(-3, 0, 0), right_wrist=(-11, 0, 0), hand=60, left_hip=(69, 3, 9), right_hip=(-9, 0, -10), left_knee=69,
        right_knee=21, left_ankle=(14, 0, -19), right_ankle=(-49, 0, -3), right_foot=40,
    ),
    "running, landing": _pose(
        pelvis=(9, 4, -2), spine1=(2, 0, 0), spine2=(3, -4, 0), spine3=(2, -7, 0), neck=(-7, 2, 0), head=(-5, 4, 0),
        left_shoulder=(31, -18, -7), right_shoulder=(-10, -29, -35), left_elbow=(89, 0, 23), right_elbow=(91, 0, 24),
        left_wrist=(-11, 0, 0), right_wrist=(-3, 0, 0), hand=60, left_hip=(44, -4, -7), right_hip=(14, -3, 3), left_knee=37,
        right_knee=88, left_ankle=(5, 0, -3), right_ankle=(-34, 0, 16),
    ),
    "sitting, hands on the thighs": _pose(
        spine1=(4, 0, 0), spine2=(3, 0, 0), collar=(2, 0, 0), shoulder=(13, -23, 8), elbow=(82, 0, -79), wrist=(-24, -17, 0),
        hand=15, hip=(89, 3, 8), knee=86, ankle=(-3, 0, -3),
    ),
    "sitting, legs crossed": _pose(
        spine1=(6, 0, 0), spine2=(6, 0, 0), spine3=(4, 0, 0), neck=(4, 0, 0), left_collar=(0, 2, 0), right_collar=(-3, 5, 0),
        left_shoulder=(46, -19, 8), right_shoulder=(25, -29, 6), left_elbow=(91, 0, -79), right_elbow=(113, 0, -79),
        left_wrist=(-6, 3, 0), right_wrist=(-10, -29, 0), hand=20, left_hip=(69, -3, 0), right_hip=(103, -27, -5), knee=68,
        left_ankle=(0, 0, -2), right_ankle=(-49, 0, -19),
    ),
    "sitting, ankle on the knee": _pose(
        pelvis=(-6, 0, 0), spine1=(6, 0, 0), spine2=(8, 0, 0), spine3=(6, 0, 0), neck=(2, 0, 0), left_collar=(3, 0, 0),
        right_collar=(-6, 11, 0), left_shoulder=(50, -24, 3), right_shoulder=(10, -31, 44), left_elbow=(55, 0, -79),
        right_elbow=(128, 0, -68), left_wrist=(-19, 8, 0), right_wrist=(18, -29, 0), left_hand=25, right_hand=20,
        left_hip=(56, -2, -2), right_hip=(119, -33, 44), left_knee=55, right_knee=119, left_ankle=(-7, 0, -2),
        right_ankle=(-49, 0, 34),
    ),
    "sitting, leaning forward": _pose(
        pelvis=(22, 0, 0), spine1=(10, 0, 0), spine2=(8, 0, 0), spine3=(6, 0, 0), neck=(-12, 0, 0), head=(-10, 0, 0),
        collar=(3, 0, 0), shoulder=(63, -35, 8), elbow=(62, 0, -16), wrist=(-13, 0, 0), hand=35, hip=(110, 5, 12), knee=90,
        ankle=(0, 0, -2),
    ),
    "reaching forward": _pose(
        pelvis=(6, 8, 0), spine1=(4, 3, 0), spine2=(3, 5, 0), spine3=(2, 8, 0), neck=(-3, -8, 0), head=(-3, -12, 0),
        right_collar=(4, 3, 0), left_shoulder=(21, -30, -35), right_shoulder=(76, 29, 25), left_elbow=(14, 0, 18),
        right_elbow=(-2, 0, 51), left_wrist=(6, 0, 0), right_wrist=(0, -3, 0), left_hand=22, right_hand=10,
        left_hip=(13, -2, -5), right_hip=(23, 0, 7), left_knee=23, right_knee=12, left_ankle=(10, 0, 0),
        right_ankle=(-5, 0, -3),
    ),
    "reaching up": _pose(
        pelvis=(0, 3, 0), spine1=(-2, 2, 5), spine2=(-2, 3, 6), spine3=(-3, 3, 4), neck=(-8, -4, -6), head=(-12, -8, -4),
        left_collar=(5, 13, 0), left_shoulder=(85, 57, 61), right_shoulder=(-8, -21, -19), left_elbow=(3, 0, -5),
        right_elbow=(6, 0, 26), left_wrist=(-9, 3, 0), right_wrist=(6, 0, 0), left_hand=5, right_hand=22, ankle=(-18, 0, 0),
        foot=18,
    ),
    "reaching up, both hands": _pose(
        spine1=(-3, 0, 0), spine2=(-3, 0, 0), spine3=(-4, 0, 0), neck=(-8, 0, 0), head=(-12, 0, 0), collar=(5, 14, 0),
        shoulder=(85, 60, 33), elbow=(5, 0, 32), wrist=(-15, 0, 0), hand=15,
    ),
    "reaching down": _pose(
        pelvis=(30, 6, 0), spine1=(24, 2, 0), spine2=(18, 3, 0), spine3=(10, 6, 0), neck=(-4, 0, 0), head=(-4, 0, 0),
        left_collar=(8, 5, 0), right_collar=(4, 6, 0), left_shoulder=(74, 41, -48), right_shoulder=(73, 36, -12),
        left_elbow=(35, 0, 0), right_elbow=(-2, 0, 79), left_wrist=(-24, -8, 0), right_wrist=(2, 0, 0), hand=20,
        left_hip=(64, 0, 0), right_hip=(62, 3, 9), knee=56, ankle=(19, 0, 3),
    ),
    "reaching sideways": _pose(
        pelvis=(0, 0, -3), spine1=(0, 0, -6), spine2=(0, 0, -6), spine3=(0, 3, -4), neck=(0, 14, 3), head=(0, 26, 4),
        left_collar=(0, 12, 0), left_shoulder=(17, 53, 9), right_shoulder=(8, -36, -30), left_elbow=(0, 0, 8),
        right_elbow=(3, 0, 33), left_wrist=(0, -4, 0), right_wrist=(7, 0, 0), left_hand=8, right_hand=20, left_hip=(4, 7, 6),
        right_hip=(0, -2, 3), left_knee=8, left_ankle=(2, 0, 4),
    ),
    "arms overhead": _pose(
        spine3=(-3, 0, 0), collar=(4, 20, 0), shoulder=(77, 78, 55), elbow=(5, 0, 79), wrist=(0, 2, 0), hand=4,
    ),
    "one arm up": _pose(
        left_collar=(2, 21, 0), left_shoulder=(64, 81, 50), right_shoulder=(5, -36, -12), left_elbow=(4, 0, 32),
        right_elbow=(3, 0, 13), left_wrist=(-5, 6, 0), right_wrist=(6, 0, 0), left_hand=4, right_hand=22,
    ),
    "waving": _pose(
        spine2=(0, 0, -2), head=(-2, -4, 4), right_collar=(0, 2, 0), left_shoulder=(4, -34, -12), right_shoulder=(37, 27, 74),
        left_elbow=(3, 0, 13), right_elbow=(67, 0, -3), left_wrist=(6, 0, 0), right_wrist=(-14, -3, 0), left_hand=22,
        right_hand=3,
    ),
    "t-pose": _pose(collar=(0, 7, 0), shoulder=(2, 38, 0), elbow=(-3, 0, 0)),
    "arms forward": _pose(collar=(5, 0, 0), shoulder=(84, 23, -17), elbow=(-3, 0, -14), hand=4),
    "one leg up": _pose(
        pelvis=(-2, 0, 0), left_shoulder=(-8, -11, 0), right_shoulder=(6, -10, 12), left_elbow=(27, 0, -22),
        right_elbow=(26, 0, -32), left_wrist=(-31, -2, 0), right_wrist=(-26, -2, 0), hand=10, left_hip=(93, 0, 4),
        right_hip=(0, -6, 0), left_knee=91, right_knee=6, left_ankle=(-17, 0, 16), right_ankle=(4, 0, -5),
    ),
    "crouching": _pose(
        pelvis=(26, 0, 0), spine1=(12, 0, 0), spine2=(8, 0, 0), spine3=(6, 0, 0), neck=(-14, 0, 0), head=(-12, 0, 0),
        collar=(4, 0, 0), shoulder=(74, 7, 18), elbow=(55, 0, 15), wrist=(-13, 0, 0), hand=35, hip=(79, 5, 5), knee=89,
        ankle=(19, 0, 9),
    ),
    "deep squat": _pose(
        pelvis=(20, 0, 0), spine1=(18, 0, 0), spine2=(12, 0, 0), spine3=(6, 0, 0), neck=(-12, 0, 0), head=(-8, 0, 0),
        collar=(5, 15, 0), shoulder=(83, 63, 11), elbow=(20, 0, 74), wrist=(-16, 2, 0), hand=30, hip=(114, 28, 0), knee=138,
        ankle=(19, 0, 23),
    ),
    "lunge": _pose(
        pelvis=(3, 0, 0), spine2=(2, 0, 0), shoulder=(15, -29, -25), elbow=(0, 0, 30), wrist=(9, 0, 0), hand=22,
        left_hip=(74, -2, 0), right_hip=(-9, -5, -4), left_knee=60, right_knee=63, left_ankle=(-10, 0, -3),
        right_ankle=(19, 0, 3), right_foot=48,
    ),
    "side lunge": _pose(
        pelvis=(18, 0, 0), spine1=(6, 0, 0), spine2=(6, 0, 0), neck=(-8, 0, 0), head=(-8, 0, 0), collar=(3, 3, 0),
        shoulder=(71, 29, -23), elbow=(50, 0, 58), wrist=(-15, 2, 0), hand=40, left_hip=(62, 24, 3), right_hip=(39, 39, -2),
        left_knee=81, right_knee=40, left_ankle=(19, 0, 27), right_ankle=(9, 0, 34),
    ),
    "kneeling on one knee": _pose(
        pelvis=(2, 0, 0), spine1=(3, 0, 0), left_collar=(2, 0, 0), left_shoulder=(16, -19, 11), right_shoulder=(12, -32, -28),
        left_elbow=(92, 0, -79), right_elbow=(6, 0, 30), left_wrist=(-12, -14, 0), right_wrist=(6, 0, 0), left_hand=15,
        right_hand=22, left_hip=(101, 0, 7), right_hip=(0, -4, -3), left_knee=98, right_knee=81, left_ankle=(0, 0, -5),
        right_ankle=(-21, 0, 0), right_foot=59,
    ),
    "kneeling": _pose(
        pelvis=(-2, 0, 0), collar=(11, -9, 0), shoulder=(19, -18, -47), elbow=(22, 0, -16), wrist=(16, 0, 0), hand=15,
        hip=(6, 3, 3), knee=100, ankle=(-49, 0, 0),
    ),
    "kneeling, sitting on the heels": _pose(
        pelvis=(8, 0, 0), spine1=(4, 0, 0), spine2=(3, 0, 0), collar=(6, -7, 0), shoulder=(21, -21, -6), elbow=(37, 0, -77),
        wrist=(-42, -2, 0), hand=15, hip=(60, 9, 6), knee=138, ankle=(-49, 0, -2),
    ),
    "hands on the hips": _pose(
        collar=(7, -4, 0), shoulder=(-37, -17, -69), elbow=(106, 0, 16), wrist=(-42, 9, 0), hand=35, hip=(0, 6, 4),
        ankle=(0, 0, -6),
    ),
    "arms folded": _pose(
        spine3=(2, 0, 0), left_collar=(7, 4, 0), right_collar=(8, 7, 0), left_shoulder=(41, -19, -69),
        right_shoulder=(59, -2, -69), left_elbow=(96, 0, 25), right_elbow=(107, 0, 42), left_wrist=(28, -18, 0),
        right_wrist=(24, -7, 0), left_hand=15, right_hand=25,
    ),
    "hands behind the head": _pose(
        spine3=(-3, 0, 0), neck=(-3, 0, 0), collar=(-14, 12, 0), shoulder=(71, 50, 82), elbow=(130, 0, 26), wrist=(11, -23, 0),
        hand=30,
    ),
    "hands clasped in front": _pose(collar=(19, -9, 0), shoulder=(15, -22, -44), elbow=(43, 0, 9), wrist=(20, 0, 0), hand=35),
    "praying hands": _pose(
        neck=(8, 0, 0), head=(8, 0, 0), collar=(10, 14, 0), shoulder=(25, -35, -8), elbow=(111, 0, -34), wrist=(-59, 19, 0),
        hand=2,
    ),
    "turned torso": _pose(
        pelvis=(0, 12, 0), spine1=(0, 8, 0), spine2=(0, 12, 0), spine3=(0, 17, 0), neck=(0, 10, 0), head=(0, 8, 0),
        left_shoulder=(14, -12, -50), right_shoulder=(13, -30, 24), left_elbow=(18, 0, -13), right_elbow=(27, 0, -19),
        left_wrist=(19, 0, 0), right_wrist=(-25, -2, 0), hand=25, left_hip=(10, -2, -9), right_hip=(7, 0, 11), knee=12,
        ankle=(3, 0, 0),
    ),
    "looking left": _pose(
        spine3=(0, 8, 0), neck=(0, 24, 0), head=(-2, 36, 0), left_shoulder=(8, -36, -18), right_shoulder=(0, -37, -7),
        left_elbow=(3, 0, 12), right_elbow=(3, 0, 14), wrist=(6, 0, 0), hand=22,
    ),
    "looking right": _pose(
        spine2=(0, -3, 0), spine3=(0, -6, 0), neck=(2, -22, 3), head=(0, -34, 4), left_shoulder=(4, -32, -16),
        right_shoulder=(12, -30, -30), left_elbow=(13, 0, 16), right_elbow=(13, 0, 14), wrist=(10, 0, 0), hand=35,
    ),
    "looking up": _pose(
        spine2=(-3, 0, 0), spine3=(-6, 0, 0), neck=(-22, 0, 0), head=(-18, 0, 0), shoulder=(-4, -37, -16), elbow=(3, 0, 12),
        wrist=(6, 0, 0), hand=22,
    ),
    "looking down": _pose(
        spine3=(6, 0, 0), neck=(22, 0, 0), head=(17, 0, 0), shoulder=(10, -36, -10), elbow=(3, 0, 13), wrist=(6, 0, 0),
        hand=22,
    ),
    "head tilted": _pose(
        spine3=(0, 0, 2), neck=(2, -4, 17), head=(2, -6, 12), left_shoulder=(5, -38, -12), right_shoulder=(4, -34, -12),
        elbow=(3, 0, 13), wrist=(6, 0, 0), hand=22,
    ),
    "bowing": _pose(
        pelvis=(30, 0, 0), spine1=(18, 0, 0), spine2=(10, 0, 0), spine3=(6, 0, 0), neck=(6, 0, 0), head=(6, 0, 0),
        collar=(3, 0, 0), shoulder=(72, -11, 0), elbow=(0, 0, 36), wrist=(2, 0, 0), hand=15, hip=(26, 0, 2), knee=2,
        ankle=(6, 0, 0),
    ),
    "throwing": _pose(
        pelvis=(-4, -26, 0), spine1=(-4, -6, -4), spine2=(-3, -8, -4), spine3=(-3, -12, -3), neck=(0, 18, 3), head=(0, 26, 3),
        left_collar=(0, 8, 0), left_shoulder=(13, 44, -11), right_shoulder=(47, 17, 52), left_elbow=(13, 0, 10),
        right_elbow=(60, 0, 45), left_wrist=(10, 0, 0), right_wrist=(4, 0, 0), left_hand=15, right_hand=45,
        left_hip=(19, 4, 25), right_hip=(0, 9, 5), right_knee=28, left_ankle=(-22, 0, -4), right_ankle=(19, 0, 11),
    ),
    "throwing, follow through": _pose(
        pelvis=(18, 22, 3), spine1=(10, 6, 3), spine2=(8, 10, 3), spine3=(6, 14, 2), neck=(-8, -16, 0), head=(-8, -18, 0),
        right_collar=(0, 13, 0), left_shoulder=(48, -10, -39), right_shoulder=(44, 58, -49), left_elbow=(47, 0, 33),
        right_elbow=(11, 0, 79), left_wrist=(23, -3, 0), right_wrist=(-12, 3, 0), left_hand=40, right_hand=25,
        left_hip=(57, -12, -20), right_hip=(14, 0, 18), left_knee=21, right_knee=56, left_ankle=(-17, 0, -5),
        right_ankle=(4, 0, 0),
    ),
    "kicking": _pose(
        pelvis=(-14, -10, 6), spine1=(6, 3, -3), spine2=(5, 5, -3), spine3=(4, 8, 0), neck=(4, 0, 0), head=(4, 2, 0),
        left_shoulder=(56, 16, -3), right_shoulder=(-34, 0, -8), left_elbow=(26, 0, 11), right_elbow=(19, 0, 16),
        left_wrist=(9, 0, 0), right_wrist=(-25, 0, 0), hand=20, left_hip=(-18, -12, 18), right_hip=(68, -7, -9),
        left_ankle=(4, 0, -5), right_ankle=(-49, 0, -2),
    ),
    "boxing guard": _pose(
        pelvis=(6, -24, 0), spine1=(6, -3, 0), spine2=(5, -3, 0), spine3=(6, -4, 0), neck=(4, 12, 0), head=(2, 20, 0),
        left_collar=(0, 31, 0), right_collar=(2, 34, 0), left_shoulder=(48, -29, 34), right_shoulder=(78, -46, -3),
        left_elbow=(102, 0, 27), right_elbow=(119, 0, 24), left_wrist=(-6, 0, 0), right_wrist=(-8, 0, 0), hand=65,
        left_hip=(34, 4, 13), right_hip=(16, 4, 0), left_knee=30, right_knee=34, right_ankle=(16, 0, 0),
    ),
    "yoga tree": _pose(
        pelvis=(0, 0, 2), collar=(5, 34, 0), left_shoulder=(48, 74, 41), right_shoulder=(50, 74, 41), elbow=(63, 0, 79),
        left_wrist=(-42, -15, 0), right_wrist=(-38, -14, 0), hand=2, left_hip=(3, -9, 0), right_hip=(69, 20, 44),
        right_knee=137, left_ankle=(-2, 0, -7), right_ankle=(-22, 0, 34),
    ),
    "yoga warrior": _pose(
        pelvis=(0, -20, 0), spine1=(0, -2, 0), spine2=(0, -2, 0), spine3=(0, -4, 0), neck=(0, 26, 0), head=(0, 36, 0),
        collar=(0, 7, 0), left_shoulder=(0, 38, 0), right_shoulder=(5, 38, 0), elbow=(-6, 0, 0), hand=2, left_hip=(52, 40, 44),
        right_hip=(12, 40, -10), left_knee=62, right_knee=34, left_ankle=(-8, 0, 10), right_ankle=(12, 0, 34),
    ),
    "star jump": _pose(
        neck=(-3, 0, 0), collar=(0, 15, 0), shoulder=(38, 64, 47), elbow=(-2, 0, 35), wrist=(-3, 0, 0), hand=2, hip=(2, 32, 6),
        knee=4, ankle=(-22, 0, 0),
    ),
    "leaning sideways": _pose(
        pelvis=(0, 0, 3), spine1=(0, 0, 13), spine2=(0, 0, 10), spine3=(0, 0, 7), neck=(0, 0, 6), head=(0, 0, 4),
        left_collar=(2, 18, 0), left_shoulder=(65, 71, 53), right_shoulder=(4, 2, -41), left_elbow=(20, 0, 79),
        right_elbow=(0, 0, 43), left_wrist=(30, 5, 0), right_wrist=(8, 0, 0), left_hand=5, right_hand=10, left_hip=(0, 0, 3),
        right_hip=(6, 6, 3), right_knee=12, left_ankle=(0, 0, 3), right_ankle=(5, 0, 4),
    ),
    "pushing a wall": _pose(
        pelvis=(24, 0, 0), spine1=(-2, 0, 0), spine2=(-2, 0, 0), neck=(-8, 0, 0), head=(-6, 0, 0), collar=(7, 0, 0),
        shoulder=(95, -11, 45), elbow=(14, 0, -79), wrist=(-69, 2, 0), hand=2, left_hip=(37, -2, -2), right_hip=(-5, -3, -3),
        left_knee=36, left_ankle=(19, 0, 0), right_ankle=(-2, 0, 0), right_foot=27,
    ),
    "push-up on a bench": _pose(
        pelvis=(34, 0, 0), neck=(-14, 0, 0), head=(-10, 0, 0), collar=(5, 0, 0), shoulder=(85, -8, 24), elbow=(2, 0, -64),
        wrist=(-69, 9, 0), hand=2, hip=(2, 0, -4), knee=2, ankle=(-36, 0, -2), foot=35,
    ),
    "dancing": _pose(
        pelvis=(0, 10, 7), spine1=(-2, -4, -5), spine2=(-2, -6, -6), spine3=(-3, -8, -4), neck=(-4, 10, -6), head=(-5, 16, -8),
        left_collar=(0, 14, 0), left_shoulder=(57, 60, 60), right_shoulder=(14, 13, 14), left_elbow=(53, 0, -19),
        right_elbow=(41, 0, -34), left_wrist=(-31, 19, 0), right_wrist=(-4, 0, 0), hand=15, left_hip=(33, -6, 17),
        right_hip=(17, 5, 28), left_knee=39, right_knee=35, left_ankle=(-16, 0, -2), right_ankle=(18, 0, -3),
    ),
    "balancing on one leg": _pose(
        pelvis=(34, 0, 0), spine1=(4, 0, 0), spine2=(-3, 0, 0), neck=(-12, 0, 0), head=(-10, 0, 0), collar=(0, 7, 0),
        shoulder=(21, 40, 33), elbow=(-3, 0, 5), hand=4, left_hip=(41, -7, 0), right_hip=(-18, 0, -2), right_knee=8,
        left_ankle=(-6, 0, -8), right_ankle=(-49, 0, -2),
    ),
    "carrying a box": _pose(
        pelvis=(-3, 0, 0), spine1=(-3, 0, 0), spine2=(-2, 0, 0), shoulder=(13, -32, -43), elbow=(77, 0, 59), wrist=(0, 6, 0),
        hand=18, left_hip=(11, 0, 0), left_knee=13, right_knee=11, right_ankle=(8, 0, 0),
    ),
    "phone to the ear": _pose(
        neck=(4, -4, 5), head=(4, -8, 6), right_collar=(-14, 32, 0), left_shoulder=(14, -30, -33),
        right_shoulder=(41, -47, 11), left_elbow=(10, 0, 37), right_elbow=(143, 0, 9), left_wrist=(5, -8, 0),
        right_wrist=(-24, 19, 0), left_hand=22, right_hand=35, left_hip=(6, 0, 9), right_hip=(3, -3, 0), knee=6,
        right_ankle=(4, 0, -2),
    ),
    "pointing": _pose(
        spine2=(0, 3, 0), spine3=(0, 5, 0), neck=(0, -8, 0), head=(0, -10, 0), right_collar=(2, 2, 0),
        left_shoulder=(8, -36, -18), right_shoulder=(61, 27, 11), left_elbow=(3, 0, 12), right_elbow=(0, 0, 3),
        left_wrist=(6, 0, 0), right_wrist=(3, 0, 0), left_hand=22, right_hand=5,
    ),
    "drinking": _pose(
        neck=(-6, 0, 0), head=(-10, 0, 0), right_collar=(-13, 34, 0), left_shoulder=(7, -36, -14),
        right_shoulder=(76, -17, -30), left_elbow=(0, 0, 15), right_elbow=(133, 0, 46), left_wrist=(6, 0, 0),
        right_wrist=(-12, -25, 0), left_hand=22, right_hand=45,
    ),
    "hand on the chin": _pose(
        spine3=(3, 0, 0), neck=(6, 0, 3), head=(6, 4, 0), left_collar=(11, 8, 0), right_collar=(-3, -9, 0),
        left_shoulder=(45, -22, -69), right_shoulder=(52, -11, -67), left_elbow=(85, 0, 41), right_elbow=(131, 0, 40),
        left_wrist=(20, 0, 0), right_wrist=(14, 17, 0), hand=25,
    ),
    "shrugging": _pose(
        neck=(0, 0, 5), head=(2, 0, 8), collar=(4, 30, 0), shoulder=(8, -64, 16), elbow=(73, 0, 79), wrist=(-4, 10, 0),
        hand=12,
    ),
    "flexing the biceps": _pose(
        spine3=(-3, 0, 0), collar=(0, 5, 0), shoulder=(21, 34, 20), elbow=(108, 0, 79), wrist=(-3, 3, 0), hand=38,
        hip=(0, 8, 6), ankle=(0, 0, -8),
    ),
    "stepping up": _pose(
        pelvis=(8, 0, 2), spine1=(3, 0, 0), spine2=(2, 4, 0), head=(-4, 0, 0), left_shoulder=(4, -38, -14),
        right_shoulder=(35, -28, -2), left_elbow=(15, 0, 11), right_elbow=(29, 0, 21), left_wrist=(6, 0, 0), hand=28,
        left_hip=(85, -5, 0), right_hip=(20, -3, -2), left_knee=92, right_knee=31, left_ankle=(15, 0, 0),
        right_ankle=(4, 0, 0), right_foot=13,
    ),
}


def pose_angles(pose, joint_names):
    """Rotation vectors of one pose.

    Parameters
    ----------
    pose : dict
        A value of ``POSES``.
    joint_names : sequence of str
        The rig's joints: "pelvis", "left_hip", ….

    Returns
    -------
    (J, 3) array, radians
    """
    theta = np.zeros((len(joint_names), 3))
    for name, angles in pose.items():
        for joint in (f"left_{name}", f"right_{name}") if name in _LIMBS else (name,):
            theta[list(joint_names).index(joint)] = angles if np.ndim(angles) else (angles, 0, 0)
    return np.radians(theta)


def mirrored_pose(theta, joint_names):
    """The mirror image of a pose: left and right exchanged, and turns and tilts of the trunk reversed.

    Parameters
    ----------
    theta : (J, 3) array
    joint_names : sequence of str

    Returns
    -------
    (J, 3) array
    """
    other = {"left": "right", "right": "left"}
    out = np.empty_like(theta)
    for row, name in enumerate(joint_names):
        side, _, limb = name.partition("_")
        if side in other:
            out[row] = theta[list(joint_names).index(f"{other[side]}_{limb}")]
        else:
            out[row] = theta[row] * [1, -1, -1]
    return out


def pose_library(joint_names):
    """Names and angles of all poses, each followed by its mirror image where that is another pose.

    Parameters
    ----------
    joint_names : sequence of str

    Returns
    -------
    names : tuple of k str
    theta : (k, J, 3) array, radians
    """
    names, thetas = [], []
    for name, pose in POSES.items():
        theta = pose_angles(pose, joint_names)
        names.append(name)
        thetas.append(theta)
        twin = mirrored_pose(theta, joint_names)
        if name not in _NO_TWIN and np.abs(theta - twin).max() > np.radians(_SYMMETRIC):
            names.append(name + _MIRRORED)
            thetas.append(twin)
    return tuple(names), np.stack(thetas)
