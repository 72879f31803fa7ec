-- The job store as it was before there were migrations, written by the code of then. SQLite's words; PostgreSQL's
-- differ in one: there, schema_version.version is SERIAL.

CREATE TABLE dispatchers (
    id VARCHAR NOT NULL,
    host VARCHAR NOT NULL,
    pid INTEGER NOT NULL,
    code_version VARCHAR NOT NULL,
    num_workers INTEGER NOT NULL,
    started_ms BIGINT NOT NULL,
    heartbeat_ms BIGINT NOT NULL,
    PRIMARY KEY (id)
);

CREATE TABLE jobs (
    id VARCHAR NOT NULL,
    client_job_id VARCHAR,
    fingerprint VARCHAR NOT NULL,
    dataset VARCHAR NOT NULL,
    output_uri VARCHAR NOT NULL,
    profile VARCHAR NOT NULL,
    config JSON NOT NULL,
    priority INTEGER NOT NULL,
    deadline_s FLOAT,
    num_segments INTEGER NOT NULL,
    state VARCHAR NOT NULL,
    stop VARCHAR,
    generation INTEGER NOT NULL,
    num_kept INTEGER NOT NULL,
    created_ms BIGINT NOT NULL,
    deadline_ms BIGINT,
    started_ms BIGINT,
    finished_ms BIGINT,
    failure JSON,
    PRIMARY KEY (id),
    CONSTRAINT state_known CHECK (state IN ('QUEUED', 'RUNNING', 'CANCELLING', 'SUCCEEDED', 'PARTIAL', 'FAILED', 'CANCELLED', 'TIMED_OUT', 'CRASHED')),
    UNIQUE (client_job_id)
);
CREATE INDEX jobs_by_age ON jobs (created_ms, id);
CREATE INDEX jobs_by_dataset ON jobs (dataset, created_ms, id);
CREATE INDEX jobs_by_state ON jobs (state, created_ms, id);

CREATE TABLE schema_version (
    version INTEGER NOT NULL,
    PRIMARY KEY (version)
);

CREATE TABLE segments (
    job_id VARCHAR NOT NULL,
    position INTEGER NOT NULL,
    uri VARCHAR NOT NULL,
    segment_id VARCHAR,
    state VARCHAR NOT NULL,
    attempts INTEGER NOT NULL,
    fence INTEGER NOT NULL,
    owner VARCHAR,
    lease_ms BIGINT,
    stage VARCHAR,
    sweeps_done INTEGER NOT NULL,
    num_sweeps INTEGER,
    queued_ms BIGINT,
    started_ms BIGINT,
    finished_ms BIGINT,
    error VARCHAR,
    message VARCHAR,
    entry JSON,
    PRIMARY KEY (job_id, position),
    CONSTRAINT state_known CHECK (state IN ('QUEUED', 'RUNNING', 'SUCCEEDED', 'PARTIAL', 'FAILED', 'CANCELLED', 'CRASHED')),
    CONSTRAINT waits_since CHECK ((state = 'QUEUED') = (queued_ms IS NOT NULL)),
    CONSTRAINT held_until CHECK ((state = 'RUNNING') = (lease_ms IS NOT NULL)),
    FOREIGN KEY(job_id) REFERENCES jobs (id)
);
CREATE INDEX segments_by_end ON segments (finished_ms);
CREATE INDEX segments_by_lease ON segments (lease_ms) WHERE lease_ms IS NOT NULL;
CREATE INDEX segments_by_state ON segments (job_id, state, position);
CREATE INDEX segments_by_wait ON segments (queued_ms) WHERE queued_ms IS NOT NULL;
