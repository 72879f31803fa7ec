"""The API's way to the job store: a few requests at a time, and none waits long for a store that is locked or away."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

from sqlalchemy.exc import DatabaseError, OperationalError
from sqlalchemy.exc import TimeoutError as NoConnection

from workers.jobs.database import MAX_CONNECTIONS, Database

_LOGGER = logging.getLogger(__name__)
PATIENCE_S: Final = 3.0  # for a place at the door; behind it, as long again for the store itself


def is_outage(error: Exception) -> bool:
    """Tell trouble with the store itself, away, locked or damaged, from a query of ours that it refused."""
    return isinstance(error, OperationalError | NoConnection) or type(error) is DatabaseError  # the last: damaged


class StoreDoor:
    """Lets as many requests at the store as it has connections. Who waits for a place takes no thread."""

    def __init__(self, database: Database, patience_s: float) -> None:
        self._database = database
        self._patience_s = patience_s
        self._places = asyncio.Semaphore(MAX_CONNECTIONS)
        self._is_away = False

    @asynccontextmanager
    async def enter(self) -> AsyncIterator[Database]:
        """Yield the store to one request. An outage is logged when it begins and when it is over.

        Raises:
            NoConnection: Nobody left within the patience.

        """
        try:
            async with asyncio.timeout(self._patience_s):
                await self._places.acquire()
        except TimeoutError:
            raise NoConnection("all connections are in use") from None
        is_away = False
        try:
            yield self._database
        except (DatabaseError, NoConnection) as error:
            is_away = is_outage(error)
            if not is_away:
                raise
            if not self._is_away:
                _LOGGER.error("the job store cannot be used: %s", str(error).partition("\n")[0])
            raise
        finally:
            self._places.release()
            if self._is_away and not is_away:
                _LOGGER.error("the job store can be used again")
            self._is_away = is_away
