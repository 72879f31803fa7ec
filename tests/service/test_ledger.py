"""The ledger's promise: a segment stands in one record, whoever writes at the same time and wherever one is killed."""

import threading
from contextlib import closing

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from labeling.storage.storage import open_storage
from schemas.errors import InvalidInput
from service.ledger import Ledger

TEMPLATE = {"dataset": "av2", "output_uri": "/out", "profile": "default", "overrides": {}, "priority": 0}


@pytest.fixture(params=["local", "s3"])
def place(request, tmp_path):
    return tmp_path / "out" if request.param == "local" else request.getfixturevalue("bucket") + "/out"


@pytest.fixture
def open_ledger(place):
    """Return a function that opens the ledger as another run does; all are closed at the end."""
    opened = []

    def run(template=TEMPLATE, shard=""):
        ledger = Ledger(open_storage(place), template, shard)
        opened.append(ledger)
        ledger.prepare()
        return ledger

    yield run
    for ledger in opened:
        ledger.close()


def segments_of(batches):
    return [batch.record.segments for batch in batches]


def test_what_one_run_claimed_the_next_one_finds_under_the_same_names(open_ledger):
    ledger = open_ledger()
    claimed = [*ledger.claim(["a", "b"]), *ledger.claim(["c", "b", "c"])]
    assert segments_of(claimed) == [["a", "b"], ["c"]]
    assert claimed[0].record.request["client_job_id"] != claimed[1].record.request["client_job_id"]
    assert claimed[0].record.request.items() >= TEMPLATE.items()
    later = open_ledger()
    assert later.read_new() == claimed
    assert all(name in later for name in "abc")
    assert "d" not in later
    assert later.read_new() == later.claim(["a"]) == []


def test_what_is_done_is_known_and_not_asked_for_again(open_ledger):
    first = open_ledger()
    (batch,), (other,) = first.claim(["a", "b"]), first.claim(["c"])
    first.mark_done(batch)
    first.mark_done(batch)
    later = open_ledger()
    assert later.read_new() == [other]
    assert later.num_done == 2
    assert later.claim(["a", "c"]) == []


def test_what_is_asked_of_a_segment_decides_whose_records_they_are_and_not_how_soon(open_ledger):
    open_ledger().claim(["a"])
    assert segments_of(open_ledger(TEMPLATE | {"priority": 5}).read_new()) == [["a"]]
    for change in ({"dataset": "kitti_raw"}, {"output_uri": "/out2"}, {"overrides": {"flow.iterations": 3}}):
        other = open_ledger(TEMPLATE | change)
        assert other.read_new() == []
        assert segments_of(other.claim(["a"])) == [["a"]]


def test_a_share_sees_only_its_own_through_and_all_know_of_all(open_ledger):
    for shard in ("1/2", "2/2", ""):
        open_ledger(shard=shard).claim([f"of {shard}"])
    second = open_ledger(shard="2/2")
    assert segments_of(second.read_new()) == [["of 2/2"]]
    assert "of 1/2" in second
    assert len(open_ledger().read_new()) == 3


def test_a_run_that_is_behind_sees_through_what_others_put_meanwhile(open_ledger):
    """For whoever put it may be dead by now."""
    slow, quick = open_ledger(), open_ledger()
    (theirs,) = quick.claim(["a", "b"])
    assert segments_of(slow.claim(["b", "c"])) == [["a", "b"], ["c"]]
    assert slow.is_new("c")
    assert not slow.is_new("a")
    assert quick.read_new()[0].record.segments == ["c"]
    quick.mark_done(theirs)


def test_an_answer_that_was_lost_loses_no_segment(open_ledger, place, monkeypatch):
    """A bucket may have taken what it is asked to put once more: then the first try looks like another run's."""
    ledger = open_ledger()
    publish = type(ledger._storage).publish

    def put_twice(storage, path, content):
        publish(storage, path, content)
        return publish(storage, path, content)

    monkeypatch.setattr(type(ledger._storage), "publish", put_twice)
    assert segments_of(ledger.claim(["a", "b"])) == [["a", "b"]]


def test_of_many_runs_at_once_each_segment_is_claimed_by_one(place, open_ledger):
    names = [f"s{k}" for k in range(40)]
    barrier = threading.Barrier(4)

    def run(offset):
        with closing(Ledger(open_storage(place), TEMPLATE)) as ledger:
            barrier.wait()
            for start in range(0, 40, 5):
                ledger.claim(names[(start + offset) % 40 :][:5])

    open_ledger()
    threads = [threading.Thread(target=run, args=(offset,)) for offset in (0, 3, 5, 20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    recorded = [name for segments in segments_of(open_ledger().read_new()) for name in segments]
    assert sorted(recorded) == sorted(names)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 2), st.sets(st.integers(0, 9), min_size=1)), max_size=12))
def test_runs_that_take_turns_claim_each_segment_once(tmp_path_factory, turns):
    storage = open_storage(tmp_path_factory.mktemp("out"))
    ledgers = [Ledger(storage, TEMPLATE) for _ in range(3)]
    ledgers[0].prepare()
    for turn, numbers in turns:
        ledgers[turn].claim([str(number) for number in sorted(numbers)])
    for ledger in ledgers:
        ledger.close()
    with closing(Ledger(storage, TEMPLATE)) as later:
        recorded = [name for segments in segments_of(later.read_new()) for name in segments]
    assert sorted(recorded) == sorted({str(number) for _, numbers in turns for number in numbers})


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"shard": ""}', b"\xff"])
def test_what_is_no_record_is_told(open_ledger, place, content):
    ledger = open_ledger()
    ledger._storage.publish(ledger._path(0, "json"), content)
    with pytest.raises(InvalidInput, match=r"backfill/[0-9a-f]{16}/00000000.json is no record of a backfill"):
        ledger.read_new()


def test_records_that_cannot_be_put_are_told_before_any(tmp_path):
    (tmp_path / "out").write_text("a file")
    ledger = Ledger(open_storage(tmp_path / "out"), TEMPLATE)
    with closing(ledger), pytest.raises(InvalidInput, match="choose another --output"):
        ledger.prepare()
