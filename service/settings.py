"""What the environment says. Of motionlabel, only `python -m workers.dispatcher` reads some of it elsewhere."""

import os
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from labeling.storage import places
from schemas.errors import InvalidInput

_PREFIX = "MOTIONLABEL_"


class Settings(BaseSettings):
    """Settings of the service and its clients: field ``port`` is the variable ``MOTIONLABEL_PORT``."""

    model_config = SettingsConfigDict(env_prefix=_PREFIX, frozen=True, extra="forbid", env_ignore_empty=True)

    data_dir: Path = Field(Path("motionlabel-data"), description="folder of the job store and of what Ray writes")
    database_url: str = Field(
        "", description="job store; sqlite:///DATA_DIR/jobs.sqlite3 by default, or postgresql://..."
    )
    data_roots: Annotated[tuple[str, ...], NoDecode] = Field(
        default_factory=lambda: (str(Path.cwd()),),
        validate_default=True,
        description="comma-separated folders and s3://bucket/prefix URIs that jobs may read and write; "
        "by default the folder that serve is started in",
    )
    host: str = Field("127.0.0.1", min_length=1, description="address that the API listens on")
    allowed_hosts: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="comma-separated names, without ports, that the API may be called by besides HOST and localhost"
    )
    port: int = Field(8000, ge=0, le=65535, description="port that the API listens on; 0: any free one")
    max_open_segments: int = Field(
        100_000, ge=1, description="segments that wait or run, of one owner's jobs at a time: more are refused with 429"
    )
    api_keys_file: Path | None = Field(
        None, description="file of the API keys that callers need, as `motionlabel key new` writes it; without it, none"
    )
    ray_address: str = Field("", description="Ray cluster to join; by default a local Ray is started")
    server: str = Field("http://127.0.0.1:8000", description="API that backfill, submit and the other clients talk to")
    api_key: SecretStr = Field(
        SecretStr(""), description="token of the API key that these send, where the API asks for one"
    )
    api_key_file: Path | None = Field(
        None, description="file that holds this token; it comes before MOTIONLABEL_API_KEY"
    )

    @field_validator("data_dir", "api_keys_file", "api_key_file", mode="after")
    @classmethod
    def _make_absolute(cls, value: Path | None) -> Path | None:
        return None if value is None else value.expanduser().absolute()

    @field_validator("data_roots", "allowed_hosts", mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @field_validator("data_roots", mode="after")
    @classmethod
    def _make_canonical(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        try:
            return tuple(places.canonical(places.absolute(root)) for root in value)
        except InvalidInput as error:
            raise ValueError(str(error)) from None

    @property
    def store_url(self) -> str:
        """URL of the job store, the default one spelled out."""
        return self.database_url or f"sqlite:///{quote(str(self.data_dir / 'jobs.sqlite3'))}"


def read_settings(**given: Any) -> Settings:
    """Read the environment; what is given and not None wins over it.

    Raises:
        InvalidInput: A value that cannot be; the message names the variable.

    """
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        problem = error.errors()[0]
        name = str(problem["loc"][0])
        source = f"--{name.replace('_', '-')}" if given.get(name) is not None else f"{_PREFIX}{name.upper()}"
        raise InvalidInput(f"{source}={problem['input']}: {problem['msg']}") from None


def describe_settings() -> str:
    """Return the variables, a line each, for ``--help``."""
    lines = [f"  {_PREFIX}{name.upper()}: {field.description}" for name, field in Settings.model_fields.items()]
    return "\n".join(lines)


def is_debugging() -> bool:
    """Return whether MOTIONLABEL_DEBUG asks for the traces of errors. Never fails: it is asked while failing."""
    return bool(os.environ.get(f"{_PREFIX}DEBUG"))
