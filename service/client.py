"""Talk to the API: one call, its JSON, and its errors in one line."""

import re
from http import HTTPStatus
from typing import Any, Final, TypeVar

import httpx2
from pydantic import BaseModel, ValidationError

from schemas.errors import InvalidInput, LabelingError

M = TypeVar("M", bound=BaseModel)
_TIMEOUT_S = 30.0
_TOO_MANY = 429  # requests, or jobs, for now: another time it will do
_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_HEADER_TEXT: Final = re.compile("[!-~]+")
_ADVICE: Final = "put its token into MOTIONLABEL_API_KEY, or into a file that --api-key-file names"


class ServiceError(LabelingError):
    """The service cannot be reached, or cannot do what it should."""


class Client:
    """The API at one address, over one connection."""

    def __init__(self, server: str, token: str = "") -> None:
        """Take the server's URL, and the token of an API key where the service asks for one.

        Raises:
            InvalidInput: Not a URL, or one that holds a password; or no token. What is secret is not repeated.

        """
        self._server = server.rstrip("/")
        try:
            url = httpx2.URL(self._server)
        except httpx2.InvalidURL as error:
            raise InvalidInput(f"--server {server}: {error}") from None
        if url.scheme not in ("http", "https") or not url.host:
            raise InvalidInput(f"--server {server}: expected a URL, as http://127.0.0.1:8000")
        if url.userinfo:
            raise InvalidInput(
                "--server: expected a URL without user and password; an API key goes into --api-key-file"
            )
        if token and not _HEADER_TEXT.fullmatch(token):
            raise InvalidInput("the API key is no token: expected one line, ml_..., as `motionlabel key new` prints it")
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        # HTTP_PROXY and the like are not meant for this machine itself.
        self._http = httpx2.Client(
            base_url=self._server, headers=headers, timeout=_TIMEOUT_S, trust_env=url.host not in _LOOPBACK
        )

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def get(self, path: str, **parameters: Any) -> Any:
        """Read one resource. Raises as ``post``."""
        given = {name: value for name, value in parameters.items() if value is not None}
        return self._call("GET", path, params=given)

    def post(self, path: str, body: Any = None) -> Any:
        """Send a body, or nothing, and return the answer's JSON.

        Raises:
            InvalidInput: The service refuses this; the message is its own.
            ServiceError: The service cannot be reached, failed, or has too much to do.

        """
        return self._call("POST", path, json=body) if body is not None else self._call("POST", path)

    def _call(self, method: str, path: str, **content: Any) -> Any:
        try:
            response = self._http.request(method, path, **content)
        except httpx2.RequestError as error:
            reason = str(error) or type(error).__name__
            raise ServiceError(
                f"cannot reach {self._server}: {reason}; start it with `motionlabel serve`, or name it with --server"
            ) from None
        try:
            answer = response.json()
        except ValueError:
            answer = None
        if response.is_success and answer is not None:
            return answer
        detail = answer.get("detail") if isinstance(answer, dict) else None
        if response.status_code == HTTPStatus.UNAUTHORIZED:
            raise InvalidInput(f"{self._server} takes no call without an API key that it knows: {_ADVICE}")
        if detail is None:
            raise ServiceError(f"{self._server} is no motionlabel service: it answers {response.status_code}")
        is_refused = response.is_client_error and response.status_code != _TOO_MANY
        raise (InvalidInput if is_refused else ServiceError)(detail)


def read_answer(model: type[M], answer: Any) -> M:
    """Return an answer's JSON as what it should be.

    Raises:
        ServiceError: It is something else.

    """
    try:
        return model.model_validate(answer, strict=False, extra="ignore")  # a newer service may tell more
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(map(str, problem["loc"])) or "its answer"
        raise ServiceError(
            f"the server is no motionlabel service, or one of another version: {place}: {problem['msg']}"
        ) from None
