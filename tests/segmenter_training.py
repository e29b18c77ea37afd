"""Segmenters of the tube rig that know little and train fast, and what they are trained on."""

from dataclasses import dataclass, field, replace

from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.rig.build import build_rig
from lbsfit_np.segmentation import cache
from lbsfit_np.segmentation.descriptors import Descriptor
from lbsfit_np.segmentation.segmenter import Segmenter, train_segmenter
from lbsfit_np.segmentation.stage import Training


@dataclass
class Scans:
    """i → scan i of a list, and which were asked for."""

    scans: list
    asked: list = field(default_factory=list)

    def __call__(self, i):
        self.asked.append(i)
        return self.scans[i]


def scans_of(rig, n, seed=0, **settings):
    """Scans of a rig with their parts, as a segmenter is trained on."""
    return Scans([(s.points, s.labels, 1.0) for s in lbs.synthesize(rig, n, random_state=seed, n_points=400, **settings)])


def train_small(rig, seed=0, n=4, second=0.5, **options):
    """A segmenter that learned from ``n`` scans; the second stage from a share of them."""
    training = Training(points_per_scan=60, second=second)
    return train_segmenter(rig, scans_of(rig, n), n, training=training, random_state=seed, **options)


def in_parts(parts):
    """The tube rig in other parts."""
    return build_rig(replace(make_tube_data(), partitions={"few": parts}), parts="few")


ONE = {"all": ("root",)}
TWO = {"arm": ("root",), "fingers": ("long", "short")}


def describe(points, rig, **options):
    """Points in the rig's unit, as a segmenter sees them."""
    return Descriptor()(points / (rig.size / 2), **options)


def cached(key, train):
    """A segmenter of the cache."""
    return cache.cached("segmenter", key, train, Segmenter.load)
