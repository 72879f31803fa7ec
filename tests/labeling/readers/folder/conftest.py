"""One small world, and folders of its sweeps in every format with poses in every layout."""

import io

import numpy as np
import pyarrow as pa
import pytest
import yaml
from scipy.spatial.transform import Rotation

from labeling.readers.reader import open_segment

NAMES = ("x", "y", "z", "intensity", "t")
DTYPE = np.dtype([(name, "<f4") for name in NAMES])
STREET = "synthetic:street?sweeps=8&seed=1&beams=16&azimuth_steps=450&movers=6"


@pytest.fixture(scope="session")
def content_of():
    """Return a function that writes (N, 3) points in a format: suffix and bytes."""

    def write(kind, points):
        suffix, write_table = WRITERS[kind]
        return suffix, write_table(table_of(points, np.zeros(len(points), np.float32)))

    return write


@pytest.fixture(scope="session")
def packed():
    """Return the compressor that .pcd files are written with."""
    return compress_lzf


@pytest.fixture(scope="session")
def street():
    """The world that all folders here are written from."""
    return open_segment("synthetic", STREET)


@pytest.fixture(scope="session")
def world(street):
    """The sweeps of a street, as they are."""
    return [street.read_sweep(index) for index in range(len(street.timestamps_ns))]


def table_of(points, offset_s):
    table = np.zeros(len(points), DTYPE)
    for axis, values in zip("xyz", points.T, strict=True):
        table[axis] = values
    table["intensity"], table["t"] = np.arange(len(points)) % 100, offset_s
    return table


def rows_of(table):
    return np.stack([table[name] for name in NAMES], axis=1)


def compress_lzf(data):
    """Runs as they are, and copies of what the same three bytes began before."""
    packed, run, seen, position = bytearray(), bytearray(), {}, 0

    def flush():
        for start in range(0, len(run), 32):
            piece = run[start : start + 32]
            packed.append(len(piece) - 1)
            packed.extend(piece)
        run.clear()

    while position < len(data):
        key = data[position : position + 3]
        at = seen.get(key) if len(key) == 3 else None
        seen[key] = position
        if at is None or position - at > 8192:
            run.append(data[position])
            position += 1
            continue
        length = 3
        while length < 264 and position + length < len(data) and data[at + length] == data[position + length]:
            length += 1
        flush()
        back = position - at - 1
        if length - 2 < 7:
            packed.append(((length - 2) << 5) | (back >> 8))
        else:
            packed.extend([(7 << 5) | (back >> 8), length - 2 - 7])
        packed.append(back & 255)
        position += length
    flush()
    return bytes(packed)


def pcd(table, kind):
    """With padding in front of t, as PCL writes it, and once with none of it."""
    size = len(table)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity _ _ t\n"
        "SIZE 4 4 4 4 1 1 4\nTYPE F F F F U U F\nCOUNT 1 1 1 1 0 3 1\n"
        f"WIDTH {size}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {size}\nDATA {kind}\n"
    ).encode()
    if kind == "ascii":
        lines = [" ".join([*map(str, row[:4]), "0 0 0", str(row[4])]) + "\n" for row in rows_of(table)]
        return header + "".join(lines).encode()
    padded = np.zeros(size, [*DTYPE.descr[:4], ("_", "u1", 3), DTYPE.descr[4]])
    for name in NAMES:
        padded[name] = table[name]
    if kind == "binary":
        return header + padded.tobytes()
    columns = b"".join(np.ascontiguousarray(padded[name]).tobytes() for name in padded.dtype.names)
    packed = compress_lzf(columns)
    return header + np.array([len(packed), len(columns)], "<u4").tobytes() + packed


def ply(table, kind):
    properties = "".join(f"property float {name}\n" for name in NAMES)
    header = f"ply\nformat {kind} 1.0\ncomment made up\nelement vertex {len(table)}\n{properties}"
    header = (header + "element face 0\nproperty list uchar int vertex_indices\nend_header\n").encode()
    if kind == "ascii":
        return header + "".join(" ".join(map(str, row)) + "\n" for row in rows_of(table)).encode()
    return header + table.astype(table.dtype.newbyteorder(">" if "big" in kind else "<")).tobytes()


def saved(save, *arrays, **named):
    buffer = io.BytesIO()
    save(buffer, *arrays, **named)
    return buffer.getvalue()


def feather(table):
    sink = pa.BufferOutputStream()
    columns = pa.table({name: table[name] for name in NAMES})
    with pa.ipc.new_file(sink, columns.schema) as file:
        file.write_table(columns)
    return sink.getvalue().to_pybytes()


def las(table, kind):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=0, version="1.4")
    header.scales = [0.001] * 3
    header.add_extra_dim(laspy.ExtraBytesParams(name="t", type=np.float32))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (table[axis].astype(np.float64) for axis in "xyz")
    cloud["t"] = table["t"]
    return saved(lambda buffer: cloud.write(buffer, do_compress=kind == "laz"))


WRITERS = {
    "bin": ("bin", lambda table: rows_of(table).tobytes()),
    "npy": ("npy", lambda table: saved(np.save, rows_of(table).astype(np.float64))),
    "npy-structured": ("npy", lambda table: saved(np.save, table)),
    "npz": ("npz", lambda table: saved(np.savez_compressed, points=rows_of(table), pose=np.eye(4))),
    "npz-columns": ("npz", lambda table: saved(np.savez, **{name: table[name] for name in NAMES})),
    "pcd-ascii": ("pcd", lambda table: pcd(table, "ascii")),
    "pcd-binary": ("pcd", lambda table: pcd(table, "binary")),
    "pcd-compressed": ("pcd", lambda table: pcd(table, "binary_compressed")),
    "ply-ascii": ("ply", lambda table: ply(table, "ascii")),
    "ply-little": ("ply", lambda table: ply(table, "binary_little_endian")),
    "ply-big": ("ply", lambda table: ply(table, "binary_big_endian")),
    "las": ("las", lambda table: las(table, "las")),
    "laz": ("laz", lambda table: las(table, "laz")),
    "feather": ("feather", lambda table: feather(table)),
}


def tum_rows(sweeps):
    for sweep in sweeps:
        quaternion = Rotation.from_matrix(sweep.world_from_ego[:3, :3]).as_quat()
        yield f"{sweep.timestamp_ns // 10**9}.{sweep.timestamp_ns % 10**9:09d}", sweep.world_from_ego[:3, 3], quaternion


def kitti(sweeps):
    return "".join(" ".join(map(repr, map(float, s.world_from_ego[:3].ravel()))) + "\n" for s in sweeps).encode()


def tum(sweeps):
    rows = [" ".join([time, *map(repr, map(float, [*at, *turn]))]) for time, at, turn in tum_rows(sweeps)]
    return ("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n").encode()


def csv(sweeps, *, with_angles=False):
    rows = []
    for sweep, (_, at, turn) in zip(sweeps, tum_rows(sweeps), strict=True):
        angles = Rotation.from_quat(turn).as_euler("ZYX")[::-1]
        numbers = map(float, [*at, *(angles if with_angles else [turn[3], *turn[:3]])])
        rows.append(",".join([str(sweep.timestamp_ns // 1000 * 1000), *map(repr, numbers)]))
    rotation = "roll,pitch,yaw" if with_angles else "qw,qx,qy,qz"
    return "\r\n".join([f"timestamp_ns, x,y,z,{rotation}", *rows, "", ""]).encode()


POSES = {
    "kitti": ("poses.txt", kitti),
    "4x4.txt": ("poses.txt", lambda s: "".join(
        " ".join(map(repr, map(float, sweep.world_from_ego.ravel()))) + "\n\n" for sweep in s).encode()),
    "tum": ("trajectory.txt", tum),
    "csv": ("poses.csv", csv),
    "csv-angles": ("odom.csv", lambda s: csv(s, with_angles=True)),
    "npy-4x4": ("poses.npy", lambda s: saved(np.save, np.array([sweep.world_from_ego for sweep in s]))),
    "npy-12": ("poses.npy", lambda s: saved(np.save, np.array([sweep.world_from_ego[:3].ravel() for sweep in s]))),
}  # fmt: skip


@pytest.fixture(scope="session")
def write_folder(world):
    """Return a function that writes the world's sweeps into a folder, and what is said of them."""

    def write(folder, kind="pcd-binary", poses="tum", *, said=None, points_of=None, stem=None):
        suffix, content_of = WRITERS[kind]
        (folder / "lidar").mkdir(parents=True)
        for index, sweep in enumerate(world):
            points = sweep.points_ego if points_of is None else points_of(sweep)
            name = sweep.timestamp_ns if stem is None else stem(index, sweep)
            (folder / f"lidar/{name}.{suffix}").write_bytes(content_of(table_of(points, sweep.capture_offset_s)))
        name, poses_of = POSES[poses]
        (folder / name).write_bytes(poses_of(world))
        usual = {"time": {"column": "t"}, "origins": world[0].sensor_origins_ego.tolist()}
        if suffix == "bin" or kind in ("npy", "npz"):
            usual["columns"] = list(NAMES)
        description = {**usual, **(said or {})}
        (folder / "motionlabel.yaml").write_text(yaml.safe_dump(description))
        return folder

    return write
