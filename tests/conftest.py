"""Settings all tests share, small logs for those of commands and workers, and records for those of tables."""

import http.client
import json
import logging
import uuid
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import settings
from sqlalchemy import create_engine, text

from labeling.threads import use_one_thread
from schemas.objects import LabeledTrack, SweepObservation, SweepPoints

settings.register_profile("motionlabel", deadline=None)  # a busy machine must not fail a test
settings.load_profile("motionlabel")

use_one_thread()  # as every process that labels does; on two threads some libraries take many times as long

JOB_STORE_0001 = Path(__file__).parent / "golden/job_store_0001.sql"
CONFIGS_0001 = Path(__file__).parent / "golden/configs_0001.json"  # of each profile, as jobs of that store have them
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


@pytest.fixture
def make_observation():
    """Return a builder: sweep ``index`` with dynamic points of the given source rows, moving by their row number.

    They lie far from all boxes, but those ``at`` a place in the ego frame.
    """

    def build(index, point_rows=(), *, at=None, reason="", has_flow=True, num_failed_fits=0):
        rows = np.array(point_rows, dtype=np.int32)
        places = [(at or {}).get(row, (500.0, 500.0, 500.0)) for row in point_rows]
        points = SweepPoints(
            points_ego=np.array(places, dtype=np.float32).reshape(-1, 3),
            point_index=rows,
            is_dynamic=np.ones(len(rows), dtype=bool),
            cluster_id=np.zeros(len(rows), dtype=np.int32),
            flow_world_m=np.repeat(rows[:, None], 3, axis=1).astype(np.float32) if has_flow else None,
        )
        pose = np.eye(4)
        pose[0, 3] = index
        return SweepObservation(
            sweep_index=index,
            timestamp_ns=1_700_000_000_000_000_000 + index * 100_000_000,
            world_from_ego=pose,
            num_points=0 if reason else 100,
            num_ground=0 if reason else 40,
            num_static=0 if reason else 30,
            num_clusters=int(len(rows) > 0),
            num_failed_fits=num_failed_fits,
            reason=reason,
            proposals=(),
            points=None if reason else points,
        )

    return build


@pytest.fixture
def make_track():
    """Return a builder: a track through ``sweeps``; sweeps missing from ``rows`` are interpolated."""

    def build(track_id, sweeps, rows):
        size = len(sweeps)
        is_observed = np.array([sweep in rows for sweep in sweeps], dtype=bool)
        boxes = np.tile([0.0, 0.0, 1.0, 4.0, 2.0, 1.5, np.pi], (size, 1))
        boxes[:, 0] = sweeps
        return LabeledTrack(
            track_id=track_id,
            sweep_index=np.array(sweeps, dtype=np.int64),
            timestamp_ns=1_700_000_000_000_000_000 + np.array(sweeps, dtype=np.int64) * 100_000_000,
            boxes=boxes,
            velocity_mps=np.tile([10.0, 0.0, 0.0], (size, 1)),
            score=np.full(size, 0.75),
            num_points=np.array([len(rows.get(sweep, ())) for sweep in sweeps], dtype=np.int64),
            is_observed=is_observed,
            boxes_visible=np.where(is_observed[:, None], boxes, np.nan),
            registration_error_m=np.where(is_observed, 0.05, np.nan),
            point_rows=tuple(np.array(rows.get(sweep, ()), dtype=np.int32) for sweep in sweeps),
        )

    return build


@pytest.fixture
def make_old_store():
    """Return a function that makes a job store as it was before migrations: job "ended", and job "begun" of three.

    The dispatcher that had its second segment at work is gone. Their config is the default one of then, or the given.
    """
    job = {"dataset": "synthetic", "output_uri": "out", "profile": "default", "priority": 0}
    job |= {"fingerprint": "f", "generation": 1, "num_kept": 0, "created_ms": 1000, "started_ms": 2000}
    done = {"state": "SUCCEEDED", "attempts": 1, "fence": 1, "finished_ms": 9000, "stage": "done", "sweeps_done": 4}
    held = {"state": "RUNNING", "attempts": 1, "fence": 1, "owner": "gone", "lease_ms": 3000, "sweeps_done": 2}
    waiting = {"state": "QUEUED", "attempts": 0, "fence": 0, "queued_ms": 1000, "sweeps_done": 0}

    def entry(uri):
        return json.dumps({"segment_id": f"id of {uri}", "uri": uri, "state": "SUCCEEDED"})

    rows = [
        ("schema_version", {"version": 1}),
        ("jobs", {"id": "ended", "state": "SUCCEEDED", "num_segments": 1, "finished_ms": 9000, **job}),
        ("jobs", {"id": "begun", "state": "RUNNING", "num_segments": 3, "client_job_id": "night", **job}),
        ("segments", {"job_id": "ended", "position": 0, "uri": "a", "entry": entry("a"), **done}),
        ("segments", {"job_id": "begun", "position": 0, "uri": "b", "entry": entry("b"), **done}),
        ("segments", {"job_id": "begun", "position": 1, "uri": "c", **held}),
        ("segments", {"job_id": "begun", "position": 2, "uri": "d", **waiting}),
    ]

    def make(url, config=None):
        config_text = json.dumps(config or json.loads(CONFIGS_0001.read_text())["default"])
        script = JOB_STORE_0001.read_text()
        if url.startswith("postgresql"):
            script = script.replace("version INTEGER", "version SERIAL")
        engine = create_engine(url.replace("postgresql:", "postgresql+psycopg:"))
        with engine.begin() as connection:
            for statement in script.split(";\n"):
                connection.exec_driver_sql(statement)
            for table, values_of_row in rows:
                row = values_of_row | ({"config": config_text} if table == "jobs" else {})
                values = ", ".join(f":{name}" for name in row)
                connection.execute(text(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({values})"), row)
        engine.dispose()

    return make


@pytest.fixture(scope="session")
def s3_server():
    """Start an S3 server on this machine and return its host and port."""
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # a line a request
    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    yield server.get_host_and_port()
    server.stop()


@pytest.fixture
def bucket(s3_server, monkeypatch):
    """Return a new bucket as ``s3://...``, with an environment in which it is found."""
    name = f"bucket-{uuid.uuid4()}"
    connection = http.client.HTTPConnection(*s3_server)
    connection.request("PUT", f"/{name}")
    assert connection.getresponse().status == 200
    connection.close()
    variables = {"ENDPOINT_URL": "http://{}:{}".format(*s3_server), "REGION": "us-east-1"}
    for variable, value in {**variables, "ACCESS_KEY_ID": "key", "SECRET_ACCESS_KEY": "secret"}.items():
        monkeypatch.setenv(f"AWS_{variable}", value)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    return f"s3://{name}"
