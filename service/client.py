"""Talk to the API: one call, its JSON, and its errors in one line."""

from typing import Any

import httpx2

from schemas.errors import InvalidInput, LabelingError

_TIMEOUT_S = 30.0
_LOOPBACK = ("127.0.0.1", "::1", "localhost")


class ServiceError(LabelingError):
    """The service cannot be reached, or cannot do what it should."""


class Client:
    """The API at one address, over one connection."""

    def __init__(self, server: str) -> None:
        """Take the server's URL.

        Raises:
            InvalidInput: Not a URL.

        """
        self._server = server.rstrip("/")
        try:
            url = httpx2.URL(self._server)
        except httpx2.InvalidURL as error:
            raise InvalidInput(f"--server {server}: {error}") from None
        if url.scheme not in ("http", "https") or not url.host:
            raise InvalidInput(f"--server {server}: expected a URL, as http://127.0.0.1:8000")
        # HTTP_PROXY and the like are not meant for this machine itself.
        self._http = httpx2.Client(base_url=self._server, timeout=_TIMEOUT_S, trust_env=url.host not in _LOOPBACK)

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
            ServiceError: The service cannot be reached, or failed.

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
        if detail is None:
            raise ServiceError(f"{self._server} is no motionlabel service: it answers {response.status_code}")
        raise (InvalidInput if response.is_client_error else ServiceError)(detail)
