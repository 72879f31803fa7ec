"""A store of an earlier version becomes one of ours: all of it or nothing, whoever else tries, as often as is asked."""

import json
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from alembic.config import Config
from alembic.script import ScriptDirectory
from pydantic import ValidationError
from sqlalchemy import Engine, create_engine, event, insert, inspect, select, text, update
from sqlalchemy.exc import IntegrityError

from schemas.api.jobs import JobState, SegmentState
from schemas.config import PROFILES, LabelingConfig, resolve_config
from schemas.errors import InvalidInput
from schemas.manifest import SegmentEntry
from workers.jobs.claims import SegmentQueue
from workers.jobs.database import migrate_database, open_database
from workers.jobs.labels import read_labels
from workers.jobs.store import JobStore
from workers.jobs.tables import jobs, metadata
from workers.jobs.versions import STORE_VERSION

ROOT = Path(__file__).resolve().parents[3]
OLD_CONFIGS = json.loads((ROOT / "tests/golden/configs_0001.json").read_text())  # of each profile
MIGRATE = "import sys; from workers.jobs.database import migrate_database; print(migrate_database(sys.argv[1]).before)"
OPEN = "import sys; from workers.jobs.database import open_database; print(open_database(sys.argv[1]).close())"
# Kills its process just before the statement that would be the n-th to change something.
KILLED = """
import itertools, os, signal, sys
from sqlalchemy import Engine, event
from workers.jobs.database import migrate_database
numbers = itertools.count(1)
@event.listens_for(Engine, "before_cursor_execute")
def kill(connection, cursor, statement, *_):
    if not statement.startswith(("SELECT", "PRAGMA", "BEGIN")) and next(numbers) == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)
migrate_database(sys.argv[1])
"""


@pytest.fixture
def old_url(url, make_old_store):
    make_old_store(url)
    return url


@pytest.fixture
def engine_of():
    """Return a function that connects to a store without asking for its version."""
    engines = []

    def connect(url):
        engines.append(create_engine(url.replace("postgresql:", "postgresql+psycopg:")))
        return engines[-1]

    yield connect
    for engine in engines:
        engine.dispose()


@pytest.fixture
def describe(engine_of):
    """Return a function that tells all that a database says of its tables, but for the order of columns."""

    def describe_table(inspector, table):
        columns = [(c["name"], str(c["type"]), c["nullable"], c["default"]) for c in inspector.get_columns(table)]
        checks = [(check["name"], check["sqltext"]) for check in inspector.get_check_constraints(table)]
        foreign = [
            (key["constrained_columns"], key["referred_table"], key["referred_columns"])
            for key in inspector.get_foreign_keys(table)
        ]
        unique = [constraint["column_names"] for constraint in inspector.get_unique_constraints(table)]
        indices = [
            (index["name"], index["column_names"], sorted(map(str, index["dialect_options"].values())))
            for index in inspector.get_indexes(table)
        ]
        key = inspector.get_pk_constraint(table)["constrained_columns"]
        return [key, *map(sorted, (columns, checks, foreign, unique, indices))]

    def run(url):
        inspector = inspect(engine_of(url))
        return {table: describe_table(inspector, table) for table in inspector.get_table_names()}

    return run


@pytest.fixture
def dump(engine_of, describe):
    """Return a function that tells the tables of a database and all their rows."""

    def run(url):
        tables = describe(url)
        with engine_of(url).connect() as connection:
            rows = {table: sorted(map(str, connection.execute(text(f"SELECT * FROM {table}")))) for table in tables}
        return tables, rows

    return run


def choose(option, value):
    """Return the default config of then with one choice."""
    stage, _, name = option.partition(".")
    old = OLD_CONFIGS["default"]
    assert name in old[stage]
    return old | {stage: old[stage] | {name: value}}


def test_the_last_script_makes_the_version_that_the_code_uses():
    config = Config()
    config.set_main_option("script_location", "workers.jobs:migrations")
    scripts = ScriptDirectory.from_config(config)
    assert scripts.get_current_head() == STORE_VERSION
    revisions = [script.revision for script in scripts.walk_revisions()]
    assert revisions == sorted(revisions, reverse=True)  # versions are compared as text


def test_migrated_and_new_stores_are_what_the_code_describes(old_url, new_url, engine_of, describe):
    new, described = new_url(), new_url()
    migrate_database(old_url)
    open_database(new).close()
    metadata.create_all(engine_of(described))
    expected = describe(described)
    assert "TIMED_OUT" in str(expected["jobs"])  # checks are looked at
    assert "lease_ms IS NOT NULL" in str(expected["segments"][-1])  # so are the conditions of indices
    for url in (old_url, new):
        found = describe(url)
        assert found.pop("alembic_version")
        assert found == expected


def test_an_old_store_is_refused_in_one_line_that_says_what_to_run(old_url, dump):
    before = dump(old_url)
    with pytest.raises(InvalidInput) as caught:
        open_database(old_url)
    message = str(caught.value)
    assert (
        "has version 0001, earlier than this motionlabel's 0005: stop what uses it, then run `motionlabel mig"
        in message
    )
    assert "\n" not in message
    assert dump(old_url) == before


def test_jobs_of_an_old_store_are_kept_and_finished(old_url):
    migration = migrate_database(old_url)
    assert (migration.before, migration.is_upgrade) == ("0001", True)
    database = open_database(old_url)
    store, queue = JobStore(database), SegmentQueue(database)
    ended, begun = store.get_job("ended"), store.get_job("begun")
    assert (ended.state, ended.owner, ended.created_at.timestamp()) == (JobState.SUCCEEDED, "", 1)
    assert [entry.segment_id for entry in read_labels(database, "ended").segments] == ["id of a"]
    assert (begun.state, begun.client_job_id, begun.segments[SegmentState.SUCCEEDED]) == (JobState.RUNNING, "night", 1)

    claims = [queue.claim_segment("me", 60), queue.claim_segment("me", 60)]
    assert [(claim.uri, claim.attempt, claim.fence) for claim in claims] == [("c", 2, 2), ("d", 1, 1)]
    for claim in claims:
        entry = SegmentEntry(segment_id=f"id of {claim.uri}", uri=claim.uri, state="SUCCEEDED")
        queue.finish(claim, SegmentState.SUCCEEDED, entry=entry)
    assert [queue.end_job(job) for job in queue.list_finished_jobs()] == [JobState.SUCCEEDED]
    assert [entry.segment_id for entry in read_labels(database, "begun").segments] == ["id of b", "id of c", "id of d"]
    assert store.get_job("ended") == ended
    database.close()


@pytest.fixture
def configs_after(new_url, make_old_store, engine_of):
    """Return a function that migrates jobs "ended" and "begun" of one old config, and tells what theirs then are."""

    def run(config):
        url = new_url()
        make_old_store(url, config)
        migrate_database(url)
        with engine_of(url).connect() as connection:
            return {job.id: job.config for job in connection.execute(select(jobs.c.id, jobs.c.config))}

    return run


@pytest.mark.parametrize("profile", PROFILES)
def test_a_job_that_chose_nothing_goes_on_with_the_config_of_today(configs_after, profile):
    old = OLD_CONFIGS[profile]
    after = configs_after(old)
    assert after["begun"] == resolve_config(profile).model_dump(mode="json")
    assert LabelingConfig.model_validate(after["begun"]) == resolve_config(profile)
    assert after["ended"] == old  # what its manifest says


OLD_CHOICES = [
    ("flow.joins_pieces", False, {"flow.without": ["pieces"]}),
    ("flow.has_backward_net", False, {"flow.without": ["backward_net"]}),
    ("registration.is_constrained", False, {"registration.without": ["upright"]}),
    ("refinement.has_vehicle_completion", False, {"refinement.without": ["completion"]}),
    ("refinement.max_height_m", 1e6, {"refinement.without": ["height_limit"]}),
    ("refinement.max_height_m", 6.0, {"refinement.max_height_m": 6.0}),
    ("joining.rounds", 0, {"joining.without": ["tracks", "strays"]}),
    ("attribution.method", "flow", {"attribution.without": ["tracks"]}),
    ("flow.iterations", 99, {"flow.iterations": 99}),
    ("static.floor_m", 0.1, {"static.noise_factor": 5.0}),
    ("static.resolution_rad", 0.0, {"static.resolution_factor": 0.0}),
    ("decomposition.radius_rad", 0.07, {"decomposition.resolution_factor": 17.5}),
    ("attribution.margin_m", 0.2, {"attribution.noise_factor": 10.0}),
]


@pytest.mark.parametrize(("option", "value", "today"), OLD_CHOICES, ids=[f"{o}={v}" for o, v, _ in OLD_CHOICES])
def test_what_a_user_had_chosen_is_said_in_the_words_of_today(configs_after, option, value, today):
    after = configs_after(choose(option, value))["begun"]
    assert LabelingConfig.model_validate(after) == resolve_config("default", today)


@pytest.mark.parametrize(
    ("option", "value"), [("static.vehicle_radius_m", 2.5), ("flow.start", "zero"), ("flow.prune_about", "centroid")]
)
def test_a_choice_that_nothing_stands_for_today_is_left_to_fail_by_its_name(configs_after, option, value):
    after = configs_after(choose(option, value))["begun"]
    with pytest.raises(ValidationError, match=option.replace(".", r"\.")):
        LabelingConfig.model_validate(after)


def test_a_config_in_the_words_of_today_is_left_alone(configs_after):
    config = resolve_config("default", {"flow.min_vacated_share": 0.0}).model_dump(mode="json")
    assert configs_after(config)["begun"] == config


def test_in_an_old_store_names_become_those_of_their_owners(old_url, engine_of):
    migrate_database(old_url)
    with engine_of(old_url).begin() as connection:
        begun = connection.execute(select(jobs).where(jobs.c.id == "begun")).one()._asdict()
        assert (begun["client_job_id"], begun["owner"]) == ("night", "")
        connection.execute(insert(jobs).values(begun | {"id": "other", "owner": "ann"}))
    with pytest.raises(IntegrityError), engine_of(old_url).begin() as connection:
        connection.execute(update(jobs).values(owner="ann"))


def test_migrating_again_changes_nothing(old_url, dump):
    migrate_database(old_url)
    once = dump(old_url)
    again = migrate_database(old_url)
    assert (again.before, again.is_upgrade) == (STORE_VERSION, False)
    assert dump(old_url) == once


@pytest.mark.parametrize("is_old", [True, False], ids=["old", "empty"])
def test_processes_that_migrate_and_open_at_once_all_succeed(new_url, make_old_store, describe, is_old):
    url, alone = new_url(), new_url()
    for each in (url, alone) if is_old else ():
        make_old_store(each)
    migrate_database(alone)
    codes = [MIGRATE, MIGRATE, MIGRATE if is_old else OPEN]
    commands = [[sys.executable, "-c", code, url] for code in codes]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "cwd": ROOT}
    processes = [subprocess.Popen(command, **pipes) for command in commands]
    answers, errors = zip(*(process.communicate() for process in processes), strict=True)
    assert errors == ("", "", "")
    if is_old:
        assert sorted(answers) == ["0001\n", "0005\n", "0005\n"]  # one migrates, the others find it done
    assert describe(url) == describe(alone)


def test_threads_that_migrate_different_stores_at_once_all_succeed(new_url, make_old_store, describe):
    urls = [new_url() for _ in range(4)]
    for url in urls:
        make_old_store(url)
    threads = [threading.Thread(target=migrate_database, args=(url,)) for url in urls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [describe(url) == describe(urls[0]) for url in urls] == [True] * 4


@pytest.mark.parametrize("is_old", [True, False], ids=["old", "empty"])
def test_a_migration_that_breaks_anywhere_leaves_what_was_there(new_url, make_old_store, dump, is_old):
    url = new_url()
    if is_old:
        make_old_store(url)
    before = dump(url)
    num_left = 0

    def break_down(connection, cursor, statement, *_):
        nonlocal num_left
        if not statement.startswith(("SELECT", "PRAGMA", "BEGIN")):
            num_left -= 1
            if num_left == 0:
                raise RuntimeError(statement)

    event.listen(Engine, "before_cursor_execute", break_down)
    num_statements = 0
    try:
        while True:
            num_statements += 1
            num_left = num_statements
            try:
                migrate_database(url)
            except RuntimeError:
                assert dump(url) == before
            else:
                break
    finally:
        event.remove(Engine, "before_cursor_execute", break_down)
    assert num_statements > 4
    open_database(url).close()


def test_a_migration_killed_half_way_leaves_what_was_there(old_url, dump):
    before = dump(old_url)
    killed = subprocess.run([sys.executable, "-c", KILLED, old_url, "4"], cwd=ROOT, capture_output=True)
    assert killed.returncode == -signal.SIGKILL
    assert dump(old_url) == before
    assert migrate_database(old_url).before == "0001"


def test_a_later_store_is_refused_and_left_alone(url, engine_of, dump):
    open_database(url).close()
    with engine_of(url).begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '0007'"))
    before = dump(url)
    for use in (open_database, migrate_database):
        with pytest.raises(InvalidInput, match=r"version 0007, later than this motionlabel's 0005: use the motionl"):
            use(url)
    assert dump(url) == before


def test_a_motionlabel_from_before_migrations_refuses_the_store(url, engine_of):
    open_database(url).close()
    with engine_of(url).begin() as connection:  # it wants 1 here, and names what it finds
        assert connection.scalar(text("SELECT version FROM schema_version")) == 2


def test_a_database_of_somebody_else_is_named_and_left_alone(url, engine_of, dump):
    with engine_of(url).begin() as connection:
        connection.execute(text("CREATE TABLE jobs (salary INTEGER)"))
    before = dump(url)
    for use in (open_database, migrate_database):
        with pytest.raises(InvalidInput, match=r"^cannot open the job store .*jobs.* already exists"):
            use(url)
    assert dump(url) == before


@pytest.mark.parametrize("table", ["jobs", "segments"])
def test_an_unknown_state_is_refused_by_the_database(old_url, engine_of, table):
    migrate_database(old_url)
    with engine_of(old_url).connect() as connection, pytest.raises(Exception, match="state_known"):
        connection.execute(text(f"UPDATE {table} SET state = 'HALTED'"))
