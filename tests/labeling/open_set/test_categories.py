import pytest

from labeling.exporters.argoverse2 import CATEGORIES
from labeling.open_set.categories import ROAD_USERS, categories_without, known_categories
from labeling.readers.reader import READERS
from schemas.errors import InvalidInput


def test_every_data_set_has_vehicles_and_vulnerable_road_users():
    assert set(READERS) - {"folder"} <= set(ROAD_USERS)  # people annotate no folder of their own
    for kinds in ROAD_USERS.values():
        assert kinds["vehicle"]
        assert kinds["vru"]


@pytest.mark.parametrize("dataset", ROAD_USERS)
def test_a_category_is_of_one_kind(dataset):
    assert len(known_categories(dataset)) == sum(len(names) for names in ROAD_USERS[dataset].values())


def test_argoverse_2_is_there_as_a_whole():
    assert known_categories("av2") == set(CATEGORIES)


def test_people_annotate_the_kind_that_is_not_held_out():
    assert categories_without("wod", "vehicle") == {"PEDESTRIAN", "CYCLIST"}
    assert categories_without("wod", "vru") == {"VEHICLE"}
    assert "Van" in categories_without("kitti_raw", "vru")


def test_unknown_kinds_and_data_sets_are_refused():
    with pytest.raises(InvalidInput, match="--hold-out cars: expected one of vehicle, vru"):
        categories_without("av2", "cars")
    with pytest.raises(InvalidInput, match="not known which categories of mine are vehicles"):
        categories_without("mine", "vru")
    assert known_categories("mine") == frozenset()
