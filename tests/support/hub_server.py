"""A hub of models on this machine: as much of its interface as uploads and downloads need."""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import huggingface_hub
from huggingface_hub import constants

REVISION = "0" * 40


class Hub(ThreadingHTTPServer):
    """Repositories by id, each a mapping of names to contents; what was asked, in ``paths``."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Request)
        self.repositories: dict[str, dict[str, bytes]] = {}
        self.paths: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Request(BaseHTTPRequestHandler):
    server: Hub

    def log_message(self, *_: object) -> None:
        """Nothing is printed."""

    def answer(self, content: object, status: int = 200, **headers: str) -> None:
        blob = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(blob)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(blob)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        path = self.path.split("?")[0]
        self.server.paths.append(path)
        if path == "/api/repos/create":
            asked = json.loads(body)
            repo_id = "/".join(filter(None, (asked.get("organization"), asked["name"])))
            self.server.repositories.setdefault(repo_id, {})
            self.answer({"url": f"{self.server.url}/{repo_id}"})
        elif "/preupload/" in path:
            names = [file["path"] for file in json.loads(body)["files"]]
            modes = {"uploadMode": "regular", "shouldIgnore": False}
            self.answer({"files": [{"path": name, **modes} for name in names]})
        elif "/commit/" in path:
            repo_id = path.removeprefix("/api/models/").partition("/commit/")[0]
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    content = base64.b64decode(line["value"]["content"])
                    self.server.repositories[repo_id][line["value"]["path"]] = content
            url = f"{self.server.url}/{repo_id}/commit/{REVISION}"
            self.answer({"success": True, "commitOid": REVISION, "commitUrl": url})
        else:
            self.answer({}, 200)  # such as /api/validate-yaml

    def do_GET(self) -> None:
        path = self.path.split("?")[0]
        self.server.paths.append(path)
        if path.startswith("/api/models/"):
            repo_id = "/".join(path.split("/")[3:5])
            files = self.server.repositories.get(repo_id)
            if files is None:
                self.answer({}, 404, X_Error_Code="RepoNotFound")
            elif "/tree/" in path:
                sizes = {name: len(blob) for name, blob in files.items()}
                entry = {"type": "file", "oid": REVISION}
                self.answer([{**entry, "path": n, "size": s} for n, s in sizes.items()])
            else:
                siblings = [{"rfilename": name} for name in files]
                self.answer({"id": repo_id, "sha": REVISION, "siblings": siblings})
            return
        repo_id, _, name = path[1:].partition(f"/resolve/{REVISION}/")
        if not name:
            repo_id, _, name = path[1:].partition("/resolve/main/")
        blob = self.server.repositories.get(repo_id, {}).get(name)
        if blob is None:
            self.answer({}, 404, X_Error_Code="EntryNotFound", X_Repo_Commit=REVISION)
        else:
            etag = f'"{hashlib.sha256(blob).hexdigest()}"'
            self.answer(blob, ETag=etag, X_Repo_Commit=REVISION)

    do_HEAD = do_GET


@contextmanager
def local_hub(monkeypatch, cache) -> Iterator[Hub]:
    """The hub that huggingface_hub talks to meanwhile; its cache is the folder ``cache``."""
    hub = Hub()
    thread = threading.Thread(target=hub.serve_forever, daemon=True)
    thread.start()
    template = hub.url + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "ENDPOINT", hub.url)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    monkeypatch.setenv("HF_TOKEN", "none")
    try:
        yield hub
    finally:
        huggingface_hub.close_session()
        hub.shutdown()
        hub.server_close()
        thread.join()
