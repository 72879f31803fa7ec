"""Where jobs may read and write: only under the data roots, by one canonical name."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from schemas.errors import InvalidInput

SYNTHETIC: Final = "synthetic:"
_S3: Final = "s3://"
_CONTROL: Final = r"[\x00-\x1f\x7f]"


def locate(uri: str, roots: Sequence[str]) -> str:
    """Return the canonical name of a folder that lies under one of ``roots`` (see ``canonical_root``).

    Local folders come back as absolute paths with symbolic links resolved, whether given as a path or as ``file://``.

    Raises:
        InvalidInput: The folder lies elsewhere, or its name is relative, has "..", or is of an unknown kind.

    """
    place = _canonical(uri)
    if not any(_is_under(place, root) for root in roots):
        allowed = ", ".join(roots) or "none is set"
        raise InvalidInput(
            f"{uri} lies under no data root ({allowed}): MOTIONLABEL_DATA_ROOTS of the server names them"
        )
    return place


def locate_segment(uri: str, roots: Sequence[str]) -> str:
    """Return the canonical name of a segment; ``synthetic:`` ones need no root. Raises as ``locate``."""
    return uri if uri.startswith(SYNTHETIC) else locate(uri, roots)


def absolute(uri: str) -> str:
    """Return a local path made absolute, for a service that runs in another folder; URIs stay as they are."""
    return uri if re.match(r"[a-z0-9]+:", uri) else os.path.abspath(Path(uri).expanduser())  # noqa: PTH100 - links stay


def canonical_root(root: str) -> str:
    """Return the canonical name of a data root, which may be given relative to the current folder."""
    return _canonical(root if root.startswith((_S3, "file:")) else os.path.realpath(Path(root).expanduser()))


def _canonical(uri: str) -> str:
    if uri.startswith(_S3):
        return _canonical_s3(uri)
    path = _local_path(uri)
    if re.search(_CONTROL, path):
        raise InvalidInput(f"{uri!r} has control characters: expected an absolute path")
    if not path.startswith("/"):
        raise InvalidInput(f"{uri}: expected an absolute path, file:///path or s3://bucket/prefix")
    if ".." in path.split("/"):
        raise InvalidInput(f'{uri} has "..": give the folder itself')
    return os.path.realpath(path)


def _local_path(uri: str) -> str:
    if not uri.startswith("file:"):
        return uri
    parts = urlsplit(uri)
    if parts.netloc not in ("", "localhost") or parts.query or parts.fragment:
        raise InvalidInput(f"{uri}: expected file:///path, without host, query or fragment")
    return unquote(parts.path)


def _canonical_s3(uri: str) -> str:
    parts = uri.removeprefix(_S3).removesuffix("/").split("/")
    if not all(parts) or {".", ".."} & set(parts) or re.search(rf"[%?#\\]|{_CONTROL}", uri):
        raise InvalidInput(f"{uri!r}: expected s3://bucket/prefix, without empty parts, '.', '..', '%', '?', '#'")
    return _S3 + "/".join(parts)


def _is_under(place: str, root: str) -> bool:
    return place == root or place.startswith(root.rstrip("/") + "/")
