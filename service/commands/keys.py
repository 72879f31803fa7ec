"""`motionlabel key new | list | revoke`: the file of API keys. A running service takes each change up by itself."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from labeling.storage.places import absolute
from schemas.errors import InvalidInput
from service.keys import Scope, add_key, make_key, read_keys, revoke_key
from service.settings import read_settings

app = typer.Typer(help="Make, list and revoke the API keys of a service.", rich_markup_mode=None)

File = Annotated[
    Path | None,
    typer.Option("--file", metavar="FILE", help="File of the keys; by default MOTIONLABEL_API_KEYS_FILE."),
]


@app.command(epilog="Example: motionlabel key new --owner night-shift --scope submit --file keys")
def new(
    owner: Annotated[str, typer.Option(metavar="NAME", help="Whose jobs it submits and sees.")],
    scope: Annotated[
        list[Scope] | None,
        typer.Option(help="What it opens: read looks, submit also submits and cancels, admin sees the jobs of all."),
    ] = None,
    expires: Annotated[
        str | None, typer.Option(metavar="DATE", help="From this day on (UTC) it is refused, as 2027-01-31.")
    ] = None,
    root: Annotated[
        list[str] | None,
        typer.Option(metavar="PLACE", help="Folder or s3://bucket/prefix that its jobs stay below. Repeatable."),
    ] = None,
    file: File = None,
) -> None:
    """Add a key to a file and print its token, this once: the file holds no more than its hash."""
    roots = [absolute(place) for place in root] if root else None
    key, token = make_key(owner, scope or [Scope.READ], None if expires is None else _parse_moment(expires), roots)
    add_key(_file(file), key)
    typer.echo(token)
    typer.echo(f"motionlabel: key {key.id} of {owner}: keep the token, it is shown this once", err=True)


@app.command("list", epilog="Example: motionlabel key list --file keys")
def list_keys(file: File = None) -> None:
    """Show whose keys there are and what they open."""
    now = datetime.now(UTC)
    for key in read_keys(_file(file)):
        time = "" if key.expires is None else f" until {key.expires:%Y-%m-%d %H:%M} UTC"
        over = " (over)" if key.is_expired(now) else ""
        roots = "" if key.roots is None else f", below {', '.join(key.roots)}"
        typer.echo(f"{key.id} {key.owner} {'+'.join(key.scopes)}{time}{over}{roots}")


@app.command(epilog="Example: motionlabel key revoke 3f9a0c1e --file keys")
def revoke(
    key: Annotated[str, typer.Argument(metavar="ID", help="Id of the key, as `key list` shows it.")],
    file: File = None,
) -> None:
    """Take a key out of the file: the next request with it is refused."""
    revoke_key(_file(file), key)


def _file(given: Path | None) -> Path:
    path = read_settings(api_keys_file=given).api_keys_file
    if path is None:
        raise InvalidInput("which file of keys? give --file FILE, or set MOTIONLABEL_API_KEYS_FILE")
    return path


def _parse_moment(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise InvalidInput(
            f"--expires {text}: expected a date, as 2027-01-31, or a time, as 2027-01-31T18:00Z"
        ) from None
    return moment.astimezone(UTC) if moment.tzinfo else moment.replace(tzinfo=UTC)
