"""The Ray cluster: a local one, started and ended with this process, or one that runs already."""

import contextlib
import logging
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import psutil
import ray

from labeling.folders.identity import code_version
from schemas.errors import InvalidInput
from workers.pipeline import OBJECT_STORE_BYTES
from workers.processes import descendants, kill, wait_for_end

NAMESPACE: Final = "motionlabel"
_GRACE_S: Final = 5.0
_PROBE_S: Final = 30.0  # a slow and busy machine needs ten to start a worker
_MAX_LOOK_S: Final = 1.0  # between two looks; a longer while we slept, which proves nothing about the cluster
_JOIN_S: Final = 120.0  # a cluster may have to start a node for us
_FOLDER_PREFIX: Final = "motionlabel-ray-"


class ClusterLost(Exception):
    """The Ray that this process joined is of no more use: only a new process can join another."""


@contextlib.contextmanager
def local_cluster(num_cpus: int, spill_folder: Path | None = None) -> Iterator[None]:
    """Start a Ray of our own on this machine, and leave no process and no file of it behind.

    What its memory does not hold goes to ``spill_folder``, by default somewhere under /tmp.
    """
    _remove_folders_of_the_dead()
    os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))  # else Ray writes one into the home folder
    # Ours alone, for Ray opens its own folder to everybody. Under /tmp: paths of sockets have at most 107 bytes.
    folder = tempfile.mkdtemp(prefix=f"{_FOLDER_PREFIX}{os.getpid()}-", dir="/tmp")
    others = descendants()
    try:
        with _temporary_files_in(folder):
            ray.init(
                num_cpus=num_cpus,
                object_store_memory=OBJECT_STORE_BYTES,
                include_dashboard=False,
                log_to_driver=False,
                logging_level=logging.ERROR,
                namespace=NAMESPACE,
                _temp_dir=f"{folder}/r",
                object_spilling_directory=str(spill_folder or folder),
            )
        yield
    finally:
        started = descendants() - others
        ray.shutdown()
        kill(wait_for_end(started, _GRACE_S))
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def _temporary_files_in(folder: str) -> Iterator[None]:
    """Have processes that start now keep their temporary files there, so that those of killed ones go with it."""
    before = os.environ.get("TMPDIR")
    os.environ["TMPDIR"] = folder
    try:
        yield
    finally:
        del os.environ["TMPDIR"]
        if before is not None:
            os.environ["TMPDIR"] = before


@contextlib.contextmanager
def remote_cluster(address: str) -> Iterator[None]:
    """Join a running cluster.

    Raises:
        InvalidInput: There is none at this address, or it lets anybody in.

    """
    if os.environ.get("RAY_AUTH_MODE") != "token":
        raise InvalidInput(
            f"the Ray cluster {address} would be used without authentication: set RAY_AUTH_MODE=token and the "
            "cluster's RAY_AUTH_TOKEN here and on every node"
        )
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR, namespace=NAMESPACE)
    except (ConnectionError, ray.exceptions.RayError) as error:
        raise InvalidInput(f"cannot join the Ray cluster {address}: {str(error).splitlines()[0]}") from None
    try:
        theirs = ray.get(_code_version.remote(), timeout=_JOIN_S)
        if theirs != code_version():
            raise InvalidInput(f"the Ray cluster {address} runs motionlabel {theirs}, this is {code_version()}")
        yield
    except ray.exceptions.GetTimeoutError:
        raise InvalidInput(f"the Ray cluster {address} has run nothing for us within {_JOIN_S:g} s") from None
    finally:
        ray.shutdown()


class HealthProbe:
    """Finds out whether a death was more than one process's: asks the cluster when made, and is looked at again."""

    def __init__(self) -> None:
        self._answer = _code_version.remote()
        self._looked_s = time.monotonic()
        self._patience_s = _PROBE_S

    def is_answered(self) -> bool:
        """Return whether the cluster has run what it was asked to. Does not wait.

        Raises:
            ClusterLost: The cluster does not run tasks any more.

        """
        now_s = time.monotonic()
        self._patience_s -= min(now_s - self._looked_s, _MAX_LOOK_S)
        self._looked_s = now_s
        try:
            if ray.wait([self._answer], timeout=0)[0]:
                ray.get(self._answer)
                return True
        except ray.exceptions.RayError as error:
            raise ClusterLost(f"the Ray cluster is gone: {str(error).splitlines()[0]}") from None
        if self._patience_s <= 0:
            raise ClusterLost(f"the Ray cluster is gone: it has run nothing for us within {_PROBE_S:g} s")
        return False


@ray.remote(num_cpus=0, max_retries=0)
def _code_version() -> str:
    return code_version()


def cpus_of_machines() -> dict[str, float]:
    """Return how many CPUs each machine of the cluster has, by its id in Ray. Waits for Ray's GCS."""
    nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]  # Ray's
    return {node["NodeID"]: node["Resources"].get("CPU", 0.0) for node in nodes if node["Alive"]}


def _remove_folders_of_the_dead() -> None:
    """Tidy up after processes that were killed before they could."""
    for folder in Path("/tmp").glob(f"{_FOLDER_PREFIX}*-*"):
        pid = folder.name.removeprefix(_FOLDER_PREFIX).partition("-")[0]
        if pid.isdecimal() and not psutil.pid_exists(int(pid)):
            shutil.rmtree(folder, ignore_errors=True)
