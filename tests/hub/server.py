"""A Hugging Face Hub server on loopback, in memory, for the real `huggingface_hub` client and LeRobot.

    with HubServer() as hub, online(hub, ALICE):  # client in this process
        HfApi().create_repo("alice/demo", repo_type="dataset")
    with HubServer() as hub:  # client in another process
        subprocess.run(command, env=os.environ | hub.environment(ALICE))

The client reads HF_ENDPOINT and HF_HUB_OFFLINE once, at import, and modules keep copies of them. `online` therefore
leaves the endpoint unchanged: the client sends requests to https://huggingface.co and its HTTP transport delivers them
to this server, which uses the host name of the request in its replies. Another process gets the variables before its
imports. There, `RepoCard.validate` (in LeRobot's `push_to_hub`) still contacts the real Hub at a hard-coded address,
and a broken upload is retried for 23 s before it fails.

Unlike the Hub, this server sends LFS files without a redirect, ignores range requests, lists everything on one page,
accepts every card, and gates no repository. It answers unsupported requests with 501, among them Xet, pull requests,
spaces, and copying, moving and configuring repositories.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import secrets
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from tests.hub.storage import LFS_SIZE, LFS_SUFFIXES, Blob, Commit, HubError, Repo, git_hash

ALICE, BOB = "hf_alice", "hf_bob"  # tokens of the default users


class HubServer(ThreadingHTTPServer):
    """The server. It runs inside a `with` block and keeps its data in memory.

    Attributes:
        url: Address of the server, for `HF_ENDPOINT` or `HfApi(endpoint=...)`.
        users: Token -> user name and the namespaces that the token may write to.
        repos: Repositories, by kind (`model` or `dataset`) and id.
        requests: Method and path, without the query, of every request.
        lfs_uploads: SHA-256 of every received object, in order.
        fail_uploads_after: Number of received objects after which the connections of further uploads break.
    """

    request_queue_size = 64  # the client connects from many threads at once

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.url = f"http://127.0.0.1:{self.server_port}"
        self.users: dict[str, tuple[str, set[str]]] = {ALICE: ("alice", {"alice"}), BOB: ("bob", {"bob"})}
        self.repos: dict[tuple[str, str], Repo] = {}
        self.requests: list[tuple[str, str]] = []
        self.lfs_uploads: list[str] = []
        self.fail_uploads_after: int | None = None
        self.lock = threading.Lock()
        self.signed: dict[str, tuple[Repo, str]] = {}  # random upload key -> repository and SHA-256 of the object
        self.thread = threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True)

    def __enter__(self) -> HubServer:
        self.thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.shutdown()
        self.server_close()
        self.thread.join()

    def files(self, repo_id: str, kind: str = "dataset", revision: str = "main") -> dict[str, bytes]:
        """Path -> content of every file of a revision."""
        return {path: blob.content for path, blob in self.repos[kind, repo_id].at(revision).files.items()}

    def environment(self, token: str | None) -> dict[str, str]:
        """Environment variables that connect another process to this server."""
        off = {"HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1"}
        return off | {"HF_ENDPOINT": self.url, "HF_TOKEN": token or "", "no_proxy": "127.0.0.1"}


ROUTES: list[tuple[str, re.Pattern[str], bool, Callable[..., Any]]] = []
API = r"/api/(?P<kind>model|dataset)s/(?P<repo_id>[^/]+/[^/]+)"
WEB = r"/(?P<kind>datasets/)?(?P<repo_id>[^/]+/[^/]+)"
REVISION = r"(?P<revision>[^/]+)"


def route(method: str, pattern: str, write: bool = False) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function for requests; where its pattern names a repository, it gets the readable `Repo`."""

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        ROUTES.append((method, re.compile(pattern), write, function))
        return function

    return register


class _Handler(BaseHTTPRequestHandler):
    server: HubServer
    protocol_version = "HTTP/1.1"  # connections stay open, as the client expects
    wbufsize = -1  # headers and body are sent together, without waiting for an acknowledgement in between

    def answer(self) -> None:
        address = urlsplit(self.path)
        self.query = parse_qs(address.query)
        self.body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        status, headers = 200, {}
        with self.server.lock:
            self.server.requests.append((self.command, address.path))
            try:
                reply = self.dispatch(address.path)
            except HubError as error:
                status, headers, reply = error.status, error.headers, error.body
            except ConnectionAbortedError:
                self.close_connection = True
                return
        if isinstance(reply, tuple):
            content, headers = reply
        else:
            content, headers = json.dumps(reply).encode(), headers | {"Content-Type": "application/json"}
        self.send_response(status)
        for name, value in (headers | {"Content-Length": str(len(content))}).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = answer  # noqa: N815

    def log_message(self, *arguments: object) -> None:
        pass

    def dispatch(self, path: str) -> Any:
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if token and token not in self.server.users:
            raise HubError(401, "Invalid credentials in Authorization header")
        self.user, self.namespaces = self.server.users.get(token, (None, set()))
        for method, pattern, write, function in ROUTES:
            match = pattern.fullmatch(path)
            if match and method == self.command.replace("HEAD", "GET"):
                named = {name: unquote(value or "") for name, value in match.groupdict().items()}
                if "repo_id" in named:
                    kind = named.pop("kind").removesuffix("s/") or "model"
                    named["repo"] = self.repo(kind, named.pop("repo_id"), write)
                return function(self, **named)
        raise HubError(501, f"this server does not support {self.command} {path}")

    def repo(self, kind: str, repo_id: str, write: bool) -> Repo:
        """Return a repository that the user may read; others' private repositories are reported as missing."""
        repo, owner = self.server.repos.get((kind, repo_id)), repo_id.split("/")[0]
        if repo is None or (repo.private and owner not in self.namespaces | {self.user}):
            raise HubError(404 if self.user else 401, "Repository not found", "RepoNotFound")
        if write:
            self.check_write(owner)
        return repo

    def check_write(self, namespace: str) -> None:
        if self.user is None:
            raise HubError(401, "Invalid username or password.")
        if namespace not in self.namespaces:
            raise HubError(403, f'You don\'t have the rights to write under the namespace "{namespace}"')

    @property
    def origin(self) -> str:
        host = self.headers["Host"]
        return f"https://{host}" if host == "huggingface.co" else f"http://{host}"

    def address(self, repo: Repo) -> str:
        return f"{self.origin}/{'datasets/' if repo.kind == 'dataset' else ''}{repo.repo_id}"

    @route("GET", "/api/whoami-v2")
    def whoami(self) -> Any:
        if self.user is None:
            raise HubError(401, "Invalid username or password.")
        organizations = [{"type": "org", "name": name} for name in sorted(self.namespaces - {self.user})]
        role = "write" if self.namespaces else "read"
        auth = {"type": "access_token", "accessToken": {"displayName": "test", "role": role}}
        return {"type": "user", "name": self.user, "fullname": self.user, "orgs": organizations, "auth": auth}

    @route("POST", "/api/validate-yaml")
    def validate_card(self) -> Any:
        return {"errors": [], "warnings": []}

    @route("POST", "/api/repos/create")
    def create_repo(self) -> Any:
        wanted = json.loads(self.body)
        namespace, kind = wanted.get("organization") or self.user, wanted.get("type", "model")
        self.check_write(namespace)
        if kind not in ("model", "dataset"):
            raise HubError(501, f"this server does not support a {kind}")
        repo = Repo(kind, f"{namespace}/{wanted['name']}", wanted.get("visibility") == "private")
        if (kind, repo.repo_id) in self.server.repos:
            raise HubError(409, f"You already created this {kind} repo", url=self.address(repo))
        self.server.repos[kind, repo.repo_id] = repo
        return {"url": self.address(repo), "name": repo.repo_id}

    @route("GET", f"{API}(?:/revision/{REVISION})?")
    def info(self, repo: Repo, revision: str) -> Any:
        commit = repo.at(revision or "main")
        siblings = [{"rfilename": path} for path in sorted(commit.files)]
        return {"id": repo.repo_id, "sha": commit.oid, "private": repo.private, "tags": [], "siblings": siblings}

    @route("GET", f"{API}/refs")
    def refs(self, repo: Repo) -> Any:
        branches, tags = (
            [{"name": name, "ref": f"refs/{kind}/{name}", "targetCommit": commit.oid} for name, commit in refs.items()]
            for kind, refs in (("heads", repo.branches), ("tags", repo.tags))
        )
        return {"branches": branches, "tags": tags, "converts": []}

    @route("GET", f"{API}/tree/{REVISION}(?:/(?P<folder>.+))?")
    def tree(self, repo: Repo, revision: str, folder: str) -> Any:
        prefix = f"{folder}/" if folder else ""
        inside = {path: blob for path, blob in repo.at(revision).files.items() if path.startswith(prefix)}
        if not inside:
            raise HubError(404, f"{folder} does not exist on {revision}", "EntryNotFound")
        parents = {parent.as_posix() for path in inside for parent in Path(path).parents}
        entries: list[dict[str, Any]] = [
            {"type": "directory", "path": path, "oid": git_hash(path.encode()), "size": 0}
            for path in sorted(parents - {"."})
            if path.startswith(prefix)
        ]
        for path, blob in sorted(inside.items()):
            entry = {"type": "file", "path": path, "oid": blob.oid, "size": len(blob.content)}
            lfs = {"oid": blob.sha256, "size": len(blob.content), "pointerSize": len(blob.pointer)}
            entries.append(entry | ({"lfs": lfs} if blob.is_lfs else {}))
        recursive = self.query.get("recursive") == ["true"]
        return [entry for entry in entries if recursive or "/" not in entry["path"].removeprefix(prefix)]

    @route("GET", f"{WEB}/resolve/{REVISION}/(?P<path>.+)")
    def resolve(self, repo: Repo, revision: str, path: str) -> Any:
        commit = repo.at(revision)
        headers = {"X-Repo-Commit": commit.oid}
        if path not in commit.files:
            raise HubError(404, "Entry not found", "EntryNotFound", headers)
        blob = commit.files[path]
        return blob.content, headers | {"ETag": f'"{blob.etag}"', "Content-Type": "application/octet-stream"}

    @route("POST", f"{API}/branch/(?P<branch>[^/]+)", write=True)
    def create_branch(self, repo: Repo, branch: str) -> Any:
        if branch in repo.branches:
            raise HubError(409, f"Reference already exists: {branch}")
        repo.branches[branch] = repo.at(json.loads(self.body).get("startingPoint", "main"))
        return {}

    @route("POST", f"{API}/tag/{REVISION}", write=True)
    def create_tag(self, repo: Repo, revision: str) -> Any:
        tag = json.loads(self.body)["tag"]
        commit = repo.at(revision)
        if repo.tags.setdefault(tag, commit) is not commit:
            raise HubError(409, f"Tag reference exists already: {tag}")
        return {}

    @route("DELETE", f"{API}/tag/(?P<tag>[^/]+)", write=True)
    def delete_tag(self, repo: Repo, tag: str) -> Any:
        if repo.tags.pop(tag, None) is None:
            raise HubError(404, f"Tag not found: {tag}", "RevisionNotFound")
        return {}

    @route("POST", f"{API}/preupload/{REVISION}", write=True)
    def preupload(self, repo: Repo, revision: str) -> Any:
        files, there = json.loads(self.body)["files"], repo.at(revision).files
        for file in files:
            path = file["path"]
            file["uploadMode"] = "lfs" if path.endswith(LFS_SUFFIXES) or file["size"] > LFS_SIZE else "regular"
            file["shouldIgnore"] = False
            file["oid"] = there[path].etag if path in there else None
        return {"files": files}

    @route("POST", f"{WEB}.git/info/lfs/objects/batch", write=True)
    def lfs_batch(self, repo: Repo) -> Any:
        wanted = {item["oid"]: item for item in json.loads(self.body)["objects"]}
        for oid in wanted.keys() - repo.objects.keys():  # existing objects get no action: they are not uploaded again
            key = secrets.token_hex()
            self.server.signed[key] = repo, oid
            wanted[oid]["actions"] = {"upload": {"href": f"{self.origin}/lfs/{key}"}}
        return {"transfer": "basic", "objects": list(wanted.values())}

    @route("PUT", r"/lfs/(?P<key>\w+)")
    def lfs_upload(self, key: str) -> Any:
        hub = self.server
        if hub.fail_uploads_after is not None and len(hub.lfs_uploads) >= hub.fail_uploads_after:
            raise ConnectionAbortedError
        repo, oid = hub.signed.get(key, (None, None))
        if repo is None or hashlib.sha256(self.body).hexdigest() != oid:
            raise HubError(400, "The content does not match its SHA-256")
        repo.objects[oid] = self.body
        hub.lfs_uploads.append(oid)
        return {}

    @route("POST", f"{API}/commit/{REVISION}", write=True)
    def commit(self, repo: Repo, revision: str) -> Any:
        if revision not in repo.branches:
            raise HubError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        if "create_pr" in self.query:
            raise HubError(501, "this server does not support pull requests")
        parent = repo.branches[revision]
        files, header = dict(parent.files), {}
        for line in self.body.splitlines():
            key, value = (item := json.loads(line))["key"], item["value"]
            path = value.get("path", "")
            if key == "header":
                header = value
            elif key == "file":
                files[path] = Blob(base64.b64decode(value["content"]))
            elif key == "lfsFile" and value["oid"] in repo.objects:
                files[path] = Blob(repo.objects[value["oid"]], is_lfs=True)
            elif key == "lfsFile":
                raise HubError(400, f"{path} points to an LFS object that was not uploaded")
            elif key != "deletedFile":
                raise HubError(501, f"this server does not support {key}")
            elif files.pop(path, None) is None:
                raise HubError(404, f"A file with this name doesn't exist: {path}", "EntryNotFound")
        if header.get("parentCommit", parent.oid) != parent.oid:
            raise HubError(412, "A commit has happened since. Please refresh and try again.")
        commit = Commit(files, header["summary"], parent)
        repo.add(revision, commit)
        return {"success": True, "commitUrl": f"{self.address(repo)}/commit/{commit.oid}", "commitOid": commit.oid}
