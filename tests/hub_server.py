"""A Hugging Face Hub on the loopback, in memory: what the real, unmodified client asks of one, and faults on demand.

It speaks the interface that huggingface_hub 1.33 calls without the xet protocol (set HF_HUB_DISABLE_XET=1): whoami,
create, validate-yaml, info, tree, paths-info, refs, tags, preupload, commits, LFS batch, upload and verification, and
downloads, large files by way of a redirect to another host name as on the real Hub. A commit is applied whole or not
at all, and only if every large file that it names has arrived and has the right hash.
"""

import base64
import contextlib
import fnmatch
import hashlib
import json
import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import NamedTuple
from urllib.parse import parse_qs, unquote, urlsplit

import yaml

# As in the .gitattributes of a new repository
LARGE = ("*.safetensors", "*.parquet", "*.png", "*.bin", "*.mp4")
VERSIONED = r"/api/(?P<kind>model|dataset)s/(?P<id>[^/]+/[^/]+)"


class File(NamedTuple):
    data: bytes
    large: bool

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.data).hexdigest()

    @property
    def oid(self) -> str:
        """As git names it: the hash of the content, of a large file that of its pointer."""
        data = self.data
        if self.large:
            data = f"version https://git-lfs.github.com/spec/v1\noid sha256:{self.sha256}\nsize {len(data)}\n".encode()
        return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()

    @property
    def etag(self) -> str:
        return self.sha256 if self.large else self.oid


@dataclass
class Repository:
    """Commits by hash, each the files of its whole tree; what has been uploaded but belongs to no commit is `large`."""

    private: bool
    commits: dict[str, dict[str, File]] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    large: dict[str, bytes] = field(default_factory=dict)

    def commit(self, files: dict[str, File], message: str) -> str:
        parent = self.branches.get("main", "")
        tree = "".join(f"{path} {file.oid}\n" for path, file in sorted(files.items()))
        oid = hashlib.sha1(f"{parent}\n{len(self.commits)}\n{message}\n{tree}".encode()).hexdigest()
        self.commits[oid] = files
        self.messages.append(message)
        self.branches["main"] = oid
        return oid

    def resolve(self, revision: str) -> str | None:
        """The commit that a branch, a tag or a hash names."""
        return (
            self.branches.get(revision) or self.tags.get(revision) or (revision if revision in self.commits else None)
        )

    @property
    def files(self) -> dict[str, bytes]:
        """What a reader of the main branch sees."""
        return {path: file.data for path, file in self.commits[self.branches["main"]].items()}


class Request(NamedTuple):
    method: str
    path: str
    host: str


@dataclass
class Fault:
    """What goes wrong with the next `times` requests whose "METHOD /path" matches: one of status, cut, damage, page,
    wait."""

    pattern: str
    times: int
    status: int | None  # answered in place of doing it
    cut: bool  # the connection ends in the middle of the body
    damage: bool  # a byte of the body is another one; its length and all headers are right
    page: bool  # a page of HTML with status 200, as the login page of a network gives to everybody
    wait: Callable[[], object] | None  # called first; then all goes on as it should


class Reply(Exception):
    """Ends a request."""

    def __init__(self, status: int, body: object = b"", **headers: str) -> None:
        self.status, self.headers = status, {name.replace("_", "-"): value for name, value in headers.items()}
        self.body = body if isinstance(body, bytes) else json.dumps(body).encode()


class Hub:
    """The server; `with Hub({"token": "me"}) as hub:` serves at `hub.endpoint` until the block ends.

    Args:
        users: Token -> name. A name may push to the repositories under it.
    """

    def __init__(self, users: dict[str, str]) -> None:
        self.users = users
        self.repositories: dict[tuple[str, str], Repository] = {}  # ("model" or "dataset", "ME/NAME")
        self.requests: list[Request] = []
        self.faults: list[Fault] = []
        self.lock = threading.RLock()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": self}))
        self._server.daemon_threads = True
        self.endpoint = f"http://127.0.0.1:{self._server.server_port}"
        self.storage = f"http://localhost:{self._server.server_port}"  # another host, to a client

    def __enter__(self) -> "Hub":
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def model(self, repo_id: str) -> Repository:
        return self.repositories["model", repo_id]

    def dataset(self, repo_id: str) -> Repository:
        return self.repositories["dataset", repo_id]

    @contextlib.contextmanager
    def fault(
        self,
        pattern: str,
        *,
        times: int = 1000,
        status: int | None = None,
        cut: bool = False,
        damage: bool = False,
        page: bool = False,
        wait: Callable[[], object] | None = None,
    ) -> Iterator[Fault]:
        """Requests whose "METHOD /path" matches `pattern` fail in this way until the block ends."""
        fault = Fault(pattern, times, status, cut, damage, page, wait)
        self.faults.append(fault)
        try:
            yield fault
        finally:
            self.faults.remove(fault)

    def next_fault(self, method: str, path: str) -> Fault | None:
        with self.lock:
            for fault in self.faults:
                if fault.times and re.search(fault.pattern, f"{method} {path}"):
                    fault.times -= 1
                    return fault
        return None


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:  # not on stderr: `Hub.requests` has it
        pass

    def _serve(self) -> None:
        self.address = urlsplit(self.path)
        self.data = self.rfile.read(int(self.headers.get("Content-Length") or 0)) or self._chunks()
        self.hub.requests.append(Request(self.command, self.address.path, self.headers.get("Host", "")))
        fault = self.hub.next_fault(self.command, self.address.path)
        try:
            if fault and fault.wait:
                fault.wait()
            if fault and fault.status:
                raise Reply(fault.status, {"error": "a fault of the test"})
            if fault and fault.page:
                raise Reply(200, b"<!doctype html><title>Log in</title>")
            with self.hub.lock:
                self._route()
            raise Reply(404, {"error": f"this server has no {self.command} {self.address.path}"})
        except Reply as reply:
            self._send(reply, fault)

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = _serve

    def _chunks(self) -> bytes:
        data = b""
        if self.headers.get("Transfer-Encoding", "") == "chunked":
            while size := int(self.rfile.readline().split(b";")[0], 16):
                data += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
        return data

    def _send(self, reply: Reply, fault: Fault | None) -> None:
        body = reply.body
        if fault and fault.damage and body:
            body = body[:-1] + bytes([body[-1] ^ 1])
        self.send_response(reply.status)
        self.send_header("Content-Length", str(len(body)))
        for name, value in reply.headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command == "HEAD":
            return
        if fault and fault.cut:
            body = body[: len(body) // 2]
            self.close_connection = True
        self.wfile.write(body)

    # --- Who asks, and for what ---------------------------------------------------------------------------------------

    def _user(self) -> str | None:
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if token and token not in self.hub.users:
            raise Reply(
                401, {"error": "Invalid credentials"}, X_Error_Message="Invalid credentials in Authorization header"
            )
        return self.hub.users.get(token)

    def _repository(self, kind: str, repo_id: str, *, write: bool = False) -> Repository:
        user = self._user()
        if write and user is None:
            raise Reply(401, {"error": "Unauthorized"}, X_Error_Message="Unauthorized")
        repository = self.hub.repositories.get((kind, repo_id))
        if repository is None or (repository.private and user != repo_id.split("/")[0]):
            raise Reply(404 if user else 401, {"error": "Repository not found"}, X_Error_Code="RepoNotFound")
        if write and user != repo_id.split("/")[0]:
            raise Reply(403, {"error": "Forbidden"}, X_Error_Message="You don't have the rights to write here")
        return repository

    def _commit(self, repository: Repository, revision: str) -> str:
        commit = repository.resolve(unquote(revision))
        if commit is None:
            raise Reply(404, {"error": f"Invalid rev id: {revision}"}, X_Error_Code="RevisionNotFound")
        return commit

    def _route(self) -> None:
        for method, pattern, serve in _ROUTES:
            match = re.fullmatch(pattern, self.address.path)
            if match and self.command in method:
                serve(self, **match.groupdict())

    # --- The account and its repositories -----------------------------------------------------------------------------

    def whoami(self) -> None:
        user = self._user()
        raise Reply(200, {"type": "user", "name": user, "orgs": []}) if user else Reply(401, {"error": "Unauthorized"})

    def validate_yaml(self) -> None:
        content = json.loads(self.data)["content"]
        try:
            metadata = yaml.safe_load(re.match(r"---\n(.*?)\n---\n", content, re.DOTALL)[1])
            assert isinstance(metadata, dict)
        except (yaml.YAMLError, TypeError, AssertionError) as error:
            raise Reply(400, {"errors": [{"message": f"metadata: {error}"}]}) from error
        raise Reply(200, {"errors": [], "warnings": []})

    def create(self) -> None:
        user, wanted = self._user(), json.loads(self.data)
        if user is None:
            raise Reply(401, {"error": "Unauthorized"})
        owner = wanted["organization"] or user
        if owner != user:
            raise Reply(
                403, {"error": "Forbidden"}, X_Error_Message=f"You don't have the rights to create under {owner}"
            )
        kind, repo_id = wanted.get("type") or "model", f"{owner}/{wanted['name']}"
        answer = {"url": f"{self.hub.endpoint}/{'datasets/' if kind == 'dataset' else ''}{repo_id}", "name": repo_id}
        if (kind, repo_id) in self.hub.repositories:
            raise Reply(409, answer, X_Error_Message=f"You already created this {kind} repo")
        repository = Repository(private=wanted.get("visibility") == "private")
        attributes = "".join(f"{pattern} filter=lfs diff=lfs merge=lfs -text\n" for pattern in LARGE)
        repository.commit({".gitattributes": File(attributes.encode(), large=False)}, "initial commit")
        self.hub.repositories[kind, repo_id] = repository
        raise Reply(200, answer)

    def info(self, kind: str, id: str, revision: str = "main") -> None:
        repository = self._repository(kind, id)
        commit = self._commit(repository, revision)
        files = [{"rfilename": path} for path in repository.commits[commit]]
        raise Reply(200, {"id": id, "sha": commit, "private": repository.private, "tags": [], "siblings": files})

    def tree(self, kind: str, id: str, revision: str, folder: str = "") -> None:
        repository = self._repository(kind, id)
        files = repository.commits[self._commit(repository, revision)]
        raise Reply(200, [_entry(path, file) for path, file in files.items() if path.startswith(unquote(folder))])

    def paths_info(self, kind: str, id: str, revision: str) -> None:
        repository = self._repository(kind, id)
        files = repository.commits[self._commit(repository, revision)]
        paths = parse_qs(self.data.decode()).get("paths", [])
        raise Reply(200, [_entry(path, files[path]) for path in paths if path in files])

    def refs(self, kind: str, id: str) -> None:
        repository = self._repository(kind, id)
        branches, tags = (
            [{"name": name, "ref": f"refs/{what}/{name}", "targetCommit": commit} for name, commit in refs.items()]
            for what, refs in (("heads", repository.branches), ("tags", repository.tags))
        )
        raise Reply(200, {"branches": branches, "tags": tags, "converts": []})

    def create_tag(self, kind: str, id: str, revision: str) -> None:
        repository = self._repository(kind, id, write=True)
        tag = json.loads(self.data)["tag"]
        if tag in repository.tags:
            raise Reply(409, {"error": f"Tag {tag} already exists"})
        repository.tags[tag] = self._commit(repository, revision)
        raise Reply(200, {})

    def delete_tag(self, kind: str, id: str, revision: str) -> None:
        repository = self._repository(kind, id, write=True)
        if repository.tags.pop(unquote(revision), None) is None:
            raise Reply(404, {"error": "Tag not found"}, X_Error_Code="RevisionNotFound")
        raise Reply(200, {})

    # --- Uploads ------------------------------------------------------------------------------------------------------

    def preupload(self, kind: str, id: str, revision: str) -> None:
        repository = self._repository(kind, id, write=True)
        present = repository.commits[self._commit(repository, revision)]
        files = [
            {
                "path": file["path"],
                "uploadMode": "lfs" if any(fnmatch.fnmatch(file["path"], pattern) for pattern in LARGE) else "regular",
                "shouldIgnore": False,
                "oid": present[file["path"]].etag if file["path"] in present else None,
            }
            for file in json.loads(self.data)["files"]
        ]
        raise Reply(200, {"files": files})

    def batch(self, id: str, prefix: str | None = None) -> None:
        kind = "dataset" if prefix else "model"
        repository = self._repository(kind, id, write=True)
        objects = []
        for wanted in json.loads(self.data)["objects"]:
            answer = {"oid": wanted["oid"], "size": wanted["size"]}
            if wanted["oid"] not in repository.large:
                place = f"{kind}/{id}/{wanted['oid']}"
                answer["actions"] = {
                    "upload": {"href": f"{self.hub.storage}/storage/{place}"},
                    "verify": {"href": f"{self.hub.endpoint}/verify/{place}"},
                }
            objects.append(answer)
        raise Reply(200, {"transfer": "basic", "objects": objects})

    def store(self, kind: str, id: str, oid: str) -> None:
        if hashlib.sha256(self.data).hexdigest() != oid:
            raise Reply(400, {"error": "The content does not have this hash"})
        self.hub.repositories[kind, id].large[oid] = self.data
        raise Reply(200)

    def verify(self, kind: str, id: str, oid: str) -> None:
        data = self._repository(kind, id, write=True).large.get(oid)
        right = data is not None and len(data) == json.loads(self.data)["size"]
        raise Reply(200 if right else 404, {})

    def commit(self, kind: str, id: str, revision: str) -> None:
        repository = self._repository(kind, id, write=True)
        head = self._commit(repository, revision)
        lines = [json.loads(line) for line in self.data.splitlines()]
        header = lines[0]["value"]
        if header.get("parentCommit", head) != head:
            raise Reply(412, {"error": "A commit has happened since. Please refresh and try again."})
        files = dict(repository.commits[head])
        for line in lines[1:]:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = File(base64.b64decode(value["content"]), large=False)
            elif line["key"] == "lfsFile":
                if value["oid"] not in repository.large:
                    raise Reply(400, {"error": f"{value['path']}: its content has not been uploaded"})
                files[value["path"]] = File(repository.large[value["oid"]], large=True)
            elif line["key"] == "deletedFile":
                del files[value["path"]]
            else:
                raise Reply(400, {"error": f"this server does not know {line['key']}"})
        oid = repository.commit(files, header["summary"])
        raise Reply(200, {"success": True, "commitOid": oid, "commitUrl": f"{self.hub.endpoint}/{id}/commit/{oid}"})

    # --- Downloads ----------------------------------------------------------------------------------------------------

    def download(self, id: str, revision: str, file: str, prefix: str | None = None) -> None:
        kind = "dataset" if prefix else "model"
        repository = self._repository(kind, id)
        commit = self._commit(repository, revision)
        found = repository.commits[commit].get(unquote(file))
        if found is None:
            raise Reply(404, b"Entry not found", X_Error_Code="EntryNotFound", X_Repo_Commit=commit)
        linked = {"X_Repo_Commit": commit, "X_Linked_Size": str(len(found.data)), "X_Linked_Etag": f'"{found.etag}"'}
        if found.large:
            raise Reply(302, Location=f"{self.hub.storage}/storage/{kind}/{id}/{found.sha256}", **linked)
        self._send_range(found.data, ETag=f'"{found.etag}"', X_Repo_Commit=commit)

    def fetch(self, kind: str, id: str, oid: str) -> None:
        self._send_range(self.hub.repositories[kind, id].large[oid], ETag=f'"{oid}"')

    def _send_range(self, data: bytes, **headers: str) -> None:
        wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        if wanted is None:
            raise Reply(200, data, **headers)
        first, last = int(wanted[1]), min(int(wanted[2] or len(data)), len(data) - 1)
        if first >= len(data):
            raise Reply(416, Content_Range=f"bytes */{len(data)}")
        raise Reply(206, data[first : last + 1], Content_Range=f"bytes {first}-{last}/{len(data)}", **headers)


def _entry(path: str, file: File) -> dict:
    entry = {"type": "file", "path": path, "size": len(file.data), "oid": file.oid}
    if file.large:
        entry["lfs"] = {"oid": file.sha256, "size": len(file.data), "pointerSize": 130}
    return entry


_STORED = r"(?P<kind>model|dataset)/(?P<id>[^/]+/[^/]+)/(?P<oid>\w+)"
_ROUTES = [
    (("GET",), r"/api/whoami-v2", _Handler.whoami),
    (("POST",), r"/api/validate-yaml", _Handler.validate_yaml),
    (("POST",), r"/api/repos/create", _Handler.create),
    (("GET",), VERSIONED, _Handler.info),
    (("GET",), VERSIONED + r"/revision/(?P<revision>[^/]+)", _Handler.info),
    (("GET",), VERSIONED + r"/tree/(?P<revision>[^/]+)", _Handler.tree),
    (("GET",), VERSIONED + r"/tree/(?P<revision>[^/]+)/(?P<folder>.+)", _Handler.tree),
    (("POST",), VERSIONED + r"/paths-info/(?P<revision>[^/]+)", _Handler.paths_info),
    (("GET",), VERSIONED + r"/refs", _Handler.refs),
    (("POST",), VERSIONED + r"/tag/(?P<revision>[^/]+)", _Handler.create_tag),
    (("DELETE",), VERSIONED + r"/tag/(?P<revision>[^/]+)", _Handler.delete_tag),
    (("POST",), VERSIONED + r"/preupload/(?P<revision>[^/]+)", _Handler.preupload),
    (("POST",), r"/(?P<prefix>datasets/)?(?P<id>[^/]+/[^/]+)\.git/info/lfs/objects/batch", _Handler.batch),
    (("PUT",), r"/storage/" + _STORED, _Handler.store),
    (("POST",), r"/verify/" + _STORED, _Handler.verify),
    (("POST",), VERSIONED + r"/commit/(?P<revision>[^/]+)", _Handler.commit),
    (
        ("GET", "HEAD"),
        r"/(?P<prefix>datasets/)?(?P<id>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<file>.+)",
        _Handler.download,
    ),
    (("GET", "HEAD"), r"/storage/" + _STORED, _Handler.fetch),
]
