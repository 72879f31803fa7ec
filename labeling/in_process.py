"""Label segments in this process, one after the other: what the distributed run is held against."""

import dataclasses
import logging
from collections.abc import Iterator, Sequence

from labeling.folders.entries import all_rejected_entry, describe_segment, failed_entry
from labeling.folders.identity import LabelSet
from labeling.folders.spill import ObservationSpill
from labeling.folders.writer import publish_segment
from labeling.line import label_tracks, make_clock, observe_sweeps
from labeling.readers.reader import SegmentReader, sweep_range
from labeling.run import OnProgress, RunProgress
from labeling.storage.storage import Storage
from labeling.threads import use_one_thread
from schemas.config import LabelingConfig
from schemas.errors import LabelingError, StageFailed, StorageTrouble
from schemas.manifest import SegmentEntry
from schemas.objects import SweepObservation

_LOGGER = logging.getLogger(__name__)


def label_in_process(
    readers: Sequence[SegmentReader], storage: Storage, config: LabelingConfig, on_progress: OnProgress
) -> Iterator[SegmentEntry]:
    """Label segments in this process, one after the other."""
    use_one_thread()
    for reader in readers:
        yield _label_or_fail(reader, storage, config, on_progress)


def _label_or_fail(
    reader: SegmentReader, storage: Storage, config: LabelingConfig, on_progress: OnProgress
) -> SegmentEntry:
    num_sweeps = len(sweep_range(reader, config))
    observations: list[SweepObservation] = []
    try:
        with ObservationSpill(keeps_points=config.write_points) as spill:
            on_progress(RunProgress(reader.segment_id, "sweeps", 0, num_sweeps))
            for observation in observe_sweeps(reader, config):
                spill.append(observation)
                observations.append(dataclasses.replace(observation, points=None))
                on_progress(RunProgress(reader.segment_id, "sweeps", len(observations), num_sweeps))
            if all(observation.is_rejected for observation in observations):
                return all_rejected_entry(reader.segment_id, reader.uri, num_sweeps, observations[0].reason)
            on_progress(RunProgress(reader.segment_id, "tracks", num_sweeps, num_sweeps))
            proposals = [observation.proposals for observation in observations]
            tracks = label_tracks(proposals, make_clock(observations), config, reader.segment_id)
            shards = publish_segment(storage, LabelSet.of(reader, config), spill.restore(), tracks)
    except (StorageTrouble, OSError, MemoryError):
        raise  # it would meet the other segments too
    except LabelingError as error:
        return failed_entry(reader.segment_id, reader.uri, str(error))
    except Exception as error:  # a fault of ours fails its segment alone, here as on Ray
        _LOGGER.debug("segment %s failed", reader.segment_id, exc_info=True)
        return failed_entry(reader.segment_id, reader.uri, str(StageFailed.by(error)))
    finally:
        on_progress(RunProgress(reader.segment_id, "finished", len(observations), num_sweeps))
    return describe_segment(storage, reader.segment_id, reader.uri, shards)
