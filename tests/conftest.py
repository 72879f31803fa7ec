"""Settings all tests share, and small logs for those of commands and workers."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import settings

from labeling.threads import use_one_thread

settings.register_profile("motionlabel", deadline=None)  # a busy machine must not fail a test
settings.load_profile("motionlabel")

use_one_thread()  # as every process that labels does; on two threads some libraries take many times as long

START_NS = 1_700_000_000_000_000_000


def write_feather(path, columns):
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table(columns)
    with pa.ipc.new_file(str(path), table.schema) as file:
        file.write_table(table)


@pytest.fixture(scope="session")
def write_av2():
    """Return a function that writes an AV2 log of a vehicle that stands: (N, 3) points of each sweep, ego frame, m."""

    def write(folder, times_s, points_of_sweeps):
        timestamps_ns = START_NS + (np.asarray(times_s) * 1e9).astype(np.int64)
        for timestamp_ns, points in zip(timestamps_ns, points_of_sweeps, strict=True):
            columns = dict(zip("xyz", points.astype(np.float32).T, strict=True))
            write_feather(folder / f"sensors/lidar/{timestamp_ns}.feather", columns)
        zeros, ones = np.zeros(len(timestamps_ns)), np.ones(len(timestamps_ns))
        pose = {"qw": ones, **dict.fromkeys(("qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), zeros)}
        write_feather(folder / "city_SE3_egovehicle.feather", {"timestamp_ns": timestamps_ns, **pose})
        return folder

    return write
