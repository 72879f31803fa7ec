import numpy as np
import pyarrow.parquet as pq
import pytest
from shapely import affinity
from shapely import box as box_of

from labeling.geometry.boxes import transform_boxes
from labeling.open_set.merging import merge_labels
from labeling.open_set.rule import MergeRule, hold_out_rule
from schemas.errors import InvalidInput, ShardConflict
from schemas.tables import merged

CARS = MergeRule(frozenset({"REGULAR_VEHICLE"}))
WALKER_BOX = [5.0, -3.0, 0.9, 0.7, 0.6, 1.8, 0.0]


@pytest.fixture
def merge(tmp_path):
    """Return a function that merges a folder of one segment with its recording and reads the table."""

    def run(folder, reader, rule=CARS, output="merged", **options):
        summary = merge_labels(folder, reader.dataset, [reader.uri], tmp_path / output, rule, **options)
        (path,) = (tmp_path / output).iterdir()
        assert path.name == f"{reader.segment_id}.parquet"
        return summary, pq.read_table(path)

    return run


def of(table, provenance):
    return [row for row in table.to_pylist() if row["provenance"] == provenance]


def boxes_of(rows):
    return np.array([[row[name] for name in merged.BOX] for row in rows]).reshape(-1, 7)


def rectangle(box):
    x, y, _, length, width, _, yaw = box
    flat = box_of(-length / 2, -width / 2, length / 2, width / 2)
    return affinity.translate(affinity.rotate(flat, yaw, use_radians=True), x, y)


def largest_share(one, others):
    return max((one.intersection(other).area / min(one.area, other.area) for other in others), default=0.0)


def test_a_track_on_a_human_one_goes_and_all_else_stays(merge, make_labels, make_driven, walker, recorded, car):
    folder = make_labels([make_driven(), walker])
    reader = recorded([[("A", "REGULAR_VEHICLE", car.box_ego)]] * 3)
    summary, table = merge(folder, reader)
    assert [(row["sweep_index"], row["track_id"]) for row in of(table, "human")] == [(0, "A"), (1, "A"), (2, "A")]
    assert [(row["sweep_index"], row["track_id"]) for row in of(table, "auto")] == [(1, str(walker.track_id))]
    assert (summary.human, summary.num_auto_boxes, summary.num_auto_tracks) == ({"REGULAR_VEHICLE": 3}, 1, 1)
    assert (summary.num_dropped_boxes, summary.num_dropped_tracks, summary.num_dropped_apart) == (3, 1, 0)


def test_categories_that_nobody_annotates_come_from_auto_labels(merge, make_labels, make_driven, walker, recorded, car):
    """The walker is annotated too, but with people for vehicles only it counts as unknown."""
    folder = make_labels([make_driven(), walker])
    boxes = [("A", "REGULAR_VEHICLE", car.box_ego), ("W", "PEDESTRIAN", WALKER_BOX)]
    _, table = merge(folder, recorded([boxes] * 3))
    assert {row["category"] for row in of(table, "human")} == {"REGULAR_VEHICLE"}
    assert {row["track_id"] for row in of(table, "auto")} == {str(walker.track_id)}


def test_what_is_written_of_either(merge, make_labels, make_driven, walker, recorded, make_sweep, car):
    folder = make_labels([make_driven(), walker])
    _, table = merge(folder, recorded([[("A", "REGULAR_VEHICLE", car.box_ego)]] * 3))
    assert table.schema.remove_metadata() == merged.SCHEMA
    people, auto = of(table, "human"), of(table, "auto")
    places = [transform_boxes(make_sweep(index).world_from_ego, car.box_ego[None])[0] for index in range(3)]
    np.testing.assert_allclose(boxes_of(people), places, atol=1e-6)
    unknown = ["velocity_x_mps", "velocity_y_mps", "velocity_z_mps", "num_points", "box_source", "human_overlap"]
    assert all(row[name] is None for row in people for name in unknown)
    assert {row["score"] for row in people} == {1.0}
    assert people[1]["timestamp_ns"] == make_sweep(1).timestamp_ns
    np.testing.assert_allclose(boxes_of(auto), walker.boxes, atol=1e-6)
    assert (auto[0]["category"], auto[0]["num_points"], auto[0]["box_source"]) == (None, 321, "observed")
    assert auto[0]["score"] == pytest.approx(0.6)
    assert auto[0]["human_overlap"] == 0
    assert auto[0]["velocity_y_mps"] == pytest.approx(8.0)


@pytest.mark.parametrize(("num_on", "is_dropped"), [(0, False), (1, False), (2, False), (3, True), (4, True)])
def test_tracks_stay_or_go_as_a_whole(
    merge, make_labels, make_driven, make_sweep, recorded, car, moved, num_on, is_dropped
):
    sweeps = [make_sweep(index) for index in range(4)]
    folder = make_labels([make_driven(sweeps=range(4))], sweeps=sweeps)
    reader = recorded([[("A", "REGULAR_VEHICLE", moved(0.0 if index < num_on else 2.0))] for index in range(4)])
    summary, table = merge(folder, reader)
    assert len(of(table, "auto")) == (0 if is_dropped else 4)
    assert summary.num_dropped_apart == (4 - num_on if is_dropped else 0)
    if not is_dropped:  # boxes that overlap can be told
        overlap = [row["human_overlap"] for row in of(table, "auto")]
        assert overlap == pytest.approx([1.0] * num_on + [0.0] * (4 - num_on), abs=1e-6)


def test_how_much_overlap_and_how_many_boxes_are_asked_for(merge, make_labels, make_driven, recorded, moved):
    folder = make_labels([make_driven()])
    reader = recorded([[("A", "REGULAR_VEHICLE", moved(left_m))] for left_m in (1.35, 0.9, 0.0)])  # 0.25, 0.5, 1

    def is_kept(output, **shares):
        return bool(of(merge(folder, reader, MergeRule(CARS.human, **shares), output)[1], "auto"))

    assert not is_kept("a")
    assert is_kept("b", min_overlap=0.6)
    assert is_kept("c", max_share=0.7)
    assert not is_kept("d", max_share=0.0, min_overlap=1e-3)


def test_a_part_of_an_object_is_that_object(merge, make_labels, make_driven, recorded):
    """The cab of a lorry lies within its box: an IoU of a sixth, all of the smaller one."""
    lorry, cab = [20.0, 0, 2, 15.0, 2.5, 3.5, 0.0], [26.0, 0, 2, 2.5, 2.5, 3.0, 0.0]
    folder = make_labels([make_driven(box_ego=cab)])
    assert not of(merge(folder, recorded([[("A", "REGULAR_VEHICLE", lorry)]] * 3))[1], "auto")


def test_what_is_above_does_not_overlap(merge, make_labels, make_driven, recorded, car):
    bridge = [*car.box_ego[:2], 8.0, *car.box_ego[3:]]
    _, table = merge(make_labels([make_driven()]), recorded([[("A", "REGULAR_VEHICLE", bridge)]] * 3))
    assert [row["human_overlap"] for row in of(table, "auto")] == [0, 0, 0]


def test_sweeps_that_nobody_annotated_say_nothing(merge, make_labels, make_driven, walker, recorded, car):
    folder = make_labels([make_driven(), walker])
    summary, table = merge(folder, recorded([[("A", "REGULAR_VEHICLE", car.box_ego)], None, None]))
    assert summary.num_dropped_tracks == 1  # by the one sweep that counts
    assert [row["human_overlap"] for row in of(table, "auto")] == [None]


def test_an_annotated_sweep_may_hold_nothing(merge, make_labels, make_driven, recorded):
    summary, table = merge(make_labels([make_driven()]), recorded([[], [], []]))
    assert [row["human_overlap"] for row in of(table, "auto")] == [0, 0, 0]
    assert summary.human == {"REGULAR_VEHICLE": 0}


def test_auto_tracks_are_taken_whole_by_their_mean_score(merge, make_labels, doubtful, walker, recorded):
    folder, reader = make_labels([walker, doubtful]), recorded([[]] * 3)
    assert {row["track_id"] for row in of(merge(folder, reader)[1], "auto")} == {str(walker.track_id)}
    everything = merge(folder, reader, output="all", min_score=0.0)[1]
    assert {row["track_id"] for row in of(everything, "auto")} == {str(walker.track_id), str(doubtful.track_id)}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("hold_out", ["vehicle", "vru"])
def test_no_human_box_is_lost_and_no_track_that_overlaps_none(
    merge, make_labels, make_driven, make_sweep, recorded, hold_out, seed
):
    rng = np.random.default_rng(seed)

    def draw():
        return [*rng.uniform(-15, 15, 2), 1.0, *rng.uniform(0.5, 5, 3), rng.uniform(-3, 3)]

    names = ["REGULAR_VEHICLE", "BUS", "PEDESTRIAN", "BICYCLIST", "BOLLARD"]
    stands = [(f"{name}-{n}", name, draw()) for name in names for n in range(3)]  # some do, in some of the sweeps
    drawn = [[known if rng.random() < 0.6 else (*known[:2], draw()) for known in stands] for _ in range(5)]
    autos = {f"auto-{n:02}": stands[n][2] if n % 3 else draw() for n in range(15)}
    tracks = [make_driven(track_id, range(5), box_ego=box) for track_id, box in autos.items()]
    folder = make_labels(tracks, sweeps=[make_sweep(index) for index in range(5)])
    rule = hold_out_rule("av2", hold_out)
    summary, table = merge(folder, recorded(drawn), rule)

    kinds = {"vehicle": {"PEDESTRIAN", "BICYCLIST"}, "vru": {"REGULAR_VEHICLE", "BUS"}}[hold_out]
    wanted = {(index, name) for index, boxes in enumerate(drawn) for name, category, _ in boxes if category in kinds}
    assert {(row["sweep_index"], row["track_id"]) for row in of(table, "human")} == wanted
    assert sum(summary.human.values()) == len(wanted) == len(of(table, "human"))

    people = [[rectangle(box) for _, category, box in boxes if category in kinds] for boxes in drawn]
    shares = {track_id: [largest_share(rectangle(box), seen) for seen in people] for track_id, box in autos.items()}
    wanted_tracks = {track_id for track_id, found in shares.items() if sum(share >= 0.3 for share in found) <= 2}
    assert 0 < len(wanted_tracks) < 15
    kept = of(table, "auto")
    assert [(row["sweep_index"], row["track_id"]) for row in kept] == [
        (index, track_id) for index in range(5) for track_id in sorted(wanted_tracks)
    ]
    for row in kept:
        assert row["human_overlap"] == pytest.approx(shares[row["track_id"]][row["sweep_index"]], abs=1e-5)
    everything = merge(folder, recorded([[]] * 5), rule, "nobody")[1]  # with nobody's boxes nothing goes
    assert len(of(everything, "auto")) == 75


def test_the_order_of_annotations_makes_no_difference(
    merge, make_labels, make_driven, walker, recorded, tmp_path, contents, car
):
    folder = make_labels([make_driven(), walker])
    boxes = [("B", "REGULAR_VEHICLE", WALKER_BOX), ("A", "REGULAR_VEHICLE", car.box_ego)]
    merge(folder, recorded([boxes] * 3), output="one")
    merge(folder, recorded([boxes[::-1]] * 3), output="two")
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_merging_again_writes_nothing_and_replaces_nothing(merge, make_labels, make_driven, recorded, moved):
    folder, reader = make_labels([make_driven()]), recorded([[("A", "REGULAR_VEHICLE", moved(3))]] * 3)
    merge(folder, reader)
    summary, _ = merge(folder, reader)
    assert (summary.num_written, summary.num_kept) == (0, 1)
    with pytest.raises(ShardConflict, match="is there with other content"):
        merge(folder, reader, MergeRule(frozenset({"BUS"})))


def test_boxes_in_rejected_sweeps_are_counted(merge, make_labels, make_driven, make_sweep, recorded, car):
    sweeps = [make_sweep(0), make_sweep(1, reason="truncated"), make_sweep(2)]
    folder = make_labels([make_driven(sweeps=[0, 2])], sweeps=sweeps)
    reader = recorded([[("A", "REGULAR_VEHICLE", car.box_ego)]] * 3)
    summary, table = merge(folder, reader)
    assert summary.unplaced == {reader.segment_id: 1}
    assert [row["sweep_index"] for row in of(table, "human")] == [0, 2]


def test_any_category_that_is_there_can_be_named(merge, make_labels, make_driven, recorded, car):
    reader = recorded([[("A", "HANDCART", car.box_ego)]] * 3)
    assert merge(make_labels([make_driven()]), reader, MergeRule(frozenset({"HANDCART"})))[0].human == {"HANDCART": 3}


def test_what_does_not_fit_is_refused_before_anything_is_written(
    merge, make_labels, make_driven, recorded, car, tmp_path
):
    folder = make_labels([make_driven()])
    boxes = [[("A", "HANDCART", car.box_ego)]] * 3

    def refuse(message, rule, sweeps, *, uris=("/data/log",), dataset="av2", late_ns=0):
        for uri in uris:
            reader = recorded(sweeps, uri=uri)
            reader.timestamps_ns = reader.timestamps_ns + late_ns
        with pytest.raises(InvalidInput, match=message):
            merge_labels(folder, dataset, uris, tmp_path / "x", rule)

    refuse("has no annotations in the sweeps that were labelled", CARS, [None] * 3)
    refuse("--human VAN: no such category: these segments have HANDCART", MergeRule(frozenset({"VAN"})), boxes)
    refuse("sweep 0 has boxes of category HANDCART, and whether that is a vehicle", hold_out_rule("av2", "vru"), boxes)
    refuse("sweep 0 is not the one that was labelled: has the recording changed", CARS, boxes, late_ns=1)
    refuse("sweep 1 is not the one that was labelled", CARS, boxes[:1])
    refuse("holds no labels of segment other-", CARS, boxes, uris=["/data/other"])
    refuse("segment /data/log/ is named twice", CARS, boxes, uris=["/data/log", "/data/log/"])
    refuse("unknown dataset 'csv'", CARS, boxes, dataset="csv")
    assert not list((tmp_path / "x").rglob("*.parquet"))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"human": frozenset()}, "--human: expected one or more categories"),
        ({"human": frozenset({""})}, "--human: expected one or more categories"),
        ({"min_overlap": 0.0}, "--min-overlap 0: expected a share above 0 and up to 1"),
        ({"min_overlap": float("nan")}, "--min-overlap nan: expected"),
        ({"max_share": 1.0}, "--max-share 1: expected a share from 0 to below 1"),
    ],
)
def test_rules_out_of_range_are_refused(values, message):
    with pytest.raises(InvalidInput, match=f"^{message}"):
        MergeRule(**{"human": frozenset({"BUS"}), **values})
