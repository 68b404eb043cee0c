"""Who may ask the application for what, where it listens, and what it says."""

import asyncio
import errno
import io
import json
import re
import socket
import zipfile
from pathlib import Path, PurePosixPath, PureWindowsPath

import pytest

pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

from unips_jax.app import answers, work
from unips_jax.app.guard import Guard
from unips_jax.app.server import PORT, listening
from unips_jax.cli.app import main as app
from unips_jax.errors import InputError

ASSETS = Path(__file__).parents[2] / "unips_jax/app/assets"


def ask(*given, **more):
    """The status that a guarded application at 127.0.0.1 answers."""
    return sent_by(*given, **more)[0]


def sent_by(at, method="GET", body_bytes=1000, kind="http", **headers):
    """All that it answers."""
    sent = []

    async def inner(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(message):
        sent.append(message)

    given = {"host": "127.0.0.1:8080"} | headers
    scope = {
        "type": kind,
        "method": method,
        "headers": [
            (k.replace("_", "-").encode(), v.encode()) for k, v in given.items()
        ],
    }
    asyncio.run(Guard(inner, host=at, body_bytes=body_bytes)(scope, None, send))
    return sent


OWN, LAN = "127.0.0.1", "0.0.0.0"


@pytest.mark.parametrize(
    ("host", "headers", "status"),
    [
        (OWN, {}, 200),
        (OWN, {"host": "localhost:8080"}, 200),
        (OWN, {"host": "[::1]:8080"}, 200),
        (OWN, {"host": "evil.example"}, 400),
        ("127.0.0.2", {"host": "evil.example"}, 400),
        ("127.0.0.2", {"host": "127.0.0.2:8080"}, 200),
        (OWN, {"host": "192.168.1.5"}, 400),
        (LAN, {"host": "192.168.1.5:8080"}, 200),
        (LAN, {"host": "evil.example"}, 400),
        (LAN, {"host": socket.gethostname()}, 200),
        (OWN, {"origin": "http://127.0.0.1:8080"}, 200),
        (OWN, {"origin": "http://127.0.0.1:9"}, 403),
        (OWN, {"origin": "https://evil.example"}, 403),
        (OWN, {"origin": "null"}, 403),
        (OWN, {"sec_fetch_site": "same-origin"}, 200),
        (OWN, {"sec_fetch_site": "none"}, 200),
        (OWN, {"sec_fetch_site": "cross-site", "sec_fetch_mode": "no-cors"}, 403),
        (
            OWN,
            {
                "sec_fetch_site": "cross-site",
                "sec_fetch_mode": "navigate",
                "sec_fetch_dest": "document",
            },
            200,
        ),
        (
            OWN,
            {
                "sec_fetch_site": "cross-site",
                "sec_fetch_mode": "navigate",
                "sec_fetch_dest": "iframe",
            },
            403,
        ),
    ],
)
def test_other_sites_are_refused(host, headers, status):
    answer = ask(host, **headers)
    assert answer["status"] == status
    there = dict(answer["headers"])
    assert there[b"x-frame-options"] == b"DENY"
    assert b"frame-ancestors 'none'" in there[b"content-security-policy"]


@pytest.mark.parametrize(
    ("method", "headers", "status"),
    [
        ("PUT", {"content_length": "2000"}, 413),
        ("POST", {}, 411),
        ("POST", {"content_length": "10"}, 200),
        # What comes in chunks may be longer than it says.
        ("PUT", {"content_length": "10", "transfer_encoding": "chunked"}, 411),
    ],
)
def test_large_requests_are_refused_unread(method, headers, status):
    assert ask(OWN, method, **headers)["status"] == status


def test_a_refused_upload_says_the_limit_in_the_pages_words():
    sent = sent_by(OWN, "PUT", content_length="2500000", body_bytes=2_000_000)
    assert json.loads(sent[1]["body"]) == {"code": "too_large", "values": {"most": 2}}
    assert (b"content-type", b"application/json") in sent[0]["headers"]


def test_weights_that_are_not_there_are_named_before_it_serves(tmp_path, capsys):
    given = ["--weights", "nope.safetensors", "--no-show", "--results", str(tmp_path)]
    assert app(given) == 2
    assert "nope.safetensors" in capsys.readouterr().err


def test_there_are_no_sockets():
    assert ask(OWN, kind="websocket")["type"] == "websocket.close"


def test_who_sees_what(opening):
    client = opening()
    one = client.post("/objects", example=True)["id"]
    two = client.post("/objects")["id"]

    def listed(query=""):
        return {item["id"] for item in client.get(f"/objects{query}")["objects"]}

    assert len(one) > 20 and listed() == set()
    assert listed(f"?ids={one},{'A' * 24}") == {one}
    client.ask("GET", "/?key=wrong")
    assert listed() == set()
    client.ask("GET", "/?key=key")  # as printed where the server was started
    assert listed() == {one, two}
    assert client.ask("GET", "/api/objects/" + "A" * 24).status == 404
    client.post(f"/objects/{two}/remove")
    assert listed() == {one}
    assert client.ask("GET", f"/api/objects/{two}").status == 404
    client.post(f"/objects/{two}/restore")
    assert listed() == {one, two}


def test_results_are_served_and_nothing_else(opening, tmp_path):
    client = opening()
    key = client.post("/objects", example=True)["id"]
    client.ready(key)
    base = f"/api/objects/{key}/results"
    assert client.ask("GET", f"{base}/normals.json").status == 404
    client.post(f"/objects/{key}/estimate", name="my cat", options={})
    client.state(key, "done")
    view = client.ask("GET", f"{base}/view.html")
    assert view.text == "<p>seen</p>"
    assert view.headers["x-frame-options"] == "SAMEORIGIN"
    assert view.headers["content-security-policy"].startswith("sandbox allow-scripts")
    saved = client.ask("GET", f"{base}/normals.json?save").headers[
        "content-disposition"
    ]
    assert "my_cat-normals.json" in saved
    for name in ("..%2F..%2Fobject.json", "%2Fetc%2Fpasswd", ".app"):
        assert client.ask("GET", f"{base}/{name}").status == 404
    (target,) = (p for p in (tmp_path / "results").iterdir() if p.name != ".app")
    assert re.fullmatch(r"my_cat-\d{4}-\d\d-\d\d", target.name)
    (target / "link.txt").symlink_to(tmp_path / "results/.app/lock")
    assert client.ask("GET", f"{base}/link.txt").status == 404
    pack = f"/api/objects/{key}/zip/all.zip"
    (target / "link.txt").unlink()
    for _ in range(2):  # also what the folder has since
        with zipfile.ZipFile(io.BytesIO(client.ask("GET", pack).content)) as packed:
            names = [PurePosixPath(name).name for name in packed.namelist()]
        assert sorted(names) == sorted(path.name for path in target.iterdir())
        (target / "mesh-print.stl").write_bytes(b"new")


def test_no_name_and_no_json_leaves_the_list_unanswered(opening):
    client = opening()
    names = "half \ud800 a pair", "a" * 200
    ids = ",".join(client.post("/objects", name=name)["id"] for name in names)
    names = [shown["name"] for shown in client.get(f"/objects?ids={ids}")["objects"]]
    assert sorted(map(len, names)) == [13, 100]
    deep = client.ask("POST", "/api/objects", b"[" * 50_000)
    assert deep.status == 422


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/", "text/html; charset=utf-8"),
        ("/assets/app.css", "text/css; charset=utf-8"),
        ("/assets/main.js", "text/javascript; charset=utf-8"),
        ("/assets/strings.json", "application/json"),
        ("/assets/..%2Fserver.py", None),
        ("/assets/server.py", None),
    ],
)
def test_assets_are_served(opening, path, kind):
    answer = opening().ask("GET", path)
    if kind is None:
        assert answer.status == 404
    else:
        assert answer.headers["content-type"] == kind


def test_both_languages_say_all_of_it():
    table = json.loads((ASSETS / "strings.json").read_text())
    english, german = table["en"], table["de"]
    assert english.keys() == german.keys()

    def gaps(text):
        return set(re.findall(r"\{\w+\}", text))

    for key, text in english.items():
        assert gaps(text) == gaps(german[key]), key
    page = (ASSETS / "index.html").read_text()
    code = "".join(path.read_text() for path in ASSETS.glob("*.js"))
    used = set(re.findall(r'data-t(?:-label|-title)?="(\w+)"', page))
    used |= set(re.findall(r'\bt\("(\w+)"', code))
    assert used <= english.keys()
    source = Path(work.__file__).parents[1]
    kinds = set()
    for path in (source / "capture").glob("*.py"):
        kinds |= set(re.findall(r'Finding\(\s*"([a-z ]+)"', path.read_text()))
    assert len(kinds) > 12
    unseen = {"unreadable", "unusable"}  # said of the file
    assert {f"finding_{kind}" for kind in kinds - unseen} <= english.keys()
    assert {f"side_{number}" for number in range(8)} <= english.keys()
    codes = set()
    for path in (source / "app").glob("*.py"):
        text = path.read_text()
        codes |= set(re.findall(r'Refused\(\s*\d+, "(\w+)"', text))
        codes |= set(re.findall(r'"(disk_full|not_stored)"', text))
    codes.add(answers.TOO_MUCH)
    assert {f"problem_{code}" for code in codes} <= english.keys()
    assert {f"why_{why}" for _, why in answers.PLAIN} <= english.keys()


def test_a_bad_port_is_one_line(capsys):
    assert app(["--port", "70000"]) == 2
    assert "--port: expected 1 to 65535, got 70000" in capsys.readouterr().err


def test_a_used_port_is_one_line_or_the_next(capsys, tmp_path, monkeypatch):
    with socket.socket() as other:
        other.bind((OWN, 0))
        other.listen()
        port = other.getsockname()[1]
        assert app(["--port", str(port), "--results", str(tmp_path)]) == 2
        assert capsys.readouterr() == (
            "",
            f"error: --port {port}: expected a free port, got one that another program "
            "listens on; choose another, or leave --port out\n",
        )
        monkeypatch.setattr("unips_jax.app.server.PORT", port)
        with listening(OWN, None) as ears:
            assert port < ears.getsockname()[1] < port + 20


def test_ports_that_windows_keeps_are_passed_over(monkeypatch):
    class Socket(socket.socket):
        def bind(self, address):
            if address[1] == PORT:
                raise PermissionError(errno.EACCES, "forbidden by access permissions")
            super().bind((OWN, 0))

    monkeypatch.setattr(socket, "socket", Socket)
    with listening(OWN, None) as ears:
        assert ears.getsockname()[1] > 0
    with (
        pytest.raises(InputError, match=f"--port {PORT}: .* forbidden by access"),
        listening(OWN, PORT),
    ):
        pass


def test_messages_are_without_folders_of_any_system():
    for path in (PurePosixPath("/a/ID/photographs"), PureWindowsPath("C:\\a\\photos")):
        text = f"{path}: expected one size, got {path / 'b.png'} of another"
        found = answers.without_folder(text, path)
        assert found == "expected one size, got b.png of another"


def test_results_that_cannot_be_written_are_one_line(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert app(["--results", str(tmp_path / "file/x")]) == 2
    err = capsys.readouterr().err
    assert "cannot be a folder of results" in err and err.count("\n") == 1
