"""The HTTP API. Loads neither Ray nor PyTorch: it talks to the job store only."""

import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Any, Final

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.access import KeyCheck, is_open
from service.bodies import MAX_BODY_BYTES, BodyLimit, HeadAsGet
from service.callers import CallerCheck
from service.dashboard import routes as dashboard
from service.dashboard import sign_in
from service.errors import MEDIA_TYPE, Problem, error_responses, install_error_handlers
from service.keys import KeyRing
from service.routes import events, health, jobs, segment_labels, status
from service.sessions import Sessions
from service.settings import Settings
from service.store_door import PATIENCE_S, StoreDoor
from service.streams import Streams
from workers.jobs.database import open_database

_SECURITY: Final = {
    "key": {
        "type": "http",
        "scheme": "bearer",
        "description": "Where the service has keys: a token as `motionlabel key new` prints it. "
        "GET needs the scope read, POST the scope submit.",
    }
}


def create_app(settings: Settings) -> FastAPI:
    """Return the API. It opens the job store when it starts and closes it when it ends.

    Raises:
        InvalidInput: The file of API keys cannot be used.

    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        database = open_database(settings.store_url, wait_s=PATIENCE_S)
        app.state.door = StoreDoor(database, PATIENCE_S)
        try:
            yield
        finally:
            database.close()

    app = FastAPI(
        title="motionlabel",
        summary="Label everything that moves in raw driving LiDAR, without human annotation.",
        version=version("motionlabel"),
        lifespan=lifespan,
        docs_url=None,  # these pages would load scripts from elsewhere
        redoc_url=None,
        generate_unique_id_function=lambda route: route.name,
    )
    app.state.settings = settings
    app.state.streams = Streams()
    app.add_middleware(BodyLimit, max_bytes=MAX_BODY_BYTES)
    sessions = None if settings.api_keys_file is None else Sessions(KeyRing(settings.api_keys_file))
    app.state.sessions = sessions
    app.add_middleware(KeyCheck, sessions=sessions)
    app.add_middleware(HeadAsGet)
    app.add_middleware(CallerCheck, host=settings.host, allowed_hosts=settings.allowed_hosts)
    for part in (jobs, segment_labels, events, status, health, dashboard, sign_in):
        app.include_router(part.router)
    install_error_handlers(app)
    app.openapi = lambda: describe_api(app)  # type: ignore[method-assign] # FastAPI's own way to change it
    return app


def describe_api(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document, where every error is a problem document."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
        schemas = document["components"]["schemas"]
        for name in ("HTTPValidationError", "ValidationError"):
            schemas.pop(name, None)
        problem = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas |= problem.pop("$defs") | {"Problem": problem}
        document["components"]["securitySchemes"] = _SECURITY
        content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
        for path, operations in document["paths"].items():
            for method, operation in operations.items():
                if not is_open(method.upper(), path):
                    operation["security"] = [{name: []} for name in _SECURITY]
                    operation["responses"] |= {str(code): text for code, text in error_responses(401, 403).items()}
                operation["responses"]["default"] = {"description": "Any other error"}
                for code, response in operation["responses"].items():
                    if not code.startswith("2"):
                        response["content"] = content
        app.openapi_schema = document
    return app.openapi_schema


def render_openapi() -> str:
    """Return the text of docs/openapi.json."""
    return json.dumps(describe_api(create_app(Settings())), indent=2) + "\n"
