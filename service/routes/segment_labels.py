"""The labels of one segment, as bytes: for whoever cannot read the label folder."""

import json
from collections.abc import Iterator
from contextlib import ExitStack
from http import HTTPStatus
from tempfile import TemporaryFile
from typing import Annotated, Any, BinaryIO, Final, Literal

import pyarrow.parquet as pq
from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict
from starlette.concurrency import run_in_threadpool

from labeling.folders.folder import copy_shard
from labeling.storage import places
from labeling.storage.storage import open_storage
from schemas.errors import InvalidInput, StorageTrouble
from schemas.manifest import Shard
from service.dependencies import CallerOf, DoorOf, SettingsOf
from service.errors import error_responses
from service.routes.jobs import JobId
from workers.jobs.labels import find_segment_labels

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

Format = Literal["parquet", "jsonl"]
MEDIA_TYPES: Final[dict[Format, str]] = {
    "parquet": "application/vnd.apache.parquet",
    "jsonl": "application/jsonl",
}
_CHUNK_BYTES: Final = 1 << 18
_BATCH_ROWS: Final = 1024
_MAX_FETCHES: Final = 4  # at a time: a bucket that does not answer takes no more threads than these
_CONTENT: Final[dict[str, Any]] = {media_type: {} for media_type in MEDIA_TYPES.values()}

SegmentPosition = Annotated[int, Path(ge=0, lt=2**31, description="The segment's position in its job, from 0")]


class LabelsQuery(BaseModel):
    """As what to send the labels."""

    model_config = ConfigDict(extra="forbid")

    format: Format = "parquet"


async def _find_shard(job_id: JobId, position: SegmentPosition, caller: CallerOf, door: DoorOf) -> tuple[str, Shard]:
    """Return the label folder and the shard; the store is free again before anything is fetched or sent."""
    async with door.enter() as database:
        found = await run_in_threadpool(find_segment_labels, database, job_id, position, owner=caller.sees)
    if found.shard is not None:
        return found.output_uri, found.shard
    if found.state.is_ended:
        raise HTTPException(HTTPStatus.NOT_FOUND, f"{found.uri} has ended {found.state} without labels")
    raise HTTPException(HTTPStatus.CONFLICT, f"{found.uri} is {found.state}: it has no labels yet")


ShardOf = Annotated[tuple[str, Shard], Depends(_find_shard)]


def _fetch(
    found: ShardOf, query: Annotated[LabelsQuery, Query()], request: Request, caller: CallerOf, settings: SettingsOf
) -> BinaryIO | None:
    """Return the whole shard in a file without a name, checked against its digest; None: the caller has it."""
    output_uri, shard = found
    if _has(request, _etag(shard, query.format)):
        return None
    try:
        places.under_root(places.join(output_uri, shard.path), caller.roots_within(settings.data_roots))
        with ExitStack() as unless_whole:
            file = unless_whole.enter_context(TemporaryFile())
            copy_shard(open_storage(output_uri), shard, file)
            unless_whole.pop_all()  # whoever sends it closes it
    except InvalidInput as error:  # of the folder: nothing that is asked for is wrong
        raise HTTPException(HTTPStatus.NOT_FOUND, str(error)) from None
    except OSError as error:
        raise StorageTrouble(f"the service has no room for a copy of {shard.path}: {error.strerror}") from None
    return file


FileOf = Annotated[BinaryIO | None, Depends(_fetch, max_concurrency=_MAX_FETCHES)]


@router.get(
    "/{job_id}/segments/{position}/labels",
    response_class=StreamingResponse,
    responses={
        200: {"description": "The labels", "content": _CONTENT},
        304: {"description": "The caller has them: If-None-Match names their ETag"},
        **error_responses(404, 409, 422, 503),
    },
)
async def get_segment_labels(found: ShardOf, file: FileOf, query: Annotated[LabelsQuery, Query()]) -> Response:
    """Send the table `labels` of one segment: the shard itself, or a line of JSON a row. What is published stays."""
    shard = found[1]
    headers = {"ETag": _etag(shard, query.format), "Cache-Control": "private, no-cache"}  # asked for anew, by ETag
    if file is None:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    headers["X-Content-Type-Options"] = "nosniff"
    if query.format == "parquet":
        headers["Content-Length"] = str(shard.bytes)
    chunks = _bytes_of(file) if query.format == "parquet" else _lines_of(file)
    return StreamingResponse(chunks, headers=headers, media_type=MEDIA_TYPES[query.format])


def _etag(shard: Shard, format_: Format) -> str:
    """Return the digest of the shard; lines of JSON are other bytes, and have another tag."""
    return f'"{shard.sha256}"' if format_ == "parquet" else f'"{shard.sha256}.{format_}"'


def _has(request: Request, etag: str) -> bool:
    given = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    return etag in given or "*" in given


def _bytes_of(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while chunk := file.read(_CHUNK_BYTES):
            yield chunk


def _lines_of(file: BinaryIO) -> Iterator[str]:
    with file:
        for batch in pq.ParquetFile(file).iter_batches(_BATCH_ROWS, use_threads=False):
            yield "".join(f"{json.dumps(row, allow_nan=False)}\n" for row in batch.to_pylist())
