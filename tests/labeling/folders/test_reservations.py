"""One set of labels a segment, whoever writes, in whatever order, and wherever it dies."""

import dataclasses
import itertools
import json
import threading

import pytest
from obstore.store import MemoryStore

from labeling.folders import writer
from labeling.folders.entries import find_published, prepare_folder
from labeling.folders.identity import LABEL_VERSION, LabelSet
from labeling.folders.reservations import is_reserved, reserve_older, reserved_identity
from labeling.folders.writer import publish_files
from labeling.storage.bucket import ObjectStorage
from labeling.storage.local import LocalStorage
from schemas.config import LabelingConfig, resolve_config
from schemas.errors import InvalidInput, ShardConflict, StorageTrouble


def label_set(**overrides):
    return LabelSet("av2", "log-1", "00", resolve_config(overrides=overrides))


PLAIN = label_set()
OTHER = label_set(**{"flow.iterations": 61})
POINTS = label_set(write_points=True)
OTHER_POINTS = label_set(**{"write_points": True, "attribution.without": "tracks"})
ALL = [PLAIN, OTHER, POINTS, OTHER_POINTS]


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """A function that gives the files of a label set, each written once."""
    written = {}
    folder = tmp_path_factory.mktemp("files")

    def files_of(wanted):
        if wanted not in written:
            place = folder / str(len(written))
            place.mkdir()
            written[wanted] = writer._write_tables(place, wanted, [], [])
        return written[wanted]

    for each in ALL:
        files_of(each)
    return files_of


@pytest.fixture(params=["local", "object"])
def storage(request, tmp_path):
    storage = LocalStorage(str(tmp_path)) if request.param == "local" else ObjectStorage("s3://b", MemoryStore())
    prepare_folder(storage, LabelingConfig(write_points=True))
    return storage


class Shelf:
    """A storage in memory. ``before`` is called before each step, which then happens at once."""

    root = "shelf"

    def __init__(self, contents, before=lambda: None):
        self._contents, self._before = contents, before

    def publish(self, path, source):
        self._before()
        if path in self._contents:
            return False
        self._contents[path] = source if isinstance(source, bytes) else source.read_bytes()
        return True

    def read(self, path):
        self._before()
        if path not in self._contents:
            raise FileNotFoundError(path)
        return self._contents[path]

    def size(self, path):
        self._before()
        return len(self._contents[path]) if path in self._contents else None

    def list_files(self, folder):
        self._before()
        return tuple(sorted(path for path in self._contents if path.startswith(f"{folder}/")))


class Died(BaseException):
    """Ends a writer wherever it is."""


class Actor:
    """A writer in a thread of its own that does one step of its storage when told to, or dies instead."""

    def __init__(self, wanted, files, contents):
        self._turn, self._idle = threading.Semaphore(0), threading.Semaphore(0)
        self._dies = self.is_over = False
        self.outcome = None
        self._work = lambda: publish_files(Shelf(contents, self._wait), wanted, files(wanted))
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self._idle.acquire()

    def go_on(self, *, dies=False):
        self._dies = dies
        self._turn.release()
        self._idle.acquire()
        if self.is_over:
            self._thread.join()

    def _wait(self):
        self._idle.release()
        self._turn.acquire()
        if self._dies:
            raise Died

    def _run(self):
        try:
            self.outcome = self._work()
        except (Died, ShardConflict) as error:
            self.outcome = error
        self.is_over = True
        self._idle.release()


def play(prefix, wanted, files, max_switches):
    """Let two writers run, by the choices of ``prefix`` and then the first possible; return what else could have been.

    A choice is (writer, dies). At most one dies; a writer that could go on is left at most ``max_switches`` times.
    """
    contents, prefixes = {}, []
    actors = [Actor(each, files, contents) for each in wanted]
    chosen, last, switches = [], None, 0
    while not all(actor.is_over for actor in actors):
        running = [number for number, actor in enumerate(actors) if not actor.is_over]
        if last in running and switches == max_switches:
            running = [last]
        running.sort(key=lambda number: number != last)
        may_die = not any(dies for _, dies in chosen)
        choices = [(number, dies) for dies in ((False, True) if may_die else (False,)) for number in running]
        step = len(chosen)
        choice = prefix[step] if step < len(prefix) else choices[0]
        if step >= len(prefix):
            prefixes += [[*chosen, other] for other in choices[1:]]
        number, dies = choice
        switches += last not in (None, number) and not actors[last].is_over
        actors[number].go_on(dies=dies)
        chosen.append(choice)
        last = number
    return contents, [actor.outcome for actor in actors], prefixes


def every_play(wanted, files, max_switches):
    waiting = [[]]
    while waiting:
        contents, outcomes, others = play(waiting.pop(), wanted, files, max_switches)
        waiting += others
        yield contents, outcomes


def identities(contents, *tables):
    return {path[-len("0123456789abcdef.parquet") :] for path in contents if path.split("/")[0] in tables}


@pytest.mark.parametrize(
    ("first", "second", "max_switches"),
    [
        pytest.param(PLAIN, OTHER, 99, id="other settings"),
        pytest.param(PLAIN, PLAIN, 99, id="equal"),
        pytest.param(POINTS, OTHER_POINTS, 2, id="other points"),
        pytest.param(POINTS, OTHER, 2, id="other settings and points"),
        pytest.param(POINTS, PLAIN, 2, id="points and none"),
    ],
)
def test_two_writers_in_any_order_and_dying_anywhere_leave_one_set(first, second, max_switches, files):
    num_plays = 0
    for contents, outcomes in every_play([first, second], files, max_switches):
        num_plays += 1
        assert len(identities(contents, "labels", "sweeps")) <= 1
        assert len(identities(contents, "points")) <= 1
        is_dead = [isinstance(outcome, Died) for outcome in outcomes]
        conflicts = [isinstance(outcome, ShardConflict) for outcome in outcomes]
        if {first, second} <= {PLAIN, POINTS}:
            assert conflicts == [False, False]
        elif not any(is_dead):
            assert sorted(conflicts) == [False, True]  # one, and not both
        for wanted, outcome in zip((first, second), outcomes, strict=True):
            if isinstance(outcome, tuple):
                assert [shard.path for shard in outcome] == list(wanted.paths.values())
                assert contents.keys() >= set(wanted.paths.values())
        shelf = Shelf(contents)
        again = []
        for wanted in (first, second):
            try:
                again.append(publish_files(shelf, wanted, files(wanted)))
            except ShardConflict:
                again.append(None)
        assert any(again)  # whoever came first can always go on
        assert all(b for a, b in zip(outcomes, again, strict=True) if isinstance(a, tuple))
        assert len(identities(contents, "labels", "sweeps")) == 1
        assert len(identities(contents, "points")) <= 1
    assert num_plays > 100


def test_the_first_set_stays_and_others_are_told_what_is_different(storage, files):
    publish_files(storage, POINTS, files(POINTS))
    sweeps = dataclasses.replace(PLAIN, content="01")
    version = dataclasses.replace(PLAIN, label_version=LABEL_VERSION + 1)
    for other, message in [
        (OTHER, r"already holds labels of log-1 made with other settings \(flow.iterations=60, here 61\)"),
        (
            OTHER_POINTS,
            r"already holds points of log-1 made with other settings \(attribution.without=\[\], here \['tracks'\]\)",
        ),
        (sweeps, r"made from other sweeps \(the recording has changed since\)"),
        (version, rf"made with other code \(label version {LABEL_VERSION}, here {LABEL_VERSION + 1}\)"),
        (dataclasses.replace(PLAIN, dataset="folder"), "made as dataset av2, here folder"),
    ]:
        for act in (
            lambda other: publish_files(storage, other, files(PLAIN)),
            lambda other: find_published(storage, other, ""),
        ):
            with pytest.raises(ShardConflict, match=message) as caught:
                act(other)
            assert f"delete the old labels, {storage.root}/*/log-1-*" in str(caught.value)
            assert "\n" not in str(caught.value)


def test_old_labels_can_be_deleted_as_the_message_says(tmp_path, files):
    storage = LocalStorage(str(tmp_path))
    prepare_folder(storage, POINTS.config)
    publish_files(storage, POINTS, files(POINTS))
    neighbour = dataclasses.replace(PLAIN, segment_id="log-10")
    publish_files(storage, neighbour, files(PLAIN))
    for path in tmp_path.glob("*/log-1-*"):
        path.unlink()
    assert find_published(storage, OTHER, "") is None
    publish_files(storage, OTHER, files(OTHER))
    assert find_published(storage, OTHER, "").segment_id == "log-1"
    assert find_published(storage, neighbour, "").segment_id == "log-10"


def test_a_reservation_without_labels_says_how_to_get_rid_of_it(storage, files):
    def die():
        raise Died

    contents = {}
    steps = itertools.count()
    with pytest.raises(Died):
        publish_files(Shelf(contents, lambda: die() if next(steps) == 2 else None), PLAIN, files(PLAIN))
    (path,) = contents
    storage.publish(path, contents[path])
    assert path == "reservations/log-1-labels.json"
    with pytest.raises(ShardConflict, match=rf"holds none so far: .* then delete {storage.root}/{path}"):
        find_published(storage, OTHER, "")
    assert find_published(storage, PLAIN, "") is None
    publish_files(storage, PLAIN, files(PLAIN))
    assert find_published(storage, PLAIN, "").segment_id == "log-1"


def test_points_can_be_added_later(storage, files):
    publish_files(storage, PLAIN, files(PLAIN))
    assert find_published(storage, POINTS, "") is None
    publish_files(storage, POINTS, files(POINTS))
    assert [shard.table for shard in find_published(storage, POINTS, "").shards] == ["labels", "sweeps", "points"]
    assert [shard.table for shard in find_published(storage, PLAIN, "").shards] == ["labels", "sweeps"]


@pytest.mark.parametrize("missing", ["labels", "sweeps", "points"])
def test_what_is_missing_is_published_again(storage, files, missing):
    contents = {}
    publish_files(Shelf(contents), POINTS, files(POINTS))
    for path, content in contents.items():
        if not path.startswith(f"{missing}/"):
            storage.publish(path, content)
    assert find_published(storage, POINTS, "") is None
    publish_files(storage, POINTS, files(POINTS))
    assert len(find_published(storage, POINTS, "").shards) == 3


def test_looking_costs_the_same_however_full_the_folder_is(files):
    contents = {f"labels/log-{k}-0123456789abcdef.parquet": b"" for k in range(2, 2000)}
    steps = []
    shelf = Shelf(contents, lambda: steps.append(1))
    assert find_published(shelf, PLAIN, "") is None
    assert len(steps) == 1
    publish_files(shelf, PLAIN, files(PLAIN))
    assert len(steps) == 5  # looked, reserved and published labels and sweeps


def test_shards_from_before_there_were_reservations_are_respected(files):
    """Wherever taking note of them ends, it is done again."""
    older = {
        "labels/log-1-aaaaaaaaaaaaaaaa.parquet": b"",
        "sweeps/log-1-aaaaaaaaaaaaaaaa.parquet": b"",
        "points/log-1-aaaaaaaaaaaaaaaa.parquet": b"",
        "labels/log-2-x-bbbbbbbbbbbbbbbb.parquet": b"",
    }
    for end in range(20):
        contents = dict(older)
        steps = itertools.count()

        def stop(steps=steps, end=end):
            if next(steps) == end:
                raise Died

        try:
            reserve_older(Shelf(contents, stop))
        except Died:
            reserve_older(Shelf(contents))
        else:
            break
        shelf = Shelf(contents)
        assert reserved_identity(shelf, "log-1", "labels") == reserved_identity(shelf, "log-1", "points") == "a" * 16
        assert reserved_identity(shelf, "log-2-x", "labels") == "b" * 16
        assert reserved_identity(shelf, "log-2-x", "points") is None
        with pytest.raises(ShardConflict, match="already holds labels of log-1 made by an older motionlabel"):
            is_reserved(shelf, PLAIN)
    assert end == 7


def test_a_folder_is_looked_through_for_older_shards_once(storage, files):
    publish_files(storage, PLAIN, files(PLAIN))
    storage.publish("labels/log-2-aaaaaaaaaaaaaaaa.parquet", b"")
    prepare_folder(storage, LabelingConfig())
    assert reserved_identity(storage, "log-2", "labels") is None


def test_a_reservation_that_vanishes_meanwhile_is_trouble_to_come_back_from(files):
    class Forgetful(Shelf):
        def publish(self, path, source):
            super().publish(path, source)
            self._contents.pop(path)
            return False

    contents = {}
    with pytest.raises(StorageTrouble, match=r"shelf/reservations/log-1-labels.json was deleted while"):
        publish_files(Forgetful(contents), PLAIN, files(PLAIN))
    assert contents == {}


def test_what_is_no_reservation_is_named(storage):
    storage.publish("reservations/log-1-labels.json", b"{}")
    with pytest.raises(InvalidInput, match=f"{storage.root}/reservations/log-1-labels.json is not a reservation"):
        is_reserved(storage, PLAIN)


def test_a_reservation_says_what_it_is_for(storage, files):
    publish_files(storage, POINTS, files(POINTS))
    for table in ("labels", "points"):
        said = json.loads(storage.read(f"reservations/log-1-{table}.json"))
        assert said["identity"] == POINTS.identity(table)
        assert said["config"] == POINTS.config.deciding(table)
        assert (said["label_version"], said["content"], said["dataset"]) == (LABEL_VERSION, "00", "av2")
