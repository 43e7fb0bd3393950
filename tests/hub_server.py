"""The Hub's HTTP protocol on loopback, as far as huggingface_hub uses it for repositories without Xet.

No package on the index serves it: the one that says so is a client of a server that it does not contain. This one
keeps repositories in memory and speaks what huggingface_hub 1.33 sends: create, preupload, LFS batch with basic
transfer, NDJSON commits, tree, revision, refs, tags and resolve, with the Hub's status codes and `X-Error-Code`.
"""

import base64
import hashlib
import json
import re
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

TOKENS = {"hf_" + "r" * 34: "alice"}
"""Valid tokens and their users; a user may write to names of her own."""


@dataclass
class Repo:
    """Commits are {path: (blob id, in LFS)}; branches and tags point to them."""

    private: bool
    commits: dict[str, dict[str, tuple[str, bool]]] = field(default_factory=lambda: {"0" * 40: {}})
    branches: dict[str, str] = field(default_factory=lambda: {"main": "0" * 40})
    tags: dict[str, str] = field(default_factory=dict)

    def resolve(self, revision: str) -> str | None:
        oid = self.branches.get(revision) or self.tags.get(revision)
        return oid or (revision if revision in self.commits else None)


@dataclass
class Hub:
    """What the server holds, and the switch that cuts connections: uploads still let through, None for all."""

    url: str = ""
    repos: dict[str, Repo] = field(default_factory=dict)
    blobs: dict[str, bytes] = field(default_factory=dict)
    uploads_left: int | None = None
    uploads: list[str] = field(default_factory=list)


@contextmanager
def serve():
    """Run a Hub on a free port of loopback; yields it."""
    hub = Hub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Bound", (Handler,), {"hub": hub}))
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield hub
    server.shutdown()
    server.server_close()


class RefusedError(Exception):
    def __init__(self, status: int, message: str, code: str | None = None, **more: str):
        super().__init__(message)
        self.status, self.code, self.more = status, code, more


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, *arguments):
        pass

    def do_GET(self):  # noqa: N802
        self._answer()

    do_HEAD = do_POST = do_PUT = do_DELETE = do_GET  # noqa: N815

    def _answer(self):
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        path = unquote(urlsplit(self.path).path)
        verb = "GET" if self.command == "HEAD" else self.command
        try:
            for route_verb, pattern, action in ROUTES:
                match = re.fullmatch(pattern, path)
                if verb == route_verb and match:
                    return action(self, body, **match.groupdict())
            raise RefusedError(404, f"No such route: {verb} {path}")
        except RefusedError as error:
            headers = {"X-Error-Code": error.code} if error.code else {}
            self._send(error.status, {"error": str(error), **error.more}, headers | {"X-Error-Message": str(error)})

    def _send(self, status, content=b"", headers=None):
        content = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    # Who may do what

    def _user(self) -> str | None:
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        if token and token not in TOKENS:
            raise RefusedError(401, "Invalid credentials in Authorization header")
        return TOKENS.get(token)

    def _writer(self, name: str) -> None:
        user = self._user()
        if user is None:
            raise RefusedError(401, "Invalid username or password.")
        if name.split("/")[0] != user:
            raise RefusedError(403, "You don't have the rights to create a repo or to write under this namespace")

    def _repo(self, kind: str, name: str) -> Repo:
        user, repo = self._user(), self.hub.repos.get(f"{kind}/{name}")
        if repo is None or (repo.private and user != name.split("/")[0]):
            raise RefusedError(404 if user else 401, "Repository not found", "RepoNotFound")
        return repo

    def _files(self, kind: str, name: str, revision: str) -> tuple[str, dict]:
        repo = self._repo(kind, name)
        oid = repo.resolve(revision)
        if oid is None:
            raise RefusedError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return oid, repo.commits[oid]

    # Routes

    def whoami(self, body):
        user = self._user()
        if user is None:
            raise RefusedError(401, "Invalid username or password.")
        self._send(200, {"type": "user", "name": user, "orgs": [], "auth": {"accessToken": {"role": "write"}}})

    def create(self, body):
        wish = json.loads(body)
        self._user()
        name = f"{wish.get('organization') or self._user()}/{wish['name']}"
        self._writer(name)
        kind = wish.get("type", "model") + "s"
        url = f"{self.hub.url}/{'' if kind == 'models' else kind + '/'}{name}"
        if f"{kind}/{name}" in self.hub.repos:
            raise RefusedError(409, "You already created this repo", url=url)
        private = wish.get("private") or wish.get("visibility") == "private"
        self.hub.repos[f"{kind}/{name}"] = Repo(bool(private))
        self._send(200, {"url": url, "name": name, "id": name})

    def info(self, body, kind, name, revision="main"):
        oid, files = self._files(kind, name, revision)
        siblings = [{"rfilename": path} for path in files]
        private = self._repo(kind, name).private
        self._send(200, {"id": name, "sha": oid, "private": private, "tags": [], "siblings": siblings})

    def tree(self, body, kind, name, revision):
        _, files = self._files(kind, name, revision)
        self._send(200, [self._entry(path, *place) for path, place in files.items()])

    def _entry(self, path, blob, lfs):
        size = len(self.hub.blobs[blob])
        entry = {"type": "file", "path": path, "size": size, "oid": blob[:40]}
        return entry | ({"lfs": {"oid": blob, "size": size, "pointerSize": 130}} if lfs else {})

    def refs(self, body, kind, name):
        repo = self._repo(kind, name)
        lists = {"branches": (repo.branches, "heads"), "tags": (repo.tags, "tags")}
        self._send(
            200,
            {
                key: [{"name": ref, "ref": f"refs/{folder}/{ref}", "targetCommit": oid} for ref, oid in refs.items()]
                for key, (refs, folder) in lists.items()
            }
            | {"converts": []},
        )

    def tag(self, body, kind, name, revision):
        self._writer(name)
        oid, _ = self._files(kind, name, revision)
        tags, wanted = self._repo(kind, name).tags, json.loads(body)["tag"]
        if wanted in tags:
            raise RefusedError(409, "Tag reference exists already")
        tags[wanted] = oid
        self._send(200, {})

    def untag(self, body, kind, name, revision):
        self._writer(name)
        if self._repo(kind, name).tags.pop(revision, None) is None:
            raise RefusedError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        self._send(200, {})

    def preupload(self, body, kind, name, revision):
        self._writer(name)
        self._files(kind, name, revision)
        large = (".parquet", ".mp4", ".safetensors", ".png")
        modes = [
            {
                "path": file["path"],
                "uploadMode": "lfs" if file["path"].endswith(large) else "regular",
                "shouldIgnore": False,
                "oid": None,
            }
            for file in json.loads(body)["files"]
        ]
        self._send(200, {"files": modes})

    def lfs_batch(self, body, kind, name):
        self._writer(name)
        objects = []
        for wanted in json.loads(body)["objects"]:
            actions = {"upload": {"href": f"{self.hub.url}/lfs/{wanted['oid']}"}}
            objects.append(wanted | ({} if wanted["oid"] in self.hub.blobs else {"actions": actions}))
        self._send(200, {"transfer": "basic", "objects": objects})

    def lfs_put(self, body, oid):
        if self.hub.uploads_left == 0:
            self.close_connection = True
            self.connection.close()
            return
        if self.hub.uploads_left is not None:
            self.hub.uploads_left -= 1
        if hashlib.sha256(body).hexdigest() != oid:
            raise RefusedError(400, "The content is not what its hash says")
        self.hub.blobs[oid] = body
        self.hub.uploads.append(oid)
        self._send(200)

    def commit(self, body, kind, name, revision):
        self._writer(name)
        oid, files = self._files(kind, name, revision)
        files = dict(files)
        for operation in map(json.loads, body.splitlines()):
            value = operation["value"]
            match operation["key"]:
                case "file":
                    content = base64.b64decode(value["content"])
                    blob = hashlib.sha256(content).hexdigest()
                    self.hub.blobs[blob] = content
                    files[value["path"]] = (blob, False)
                case "lfsFile":
                    if value["oid"] not in self.hub.blobs:
                        raise RefusedError(400, f"LFS object of {value['path']} was never uploaded")
                    files[value["path"]] = (value["oid"], True)
                case "deletedFile":
                    files.pop(value["path"], None)
        repo = self._repo(kind, name)
        new = hashlib.sha1((oid + json.dumps(sorted(files.items()))).encode()).hexdigest()
        repo.commits[new] = files
        repo.branches[revision] = new
        self._send(200, {"commitUrl": f"{self.hub.url}/{name}/commit/{new}", "commitOid": new})

    def download(self, body, name, revision, path, kind="models"):
        oid, files = self._files(kind or "models", name, revision)
        if path not in files:
            raise RefusedError(404, "Entry not found", "EntryNotFound")
        blob = files[path][0]
        self._send(200, self.hub.blobs[blob], {"ETag": f'"{blob}"', "X-Repo-Commit": oid})

    def check_yaml(self, body):
        self._send(200, {"errors": [], "warnings": []})


NAME = r"(?P<name>[\w.-]+/[\w.-]+)"
API = rf"/api/(?P<kind>\w+)/{NAME}"
REVISION = r"(?P<revision>[^/]+)"
ROUTES = [
    ("GET", "/api/whoami-v2", Handler.whoami),
    ("POST", "/api/repos/create", Handler.create),
    ("POST", "/api/validate-yaml", Handler.check_yaml),
    ("GET", API, Handler.info),
    ("GET", f"{API}/revision/{REVISION}", Handler.info),
    ("GET", f"{API}/tree/{REVISION}", Handler.tree),
    ("GET", f"{API}/refs", Handler.refs),
    ("POST", f"{API}/tag/{REVISION}", Handler.tag),
    ("DELETE", f"{API}/tag/{REVISION}", Handler.untag),
    ("POST", f"{API}/preupload/{REVISION}", Handler.preupload),
    ("POST", f"{API}/commit/{REVISION}", Handler.commit),
    ("POST", rf"/(?:(?P<kind>datasets|spaces)/)?{NAME}\.git/info/lfs/objects/batch", Handler.lfs_batch),
    ("PUT", r"/lfs/(?P<oid>\w+)", Handler.lfs_put),
    ("GET", rf"/(?:(?P<kind>datasets)/)?{NAME}/resolve/{REVISION}/(?P<path>.+)", Handler.download),
]
