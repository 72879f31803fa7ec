"""The service as a whole."""

from importlib.metadata import version

from fastapi import APIRouter
from pydantic import BaseModel

from labeling.folders.identity import code_version
from schemas.api.status import ServiceStatus
from schemas.tables import SCHEMA_VERSION
from service.dependencies import StoreOf
from service.errors import error_responses

router = APIRouter(prefix="/v1", tags=["service"])


class Version(BaseModel):
    """What answers."""

    version: str
    code_version: str  # with a digest of the source that decides labels
    schema_version: int  # of the label tables


@router.get("/status", responses=error_responses(503))
def get_status(store: StoreOf) -> ServiceStatus:
    """Tell about queue, workers, throughput and failures."""
    return store.status()


@router.get("/version")
async def get_version() -> Version:
    """Tell which motionlabel this is."""
    return Version(version=version("motionlabel"), code_version=code_version(), schema_version=SCHEMA_VERSION)
