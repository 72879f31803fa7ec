"""What the data sets call vehicles, and what vulnerable road users."""

from collections.abc import Mapping
from typing import Final, Literal

from schemas.errors import InvalidInput

RoadUser = Literal["vehicle", "vru", "other"]  # other: neither, a cone or a dog

# As the scene flow challenge of Argoverse 2 groups them: two wheels are vulnerable, ridden or not.
_ARGOVERSE2: Final[Mapping[RoadUser, tuple[str, ...]]] = {
    "vehicle": (
        "ARTICULATED_BUS", "BOX_TRUCK", "BUS", "LARGE_VEHICLE", "RAILED_VEHICLE", "REGULAR_VEHICLE", "SCHOOL_BUS",
        "TRUCK", "TRUCK_CAB", "VEHICULAR_TRAILER",
    ),
    "vru": (
        "BICYCLE", "BICYCLIST", "MOTORCYCLE", "MOTORCYCLIST", "OFFICIAL_SIGNALER", "PEDESTRIAN", "STROLLER",
        "WHEELCHAIR", "WHEELED_DEVICE", "WHEELED_RIDER",
    ),
    "other": (
        "ANIMAL", "BOLLARD", "CONSTRUCTION_BARREL", "CONSTRUCTION_CONE", "DOG", "MESSAGE_BOARD_TRAILER",
        "MOBILE_PEDESTRIAN_CROSSING_SIGN", "SIGN", "STOP_SIGN", "TRAFFIC_LIGHT_TRAILER",
    ),
}  # fmt: skip
_NUSCENES: Final[Mapping[RoadUser, tuple[str, ...]]] = {
    "vehicle": (
        "vehicle.bus.bendy", "vehicle.bus.rigid", "vehicle.car", "vehicle.construction", "vehicle.emergency.ambulance",
        "vehicle.emergency.police", "vehicle.trailer", "vehicle.truck",
    ),
    "vru": (
        "human.pedestrian.adult", "human.pedestrian.child", "human.pedestrian.construction_worker",
        "human.pedestrian.personal_mobility", "human.pedestrian.police_officer", "human.pedestrian.stroller",
        "human.pedestrian.wheelchair", "vehicle.bicycle", "vehicle.motorcycle",
    ),
    "other": (
        "animal", "movable_object.barrier", "movable_object.debris", "movable_object.pushable_pullable",
        "movable_object.trafficcone", "static_object.bicycle_rack",
    ),
}  # fmt: skip
ROAD_USERS: Final[Mapping[str, Mapping[RoadUser, tuple[str, ...]]]] = {
    "av2": _ARGOVERSE2,
    "kitti_raw": {
        "vehicle": ("Car", "Van", "Truck", "Tram"),
        "vru": ("Pedestrian", "Person (sitting)", "Cyclist"),
        "other": ("Misc",),
    },
    "nuscenes": _NUSCENES,
    "synthetic": _ARGOVERSE2,
    "wod": {"vehicle": ("VEHICLE",), "vru": ("PEDESTRIAN", "CYCLIST"), "other": ("SIGN", "UNKNOWN")},
}
_OTHER_KIND: Final[Mapping[str, RoadUser]] = {"vehicle": "vru", "vru": "vehicle"}


def known_categories(dataset: str) -> frozenset[str]:
    """Return all categories that a data set is known to have."""
    return frozenset(name for names in ROAD_USERS.get(dataset, {}).values() for name in names)


def categories_without(dataset: str, hold_out: str) -> frozenset[str]:
    """Return what people annotate when one kind of road user is held out: the categories of the other kind.

    Raises:
        InvalidInput: No such kind, or it is not known what the data set calls it.

    """
    if hold_out not in _OTHER_KIND:
        raise InvalidInput(f"--hold-out {hold_out}: expected one of {', '.join(_OTHER_KIND)}")
    if dataset not in ROAD_USERS:
        raise InvalidInput(
            f"--hold-out {hold_out}: it is not known which categories of {dataset} are vehicles: name those to keep "
            "with --human"
        )
    return frozenset(ROAD_USERS[dataset][_OTHER_KIND[hold_out]])
