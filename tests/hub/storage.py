"""Storage of the Hub server on loopback: repositories, commits and files."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

LFS_SUFFIXES = (".parquet", ".safetensors", ".png", ".mp4")
LFS_SIZE = 1_000_000  # bytes; a larger file is stored in LFS whatever its name
GITATTRIBUTES = "".join(f"*{suffix} filter=lfs diff=lfs merge=lfs -text\n" for suffix in LFS_SUFFIXES)


class HubError(Exception):
    """A reply with a status other than 200; the client chooses its exception by `code`."""

    def __init__(
        self, status: int, message: str, code: str = "", headers: dict[str, str] | None = None, **body: Any
    ) -> None:
        super().__init__(message)
        self.status = status
        self.headers = {"X-Error-Message": message} | ({"X-Error-Code": code} if code else {}) | (headers or {})
        self.body = {"error": message} | body


@dataclass(frozen=True)
class Blob:
    """A file's content; for a file in LFS, git holds only a pointer."""

    content: bytes
    is_lfs: bool = False

    @cached_property
    def sha256(self) -> str:
        return hashlib.sha256(self.content).hexdigest()

    @cached_property
    def pointer(self) -> bytes:
        size = len(self.content)
        return f"version https://git-lfs.github.com/spec/v1\noid sha256:{self.sha256}\nsize {size}\n".encode()

    @cached_property
    def oid(self) -> str:
        return git_hash(self.pointer if self.is_lfs else self.content)

    @property
    def etag(self) -> str:
        """Hash that the client compares with that of its own file."""
        return self.sha256 if self.is_lfs else self.oid


@dataclass(frozen=True)
class Commit:
    """A snapshot of all files; equal histories have equal `oid`s on every server."""

    files: dict[str, Blob]
    title: str
    parent: Commit | None = None

    @cached_property
    def oid(self) -> str:
        tree = {path: blob.oid for path, blob in self.files.items()}
        return git_hash(json.dumps([self.parent and self.parent.oid, self.title, tree], sort_keys=True).encode())


@dataclass
class Repo:
    """A model's or a dataset's repository."""

    kind: str
    repo_id: str
    private: bool
    branches: dict[str, Commit] = field(default_factory=dict)
    tags: dict[str, Commit] = field(default_factory=dict)
    commits: dict[str, Commit] = field(default_factory=dict)
    objects: dict[str, bytes] = field(default_factory=dict)  # LFS objects by SHA-256, committed or not

    def __post_init__(self) -> None:
        self.add("main", Commit({".gitattributes": Blob(GITATTRIBUTES.encode())}, "initial commit"))

    def add(self, branch: str, commit: Commit) -> None:
        self.branches[branch] = self.commits[commit.oid] = commit

    def at(self, revision: str) -> Commit:
        for commits in (self.branches, self.tags, self.commits):
            if revision in commits:
                return commits[revision]
        raise HubError(404, f"Invalid rev id: {revision}", "RevisionNotFound")


def git_hash(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
