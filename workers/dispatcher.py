"""The dispatcher: the Ray driver. It claims segments from the job store, has them labelled, and reports.

    MOTIONLABEL_DATABASE_URL=URL python -m workers.dispatcher --data-dir DIR [--ray-address ADDRESS] [--workers N]

It alone writes the store on the workers' behalf. Whatever kills it, its leases run out and another takes over.
"""

import argparse
import logging
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from ray.exceptions import RayError

from schemas.errors import InvalidInput, LabelingError
from workers import cluster
from workers.jobs.claims import SegmentQueue
from workers.jobs.database import URL_VARIABLE, open_database
from workers.ray_workers import RayWorkers
from workers.segment_dispatcher import LEASE_S, SegmentDispatcher

_LOGGER = logging.getLogger("motionlabel.dispatcher")
_TICK_S: Final = 0.25
_STORE_WAIT_S: Final = 1.0  # for a locked job store: the rest of a tick comes that much later


def dispatch(
    database_url: str,
    data_dir: Path,
    ray_address: str = "",
    num_workers: int | None = None,
    *,
    parent_pid: int | None = None,
    lease_s: float = LEASE_S,
) -> int:
    """Dispatch until SIGTERM or Ctrl-C, or until the parent is gone; return the exit code.

    Args:
        database_url: Of the job store.
        data_dir: Where a Ray of our own puts what memory does not hold.
        ray_address: Of a cluster to join; empty: start one here.
        num_workers: CPUs of the Ray started here, by default all; no say in a cluster that runs already.
        parent_pid: Of the process that must not be outlived; None: there is none.
        lease_s: How long a segment stays ours without a word from us.

    Raises:
        InvalidInput: The store or the cluster cannot be reached.

    """
    stop = _Stop(parent_pid)
    data_dir.mkdir(parents=True, exist_ok=True)
    database = open_database(database_url, wait_s=_STORE_WAIT_S)
    context = (
        cluster.remote_cluster(ray_address)
        if ray_address
        else cluster.local_cluster(num_workers or len(os.sched_getaffinity(0)), data_dir / "spilled")
    )
    with context:
        stop.listen()  # again: Ray puts handlers of its own in place
        dispatcher = SegmentDispatcher(SegmentQueue(database), RayWorkers(), lease_s=lease_s)
        try:
            while not stop.is_asked:
                dispatcher.tick()
                time.sleep(_TICK_S)
        finally:
            dispatcher.close()
    database.close()
    return 0


class _Stop:
    """Notes SIGTERM, Ctrl-C and the end of the parent. The handlers only set a flag: the main loop looks at it."""

    def __init__(self, parent_pid: int | None) -> None:
        self._parent_pid = parent_pid
        self._is_signalled = False
        self.listen()

    @property
    def is_asked(self) -> bool:
        """True when it is time to end. An orphan's parent is another process, whoever adopts it."""
        return self._is_signalled or self._parent_pid not in (None, os.getppid())

    def listen(self) -> None:
        """Put the handlers in place."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._note)

    def _note(self, *_: object) -> None:
        self._is_signalled = True


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the dispatcher as a process of its own."""
    parser = argparse.ArgumentParser(prog="python -m workers.dispatcher", description="Drive the Ray workers.")
    url = os.environ.get(URL_VARIABLE)
    parser.add_argument(
        "--database-url", default=url, required=not url, help=f"job store; with a password: {URL_VARIABLE}"
    )
    parser.add_argument("--data-dir", required=True, type=Path, help="where Ray puts what memory does not hold")
    parser.add_argument("--ray-address", default="", help="cluster to join; by default a local Ray is started")
    parser.add_argument("--workers", type=int, help="CPUs of the local Ray; by default all of this machine")
    parser.add_argument("--parent-pid", type=int, help="end when this process is our parent no more")
    options = parser.parse_args(arguments)
    return run(
        options.database_url, options.data_dir, options.ray_address, options.workers, parent_pid=options.parent_pid
    )


def run(
    database_url: str,
    data_dir: Path,
    ray_address: str,
    num_workers: int | None,
    *,
    parent_pid: int | None = None,
    lease_s: float = LEASE_S,
) -> int:
    """Dispatch as ``dispatch`` does, with its log on stderr and errors as a line of it."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    logging.getLogger("alembic").setLevel(logging.WARNING)
    try:
        return dispatch(database_url, data_dir, ray_address, num_workers, parent_pid=parent_pid, lease_s=lease_s)
    except (LabelingError, cluster.ClusterLost, RayError) as error:
        _LOGGER.error("%s", str(error).partition("\n")[0])
        return 2 if isinstance(error, InvalidInput) else 1  # as service.exit_codes has them


if __name__ == "__main__":
    sys.exit(main())
