"""What routes need, as typed ``Depends`` aliases."""

from typing import Annotated

from fastapi import Depends, Request

from service.settings import Settings
from workers.jobs.database import Database
from workers.jobs.store import JobStore


def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


def _database(request: Request) -> Database:
    database: Database = request.app.state.database
    return database


def _store(request: Request) -> JobStore:
    return JobStore(request.app.state.database)


SettingsOf = Annotated[Settings, Depends(_settings)]
DatabaseOf = Annotated[Database, Depends(_database)]
StoreOf = Annotated[JobStore, Depends(_store)]
