"""`motionlabel init-folder`."""

from typing import Annotated

import typer


def init_folder(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Folder of sweeps: a path or s3://bucket/prefix.")],
    is_forced: Annotated[bool, typer.Option("--force", help="Write it anew where there is one.")] = False,
) -> None:
    """Write motionlabel.yaml into a folder of sweeps: how it is to be read, and how sure each line is."""
    from labeling.readers.files import open_folder
    from labeling.readers.folder.proposal import write_proposal
    from labeling.readers.reader import canonical_segment
    from labeling.storage import places

    storage = open_folder(canonical_segment("folder", places.absolute(folder)), "folder")
    for line in write_proposal(storage, is_forced=is_forced):
        typer.echo(line.text)
