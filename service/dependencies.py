"""What routes need, as typed ``Depends`` aliases."""

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import Depends, Request

from service.access import Caller, caller_of
from service.settings import Settings
from service.store_door import StoreDoor
from workers.jobs.database import Database
from workers.jobs.store import JobStore


def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


async def _door(request: Request) -> StoreDoor:
    door: StoreDoor = request.app.state.door
    return door


DoorOf = Annotated[StoreDoor, Depends(_door)]  # for whoever must be outside again while an answer is sent


async def _database(door: DoorOf) -> AsyncIterator[Database]:
    async with door.enter() as database:
        yield database


SettingsOf = Annotated[Settings, Depends(_settings)]
CallerOf = Annotated[Caller, Depends(caller_of)]
DatabaseOf = Annotated[Database, Depends(_database)]


async def _store(database: DatabaseOf, caller: CallerOf, settings: SettingsOf) -> JobStore:
    return JobStore(database, sees=caller.sees, max_open_segments=settings.max_open_segments)


StoreOf = Annotated[JobStore, Depends(_store)]
