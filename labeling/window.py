"""The sweeps around the current one: each read once, judged once, dropped when out of reach."""

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from labeling.evidence.lidars import lidars_of
from labeling.evidence.neighborhood import Neighborhood
from labeling.evidence.places import GroundedSweep
from labeling.evidence.vehicle import VehicleBody, find_vehicle, points_when_seen
from labeling.geometry.times import seconds_between
from labeling.geometry.transforms import invert, transform_points
from labeling.readers.reader import SegmentReader
from labeling.seeds import rng_for
from labeling.stages.ground import segment_ground
from labeling.stages.static import remove_static
from labeling.stages.targets import FlowTarget
from schemas.arrays import BoolArray, Float32Array, Int64Array
from schemas.config import LabelingConfig
from schemas.errors import UnreadableSweep
from schemas.frames import GroundMask, MotionMask, Sweep
from schemas.lidars import Lidar
from schemas.listing import SegmentListing

LONG_LOOK_S = 0.4  # in which a walker leaves his place


class SweepWindow:
    """Ground and motion of a segment's sweeps, found when first asked for.

    What it answers does not depend on what was asked before: it may begin anywhere in a segment.
    """

    def __init__(self, reader: SegmentReader, config: LabelingConfig) -> None:
        self.segment_id = reader.segment_id
        self._reader, self._config = reader, config
        self._neighborhood = Neighborhood(reader.timestamps_ns, config.static, config.flow, self._is_usable)
        self._ground: dict[int, GroundMask] = {}
        self._grounded: dict[int, GroundedSweep] = {}
        self._motion: dict[int, MotionMask] = {}
        self._rejected: dict[int, str] = {}
        self._read_elsewhere = range(0)

    def timestamp_ns(self, index: int) -> int:
        """Return the nominal time of a sweep, usable or not."""
        return int(self._reader.timestamps_ns[index])

    @property
    def listing(self) -> SegmentListing:
        """What the segment was found to hold."""
        return self._reader.listing

    def advance(self, index: int) -> None:
        """Forget the sweeps that neither this one nor a later one needs."""
        self.forget_before(self._neighborhood.oldest(index))

    def forget_before(self, index: int) -> None:
        """Forget all sweeps before one."""
        for found in (self._ground, self._grounded, self._motion):
            for held in [k for k in found if k < index]:
                del found[held]

    def tell_usable(self, read: range, rejected: Mapping[int, str]) -> None:
        """Take note of which sweeps others could read, and of why they could not read the rest."""
        self._read_elsewhere = read
        self._rejected.update(rejected)

    def lacks_ground(self, index: int) -> bool:
        """Tell whether the ground of a usable sweep would have to be found."""
        return index not in self._grounded

    def lacks_motion(self, index: int) -> bool:
        """Tell whether the static points of a usable sweep would have to be found."""
        return index not in self._motion

    def take_ground(self, index: int, grounded: GroundedSweep) -> None:
        """Take over what another window found."""
        self._grounded[index] = grounded

    def take_motion(self, index: int, motion: MotionMask) -> None:
        """Take over what another window found."""
        self._motion[index] = motion

    def grounded(self, index: int) -> GroundedSweep:
        """Return a sweep with its ground.

        Raises:
            UnreadableSweep: The sweep cannot be used; the message says why.

        """
        if index not in self._grounded:
            sweep = self._read(index)
            if sweep is None:
                raise UnreadableSweep(self._rejected[index])
            ground = self._segment_ground(sweep)
            self._grounded[index] = GroundedSweep(sweep, ground, self._lidars, self._is_vehicle(sweep, ground))
        return self._grounded[index]

    def motion(self, index: int) -> MotionMask:
        """Return which points of a usable sweep stand still."""
        if index not in self._motion:
            voters = [self.grounded(k) for k in self._neighborhood.voters(index)]
            self._motion[index] = remove_static(self.grounded(index), voters, self._config.static)
        return self._motion[index]

    def is_vacated(self, index: int, rows: Int64Array) -> BoolArray:
        """Return (M,) which of some points of a usable sweep lie where another one that it looks at saw nothing.

        All of them when no other is LONG_LOOK_S away: that an object did not leave its place by then tells nothing.
        """
        current, voters = self.grounded(index).sweep, self._neighborhood.voters(index)
        looked_at = {*voters, *self._neighborhood.flow(index), *self._neighborhood.far(index)}
        stamps_ns = self._reader.timestamps_ns
        gaps_s = [seconds_between(int(stamps_ns[k]), int(stamps_ns[index])) for k in looked_at]
        if all(abs(gap_s) < LONG_LOOK_S for gap_s in gaps_s):
            return np.ones(len(rows), dtype=bool)
        is_vacated = self.motion(index).is_vacated[rows]
        for k in looked_at.difference(voters):
            sight = self.grounded(k).sight_from(current)
            is_vacated |= sight.is_through(current.points_ego[rows], self._config.static.clear_margin_m)
        return is_vacated

    def next_gap_s(self, index: int) -> float | None:
        """Return the time to the sweep that follows a usable one; None: none follows soon enough for flow."""
        following = self._neighborhood.following(index)
        stamps_ns = self._reader.timestamps_ns
        return None if following is None else seconds_between(int(stamps_ns[following]), int(stamps_ns[index]))

    def targets(self, index: int) -> list[FlowTarget]:
        """Return the sweeps that flow looks at, carried to the frame of a usable sweep."""
        near = self._neighborhood.flow(index)
        far = [k for k in self._neighborhood.far(index) if k not in near] if near else []
        return [self._target(k, index, is_far=k in far) for k in [*near, *far]]

    @cached_property
    def _lidars(self) -> tuple[Lidar, ...]:
        """The lidars as the first sweeps of the segment show them, or as the reader knows them."""
        return lidars_of(self._reader, self._read)

    @cached_property
    def _vehicle(self) -> VehicleBody:
        """The recording vehicle as the whole segment shows it, whatever part of the segment is asked for."""
        return find_vehicle(len(self._reader.timestamps_ns), self._read, self._segment_ground, self._beside)

    def _is_vehicle(self, sweep: Sweep, ground: GroundMask) -> BoolArray:
        if self._config.static.method != "visibility" or not self._vehicle.is_seen:
            return np.zeros(sweep.num_points, dtype=bool)
        return self._vehicle.covers(points_when_seen(sweep, self._beside(sweep))) & ~ground.is_ground

    def _beside(self, sweep: Sweep) -> Sweep | None:
        """Return the usable sweep before another, or else after it."""
        order = [*range(sweep.index - 1, -1, -1), *range(sweep.index + 1, len(self._reader.timestamps_ns))]
        return next((beside for k in order if (beside := self._read(k)) is not None), None)

    def _read(self, index: int) -> Sweep | None:
        """Return a sweep, or None and remember why it cannot be used."""
        if index in self._grounded:
            return self._grounded[index].sweep
        if index not in self._rejected:
            try:
                return self._reader.read_sweep(index)
            except UnreadableSweep as error:
                self._rejected[index] = str(error)
        return None

    def _segment_ground(self, sweep: Sweep) -> GroundMask:
        if sweep.index not in self._ground:
            rng = rng_for(self._config, self.segment_id, sweep.timestamp_ns, 0)
            self._ground[sweep.index] = segment_ground(sweep.points_ego, self._config.ground, rng)
        return self._ground[sweep.index]

    def _target(self, other: int, index: int, *, is_far: bool) -> FlowTarget:
        current, grounded, motion = self.grounded(index).sweep, self.grounded(other), self.motion(other)
        sweep, stands = grounded.sweep, grounded.is_standing
        ref_from_ego = invert(current.world_from_ego) @ sweep.world_from_ego
        points: Float32Array = transform_points(ref_from_ego, sweep.points_ego).astype(np.float32)
        beams = grounded.beams.moved(ref_from_ego)
        return FlowTarget(
            seconds_between(sweep.timestamp_ns, current.timestamp_ns),
            points[motion.is_dynamic],
            points[stands],
            beams.of(motion.is_dynamic),
            beams.of(stands),
            is_far=is_far,
        )

    def _is_usable(self, index: int) -> bool:
        if index in self._read_elsewhere:
            return index not in self._rejected
        try:
            self.grounded(index)
        except UnreadableSweep:
            return False
        return True
