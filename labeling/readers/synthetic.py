"""Segments of the built-in world: ``synthetic:street?sweeps=20&seed=1``."""

from labeling.readers.reader import segment_id_of
from labeling.synthetic.lidar import Lidar
from labeling.synthetic.options import read_options
from labeling.synthetic.scene import SceneReader, sweep_stamps
from labeling.synthetic.street import build_street
from schemas.listing import SegmentListing


def list_segment(uri: str) -> SegmentListing:
    """Tell when the sweeps of a street are taken, by its canonical name."""
    options = read_options(uri)
    stamps = sweep_stamps(options.sweeps, options.hz, options.start_ns)
    return SegmentListing("synthetic", uri, segment_id_of("synthetic", uri), stamps)


def read_segment(listing: SegmentListing) -> SceneReader:
    """Build the street."""
    options = read_options(listing.uri)
    scene = build_street(options.seed, options.sweeps / options.hz, options.movers)
    lidar = Lidar(options.beams, options.azimuth_steps, options.noise_m, options.dropout)
    return SceneReader(scene, listing, options.hz, lidar, options.seed)
