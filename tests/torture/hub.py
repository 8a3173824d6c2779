"""A server that poses as the Hugging Face hub, and what it may do to ``sb3-e2c load``."""

import contextlib
import gzip
import hashlib
import http.server
import json
import re
import shutil
import signal
import socket
import threading
import time
import zipfile
from pathlib import Path
from urllib.parse import unquote, urlsplit

from huggingface_hub import constants

from sb3_e2c.zoo import hub, load, push
from torture.runs import PREY, Outcome, fork, quietly, trained, wait
from torture.untrusted import WORDS, Payload, _judge, _pour, commands, in_data, rewrite

REPO, SHA = "somebody/prey", "0123456789abcdef0123456789abcdef01234567"
SECONDS = 60.0  # this machine may be busy
LARGE = 2**21  # bytes more than the files have; nobody is to write so much to our disk


class Hub(http.server.ThreadingHTTPServer):
    """One repository.

    :param files: Contents by name
    :param listing: Changes what it lists of its files, and may return something else
    :param send: Answers a request for a file instead of the usual answer; gets the request handler,
        the file's name and content, and returns whether it has answered
    """

    daemon_threads, block_on_close = True, False

    def __init__(self, files, listing=None, send=None):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files = files
        self.listing = listing or (lambda listed: listed)
        self.send = send or (lambda handler, name, content: False)

    def handle_error(self, *_):
        """Clients that hang up are no news."""


class _Handler(http.server.BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def answer(self, body, status=200, **headers):
        self.send_response(status)
        for name, value in {"Content_Length": len(body), **headers}.items():
            if value is not None:
                self.send_header(name.replace("_", "-"), str(value))
        self.end_headers()
        self.wfile.write(body)

    def do_GET(self):
        path, server = unquote(urlsplit(self.path).path), self.server
        if path.startswith("/api/models/"):
            answer = server.listing(listed(server.files))
            self.answer(answer if isinstance(answer, bytes) else json.dumps(answer).encode())
        elif match := re.fullmatch(rf"/{REPO}/resolve/{SHA}/(.+)", path):
            content = server.files[match[1]]
            if not server.send(self, match[1], content):
                self.answer(content)
        else:
            self.answer(b"{}", 404)


def listed(files):
    """What the hub says of a repository."""
    siblings = []
    for name, content in files.items():
        blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
        sha256 = hashlib.sha256(content).hexdigest()
        lfs = {"size": len(content), "sha256": sha256, "pointerSize": 130}
        siblings.append({"rfilename": name, "size": len(content), "blobId": blob})
        siblings[-1] |= {"lfs": lfs} if name.endswith(".zip") else {}
    return {"id": REPO, "modelId": REPO, "sha": SHA, "siblings": siblings}


# ---------------------------------------------------------------------------- what it may do


def change(name, **values):
    """Lie about a file."""

    def listing(found):
        for each in found["siblings"]:
            each.update(values if each["rfilename"] == name else {})
        return found

    return listing


def more(name):
    """List a file more."""
    return lambda found: {**found, "siblings": [*found["siblings"], {"rfilename": name, "size": 1}]}


def of_model(send):
    """Do it to the model, and serve the other files."""

    def of_one(handler, name, content):
        if name == hub.MODEL:
            with contextlib.suppress(OSError):
                send(handler, content)
        return name == hub.MODEL

    return of_one


def pour(handler, content):
    handler.answer(content, Content_Length=None)  # until it hangs up
    while True:
        handler.wfile.write(bytes(2**16))


def chunks(handler, content):
    handler.protocol_version = "HTTP/1.1"
    handler.answer(b"", Content_Length=None, Transfer_Encoding="chunked")
    while True:
        handler.wfile.write(b"10000\r\n" + bytes(2**16) + b"\r\n")


def drip(handler, content):
    handler.answer(b"", Content_Length=len(content))
    for number in content:
        handler.wfile.write(bytes([number]))
        time.sleep(0.05)


def silent(handler, content):
    with contextlib.suppress(OSError):
        handler.connection.recv(1)  # until the other side hangs up


def stalled(handler, content):
    handler.answer(content[:100], Content_Length=len(content))
    silent(handler, content)


def reset(handler, content):
    handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    handler.answer(content[:100], Content_Length=len(content))


def inflate(handler, content):
    bomb = gzip.compress(bytes(2**28), compresslevel=1)
    handler.answer(bomb, Content_Encoding="gzip")


def redirect(where):
    return lambda handler, content: handler.answer(b"", 302, Location=where)


SENDS = {
    "more than listed": pour,
    "more than listed, in chunks": chunks,
    "a byte at a time": drip,
    "nothing": silent,
    "nothing after a while": stalled,
    "it hangs up": reset,
    "half of it": lambda h, c: h.answer(c[: len(c) // 2]),
    "half of it, as if whole": lambda h, c: h.answer(c[: len(c) // 2], Content_Length=len(c)),
    "a huge Content-Length": lambda h, c: h.answer(c[:-9], Content_Length=2**60),
    "a negative Content-Length": lambda h, c: h.answer(c + bytes(9), Content_Length=-1),
    "other bytes of the same size": lambda h, c: h.answer(bytes(len(c))),
    "a gzip bomb": inflate,
    "no gzip": lambda h, c: h.answer(c, Content_Encoding="gzip"),
    "no HTTP": lambda h, c: h.wfile.write(b"\0" * 100_000),
    "a header without end": lambda h, c: h.wfile.write(b"HTTP/1.1 200 OK\r\nA: " + b"a" * LARGE),
    "404": lambda h, c: h.answer(b"\xff", 404),
    "500": lambda h, c: h.answer(b"<html>", 500, X_Error_Message="a\tb"),
    "a redirection to itself": redirect(f"/{REPO}/resolve/{SHA}/{hub.MODEL}"),
    "a redirection to a local file": redirect("file:///etc/passwd"),
    "a redirection to nowhere": redirect("http://127.0.0.1:9/"),
    "a redirection to nothing": redirect("http://[::"),
}
LISTINGS = {
    "a slip": more("../../slipped.py"),
    "an absolute name": more("/slipped.py"),
    "backslashes": more("..\\slipped.py"),
    "a terabyte": change(hub.MODEL, size=2**40),
    "no size": change(hub.MODEL, size=None),
    "a size of -1": change(hub.MODEL, size=-1),
    "a size in words": change(hub.MODEL, size="many"),
    "another checksum": change("config.yml", blobId="0" * 40),
    "another sha256": change(hub.MODEL, lfs={"size": 1, "sha256": "0" * 64, "pointerSize": 1}),
    "no checksum that is one": change("config.yml", blobId=[1]),
    "no files": lambda found: {**found, "siblings": None},
    "no list of files": lambda found: {**found, "siblings": {"a": 1}},
    "numbers for files": lambda found: {**found, "siblings": [1, 2]},
    "no commit": lambda found: {**found, "sha": None},
    "a commit that is a path": lambda found: {**found, "sha": "../../.."},
    "a list": lambda found: [found],
    "no JSON": lambda found: b"<html>",
    "deep JSON": lambda found: b"[" * 100_000,
}


def contents(files, work, trace):
    """Repositories whose files are as listed, and spoiled."""

    def model(spoil):
        path = work / "model.zip"
        path.write_bytes(files[hub.MODEL])
        spoil(path)
        return {**files, hub.MODEL: path.read_bytes()}

    def bomb(path):
        with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
            for number in range(5):
                _pour(file, f"{number}.pth")

    def slip(path):
        with zipfile.ZipFile(path, "a") as file:
            file.writestr("../../slipped.pth", b"slipped")

    config = files["config.yml"]
    return {
        "a zip bomb": model(bomb),
        "a zip slip": model(slip),
        "half a model": {**files, hub.MODEL: files[hub.MODEL][:-500]},
        "an empty model": {**files, hub.MODEL: b""},
        "YAML that is code": {**files, "config.yml": config + b"\na: !!python/name:os.system\n"},
        "a callback, payloads": {
            **model(lambda path: rewrite(path, "data", in_data(Payload(trace)))),
            "config.yml": config
            + b"\ncallback: {subprocess.run: {args: [touch, %a]}}\n" % str(trace),
        },
    }


# ---------------------------------------------------------------------------- trials


def _load(logs, port, trace):
    """In a child process: load from that server, and judge what came of it."""
    constants.ENDPOINT = f"http://127.0.0.1:{port}"
    template = constants.ENDPOINT + "/{repo_id}/resolve/{revision}/{filename}"
    constants.HUGGINGFACE_CO_URL_TEMPLATE = template
    load._SILENCE, load._PATIENCE = 1.0, 2.0
    signal.alarm(int(SECONDS))  # ends this process
    before = written()
    try:
        _judge(load.main, ["--repo-id", REPO, "-f", logs, "--verbose", "0"], trace)
    finally:
        logs.with_suffix(".written").write_text(str(written() - before))


def written():
    """Bytes that this process has written to files so far, also to those that are gone."""
    lines = Path("/proc/self/io").read_text().splitlines()
    return int(dict(line.split(": ") for line in lines)["wchar"])


def attempt(server, work, trace):
    """Load from a server.

    :return: "works", "refused", or what is wrong
    """
    logs, start = work / "logs", time.monotonic()
    shutil.rmtree(logs, ignore_errors=True)
    note, listed_bytes = work / "logs.written", sum(map(len, server.files.values()))
    note.unlink(missing_ok=True)
    before = set(work.rglob("*"))
    with server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        status = wait(fork(_load, logs, server.server_port, trace))
        server.shutdown()
    if time.monotonic() - start > SECONDS:
        return "slow"
    n_bytes = int(note.read_text()) if note.exists() else 0
    left = set(work.rglob("*")) - before - {logs, note}
    if n_bytes > listed_bytes + LARGE:
        return f"{n_bytes:,} bytes written"
    if any(logs not in path.parents for path in left):
        return "a file outside of the log folder"
    if status == 9 and left:
        return f"refused, but {sorted(left)[0].name} is left"
    if status == -signal.SIGALRM:
        return "hangs"
    return {0: "works", 9: "refused"}.get(status) or WORDS.get(status, f"status {status}")


def published(work):
    """The files of a team that ``push`` would publish."""
    logs, folder = work / "trained", work / "published"
    trained(logs, PREY)
    main, argv = push.main, commands(logs, work)["push"][1]
    argv = [*argv[: argv.index("--folder-only")], "--folder-only", folder]
    status, _, error = quietly(main, argv)
    assert status == 0, error
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def servers(files, work, trace):
    """Every server by what it does, and whether loading from it may work."""
    yield "nothing wrong", Hub(files), "works"
    for name, send in SENDS.items():
        yield f"sends {name}", Hub(files, send=of_model(send)), "refused"
    for name, listing in LISTINGS.items():
        yield f"lists {name}", Hub(files, listing), "refused"
    for name, spoiled in contents(files, work, trace).items():
        yield f"has {name}", Hub(spoiled), "works" if "payloads" in name else "refused"


def torture(work):
    """A line of the table.

    :param work: An empty folder
    """
    files, trace = published(work), work / "executed"
    wrong, tried = [], 0
    for name, server, expected in servers(files, work, trace):
        found, tried = attempt(server, work, trace), tried + 1
        if found != expected:
            wrong.append(f"the hub {name}: {found}")
    yield Outcome("load from a hostile hub", tried, wrong=len(wrong), notes=tuple(wrong))


if __name__ == "__main__":
    import sys
    import tempfile

    for outcome in torture(Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())):
        print(outcome)
