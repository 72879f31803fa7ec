"""For whoever keeps the process running: does it live, is it ready."""

from typing import Literal

from fastapi import APIRouter, HTTPException
from pydantic import BaseModel

from schemas.api.status import MAX_SILENCE_S
from service.dependencies import StoreOf
from service.errors import error_responses

router = APIRouter(tags=["health"])


class Health(BaseModel):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Readiness(BaseModel):
    """The job store answers, and somebody works on what it holds."""

    status: Literal["ready"] = "ready"
    dispatchers: int
    workers: int


@router.get("/healthz")
async def get_health() -> Health:  # in no thread: all may wait for the store
    """Say that the process lives."""
    return Health()


@router.get("/readyz", responses=error_responses(503))
def get_readiness(store: StoreOf) -> Readiness:
    """Say whether the job store can be reached and a dispatcher has reported lately."""
    fresh = [dispatcher for dispatcher in store.status().dispatchers if dispatcher.is_fresh]
    if not fresh:
        raise HTTPException(
            503, f"no dispatcher has reported within {MAX_SILENCE_S:g} s: is it starting, or did it end?"
        )
    return Readiness(dispatchers=len(fresh), workers=sum(dispatcher.num_workers for dispatcher in fresh))
