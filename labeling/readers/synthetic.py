"""Segments of the built-in world: ``synthetic:street?sweeps=20&seed=1``."""

from dataclasses import replace
from typing import Final

from labeling.readers.reader import segment_id_of
from labeling.synthetic.options import read_options
from labeling.synthetic.rigs import RIGS
from labeling.synthetic.scene import SceneReader, sweep_stamps
from labeling.synthetic.shapes import EGO_PARTS
from labeling.synthetic.street import build_street
from schemas.listing import SegmentListing

_OWN_MIN_RANGE_M: Final = 0.25  # of a lidar that sees the vehicle that carries it


def list_segment(uri: str) -> SegmentListing:
    """Tell when the sweeps of a street are taken, by its canonical name."""
    options = read_options(uri)
    stamps = sweep_stamps(options.sweeps, options.hz, options.start_ns)
    return SegmentListing("synthetic", uri, segment_id_of("synthetic", uri), stamps)


def read_segment(listing: SegmentListing) -> SceneReader:
    """Build the street."""
    options = read_options(listing.uri)
    scene = build_street(options.seed, options.sweeps / options.hz, options.movers)
    rig = RIGS[options.rig](options.beams, options.azimuth_steps, options.noise_m, options.dropout)
    if options.body != "none":
        scene = replace(scene, ego_parts=EGO_PARTS[options.body])
        rig = tuple(replace(lidar, min_range_m=_OWN_MIN_RANGE_M) for lidar in rig)
    return SceneReader(scene, listing, options.hz, rig, options.seed)
