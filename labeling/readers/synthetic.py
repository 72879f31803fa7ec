"""Segments of the built-in world: ``synthetic:street?sweeps=20&seed=1``."""

from labeling.synthetic.lidar import Lidar
from labeling.synthetic.options import read_options
from labeling.synthetic.scene import SceneReader
from labeling.synthetic.street import build_street


def open_segment(uri: str) -> SceneReader:
    """Open ``synthetic:WORLD?option=value&…``; the reader's URI lists the options that are not the default, sorted.

    Raises:
        InvalidInput: Unknown world or option, or a value out of bounds; the message names what is accepted.

    """
    options = read_options(uri)
    lidar = Lidar(options.beams, options.azimuth_steps, options.noise_m, options.dropout)
    return build_street(options.seed, options.sweeps / options.hz, options.movers).reader(
        options.sweeps,
        options.hz,
        lidar,
        seed=options.seed,
        name=options.name,
        uri=options.uri,
        start_ns=options.start_ns,
    )
