"""`motionlabel serve`, `motionlabel dispatch` and `motionlabel migrate`."""

from pathlib import Path
from typing import Annotated, Final

import typer

from service.exit_codes import DONE
from service.settings import describe_settings, read_settings

EPILOG: Final = f"Example: motionlabel serve --port 8000 --data-dir data\n\n\b\nEnvironment:\n{describe_settings()}"

DataDir = Annotated[Path | None, typer.Option(metavar="DIR", help="Folder of the job store and of what Ray writes.")]


def serve(
    host: Annotated[str | None, typer.Option(metavar="NAME", help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(metavar="N", help="Port to listen on; 0 takes a free one.")] = None,
    data_dir: DataDir = None,
    api_keys: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Ask callers for a key of this file, as `motionlabel key new` makes it."),
    ] = None,
    parent_pid: Annotated[int | None, typer.Option(hidden=True)] = None,
) -> int:
    """Run the service on this machine: API, dispatcher and workers, until Ctrl-C."""
    try:
        from service.serve import serve as run

        settings = read_settings(host=host, port=port, data_dir=data_dir, api_keys_file=api_keys)
        return run(settings, parent_pid=parent_pid)
    except KeyboardInterrupt:  # before it listens to signals: what a later one does, it does too
        return DONE


def dispatch(
    data_dir: DataDir = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="CPUs of the Ray started here; by default all of them.")
    ] = None,
) -> int:
    """Run the dispatcher alone: label what the job store holds, until Ctrl-C."""
    from workers.dispatcher import run

    settings = read_settings(data_dir=data_dir)
    return run(settings.store_url, settings.data_dir, settings.ray_address, workers)


def migrate(data_dir: DataDir = None) -> None:
    """Bring the job store, MOTIONLABEL_DATABASE_URL or the one in DIR, to this version; once more changes nothing."""
    from workers.jobs.database import migrate_database

    migration = migrate_database(read_settings(data_dir=data_dir).store_url)
    typer.echo(migration.describe())
