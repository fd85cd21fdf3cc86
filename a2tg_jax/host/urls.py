"""URLs of scenes: places of this machine behind file://, and secrets that no URL may hold."""

import re
import urllib.request
from pathlib import Path

URL = re.compile(r"[A-Za-z][\w+.:-]+://")
USER = re.compile(r"([\w+.-]+)://([^/]*)@")
"""Scheme, and what precedes the host; in chained URLs too."""
QUERY = re.compile(r"(https?://[^?]*)\?.+", re.IGNORECASE | re.DOTALL)
REVISIONS = ("git", "github")
"""Schemes that write an owner, a repository and a revision where others have a user and a password."""


def is_url(text: str) -> bool:
    """Return whether a text is a URL, such as s3://bucket/scene."""
    return URL.match(text) is not None


def path_here(text: str) -> Path | None:
    """Return the path on this machine that a text means, file:// included; None for the URL of a store.

    Raises:
      ValueError: if file:// has a host, or no path.
    """
    if not is_url(text):
        return Path(text)
    scheme, _, place = text.partition("://")
    if scheme.lower() != "file":
        return None
    host, _, path = place.partition("/")
    if host.lower() not in ("", "localhost") or not path:
        raise ValueError(f"{text}: is no file of this machine; write file:///full/path")
    return Path(urllib.request.url2pathname(f"/{path}"))


def checked_url(url: str) -> str:
    """Return the URL of a store, without slashes at its end.

    Raises:
      ValueError: if it holds a secret, which is left out of the message, or names no folder.
    """
    told = without_secrets(url)
    if told != url:
        raise ValueError(
            f"{told}: has a password, token or signature, which the run folder would keep; leave it out, and give it "
            "in fsspec's configuration (~/.config/fsspec)"
        )
    kept = url.rstrip("/")
    if kept.endswith(":"):
        raise ValueError(f"{url}: names no folder; write {kept}//bucket/scene")
    return kept


def without_secrets(url: str) -> str:
    """Return a URL with "…" for passwords, and for users and queries of web addresses."""
    return QUERY.sub(r"\1?…", USER.sub(_without_password, url))


def _without_password(match: re.Match[str]) -> str:
    scheme, (user, colon, _) = match[1], match[2].partition(":")
    if scheme.lower().endswith(("http", "https")):
        return f"{scheme}://…@"
    return f"{scheme}://{user}:…@" if colon and scheme.lower() not in REVISIONS else match[0]
