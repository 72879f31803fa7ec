"""One grammar of places: where files lie, however somebody writes it.

A place is a local folder or file, or a bucket with a prefix. It is written as ``/path``, ``file:///path`` or
``s3://bucket/prefix``; on a user's own machine also relative to the current folder, or as ``~/path``. Its canonical
name is an absolute path without links, or ``s3://bucket/prefix``: places are kept and compared by it. A ``synthetic:``
segment is no place.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from schemas.errors import InvalidInput

S3: Final = "s3://"
_CONTROL: Final = r"[\x00-\x1f\x7f]"


def canonical(place: str) -> str:
    """Return the one name of a place.

    Links are followed, percent signs decoded in ``file://`` URIs only, and slashes at the end are dropped.

    Raises:
        InvalidInput: The name is relative, has "..", or is of an unknown kind.

    """
    if place.startswith(S3):
        return _canonical_s3(place)
    path = _local_path(place)
    if re.search(_CONTROL, path):
        raise InvalidInput(f"{place!r} has control characters: expected an absolute path")
    if not path.startswith("/"):
        raise InvalidInput(f"{place}: expected an absolute path, file:///path or s3://bucket/prefix")
    if ".." in path.split("/"):
        raise InvalidInput(f'{place} has "..": give the folder itself')
    return os.path.realpath(path)


def absolute(place: str) -> str:
    """Return what a user wrote on this machine as a name that other processes understand; URIs stay as they are.

    Links stay too, for a service may have other ones: only a path with ".." is resolved here.
    """
    if not place or "://" in place or place.startswith(("file:", "synthetic:")):
        return place
    path = os.path.expanduser(place)  # noqa: PTH111 - Path's raises for an unknown user
    return os.path.realpath(path) if ".." in path.split("/") else os.path.abspath(path)  # noqa: PTH100 - links stay


def under_root(place: str, roots: Sequence[str]) -> str:
    """Return the canonical name of a place that lies under one of ``roots``, which are canonical names themselves.

    Raises:
        InvalidInput: It lies elsewhere, or as ``canonical``.

    """
    name = canonical(place)
    if not any(is_below(name, root) for root in roots):
        allowed = ", ".join(roots) or "none is set"
        raise InvalidInput(
            f"{place} lies under no data root ({allowed}): "
            "MOTIONLABEL_DATA_ROOTS of the server names them; an API key may name fewer"
        )
    return name


def is_below(place: str, root: str) -> bool:
    """Return whether a canonical place is another one, or lies below it."""
    return place == root or place.startswith(root.rstrip("/") + "/")


def join(place: str, *names: str) -> str:
    """Return what lies below a canonical place."""
    return "/".join([place.rstrip("/"), *names])


def split(place: str) -> tuple[str, str]:
    """Return the place that a canonical one lies in, and its name there; a bucket lies in itself and has no name."""
    parent, _, name = place.rpartition("/")
    return (place, "") if parent + "/" == S3 else (parent or "/", name)


def as_uri(place: str) -> str:
    """Return a canonical place as a URI."""
    return place if place.startswith(S3) else Path(place).as_uri()


def _local_path(place: str) -> str:
    if not place.startswith("file:"):
        return place
    parts = urlsplit(place)
    if parts.netloc not in ("", "localhost") or parts.query or parts.fragment:
        raise InvalidInput(f"{place}: expected file:///path, without host, query or fragment")
    return unquote(parts.path)


def _canonical_s3(place: str) -> str:
    parts = place.removeprefix(S3).removesuffix("/").split("/")
    if not all(parts) or {".", ".."} & set(parts) or re.search(rf"[%?#\\]|{_CONTROL}", place):
        raise InvalidInput(f"{place!r}: expected s3://bucket/prefix, without empty parts, '.', '..', '%', '?', '#'")
    return S3 + "/".join(parts)
