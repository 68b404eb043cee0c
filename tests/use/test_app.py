"""The application without a browser: processes, folders, bounds, who may ask."""

import asyncio
import contextlib
import json
import os
import re
import socket
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

from app_client import served

import unips_jax.app.desk as desk_module
from unips_jax.app import work
from unips_jax.app.guard import Guard
from unips_jax.app.limits import Limits
from unips_jax.app.objects import Photograph, clean, opened, unused
from unips_jax.app.server import listening
from unips_jax.app.worker import Worker
from unips_jax.cli.app import main as app
from unips_jax.errors import InputError
from unips_jax.io.images import read_image, write_image

SAMPLE = Path(__file__).parents[2] / "unips_jax/assets/sample/obj000.data"
ASSETS = Path(__file__).parents[2] / "unips_jax/app/assets"


def silent(phase, share):
    pass


def allocate(count, *, report):
    report("allocating", 0.5)
    return int(np.ones(count, np.uint8).sum())


def own_process(*, report):
    return os.getpid()


def die(*, report):
    os._exit(9)


def sleep(*, report):
    report("sleeping", 0.0)
    time.sleep(60)


def refuse(*, report):
    raise InputError("expected this,\ngot that")


def with_worker(run, memory=2**31):
    async def whole():
        worker = Worker(memory)
        try:
            return await run(worker)
        finally:
            worker.close()

    return asyncio.run(whole())


def test_a_worker_stays_warm_and_reports():
    said = []

    async def run(worker):
        first = await worker.call(own_process)
        size = await worker.call(allocate, 10**6, report=lambda *r: said.append(r))
        with pytest.raises(InputError, match="expected this, got that"):
            await worker.call(refuse)
        return first, size, await worker.call(own_process)

    first, size, last = with_worker(run)
    assert first == last != os.getpid()
    assert size == 10**6 and said == [("allocating", 0.5)]


def test_what_a_worker_may_not_or_cannot_is_one_line():
    async def run(worker):
        first = await worker.call(own_process)
        with pytest.raises(InputError, match="out of memory"):
            await worker.call(allocate, 3 * 2**30)
        second = await worker.call(own_process)
        with pytest.raises(InputError, match="ended before it was done"):
            await worker.call(die)
        with pytest.raises(InputError, match="within 3 s, got no end"):
            await worker.call(sleep, seconds=3)
        return first, second, await worker.call(own_process)

    processes = with_worker(run)
    assert len({*processes}) == 3  # what failed is not used again


def test_a_call_that_is_cancelled_ends_at_once():
    async def run(worker):
        began = asyncio.Event()
        task = asyncio.create_task(worker.call(sleep, report=lambda *_: began.set()))
        await began.wait()
        start = time.monotonic()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert time.monotonic() - start < 20
        return await worker.call(own_process)

    assert with_worker(run)


@pytest.mark.parametrize(
    ("name", "cleaned"),
    [
        ("../../a b/../x y.png", "x_y.png"),
        ("..\\..\\y.png", "y.png"),
        (".hidden.png", "hidden.png"),
        ("ä" * 300 + ".jpeg", "ä" * 47 + ".jpeg"),
        ("𝔘" * 300 + ".jpeg", None),
        ("photo", "photo"),
    ],
)
def test_names_are_cleaned(name, cleaned):
    found = clean(name)
    assert cleaned is None or found == cleaned
    assert len(found.encode()) <= 100 and "/" not in found


def test_equal_names_get_numbers():
    assert unused("a.png", set()) == "a.png"
    assert unused("a.png", {"A.png", "a-2.png"}) == "a-3.png"


def test_objects_are_what_is_on_disk(tmp_path):
    with opened(tmp_path, days=30) as objects:
        item = objects.begin()
        (item.inbox / "a.png").write_bytes(b"1")
        item.photographs.append(Photograph("a.png", "ä.png", 1, "used"))
        item.drawn.write_bytes(b"mask")
        item.state, item.mask, item.options = "running", "drawn", {"mesh": False}
        item.save()
        damaged = objects.begin()
        (damaged.folder / "object.json").write_text("{")
        with pytest.raises(InputError, match="another `unips app` uses this folder"):
            with opened(tmp_path, days=30):
                pass
    assert (tmp_path / ".app").stat().st_mode & 0o77 == 0
    with opened(tmp_path, days=30) as objects:
        (found,) = objects.all()
        assert found.state == "interrupted"  # a server ended during its estimate
        assert found.photographs == item.photographs and found.mask == "drawn"
        copy = objects.again(found)
        assert copy.id != found.id and copy.state == "draft"
        assert copy.options == {"mesh": False}
        assert (copy.inbox / "a.png").read_bytes() == b"1"
        assert copy.drawn.read_bytes() == b"mask"
        copy.drawn.write_bytes(b"other")
        assert found.drawn.read_bytes() == b"mask"


def test_targets_are_new_folders(tmp_path):
    with opened(tmp_path, days=30) as objects:
        first = objects.target_for("my cat/..")
        assert re.fullmatch(r"object-\d{4}-\d\d-\d\d", first.name) or (
            first.parent == tmp_path
        )
        first.mkdir()
        second = objects.target_for("my cat/..")
        assert second.name == f"{first.name}-2"


def test_old_drafts_and_removed_objects_are_cleared(tmp_path):
    with opened(tmp_path, days=30) as objects:
        kept, old, removed, done = (objects.begin() for _ in range(4))
        past = time.time() - 40 * 86_400
        removed.removed, done.state = past, "done"
        removed.save()
        done.save()
        for item in (old, done):
            os.utime(item.folder / "object.json", (past, past))
    with opened(tmp_path, days=30) as objects:
        assert {item.id for item in objects.all()} == {kept.id, done.id}
        assert not old.folder.exists() and not removed.folder.exists()


def ask(at, method="GET", body_bytes=1000, kind="http", **headers):
    """The status that a guarded application at 127.0.0.1 answers."""
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
    asyncio.run(Guard(inner, host=at, body_bytes=1000)(scope, None, send))
    return sent[0]


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
    ],
)
def test_large_requests_are_refused_unread(method, headers, status):
    assert ask(OWN, method, **headers)["status"] == status


def test_there_are_no_sockets():
    assert ask(OWN, kind="websocket")["type"] == "websocket.close"


class Pretended:
    """A worker in this process: reads photographs, and pretends to estimate."""

    hold = threading.Event()
    running = 0
    calls: list = []

    def __init__(self, memory):
        pass

    async def call(self, function, *arguments, report=silent, seconds=None):
        if function is work.warm:
            return None
        if function is not work.estimate:
            return await asyncio.to_thread(function, *arguments, report=report)
        Pretended.calls.append(arguments)
        Pretended.running += 1
        assert Pretended.running == 1  # one at a time
        try:
            report("normals", 0.5)
            while not Pretended.hold.is_set():
                await asyncio.sleep(0.01)
            target = arguments[1]
            if "broken" in target.name:
                raise InputError(f"{arguments[0].folder / '1.png'}: expected this")
            target.mkdir()
            (target / "normals.json").write_text("{}")
            (target / "view.html").write_text("<p>seen</p>")
            return []
        finally:
            Pretended.running -= 1

    def stop(self):
        pass

    def close(self):
        pass


@pytest.fixture
def pretended(monkeypatch):
    monkeypatch.setattr(desk_module, "Worker", Pretended)
    monkeypatch.setattr(desk_module, "_SETTLED_S", 0.05)
    Pretended.hold.set()
    Pretended.calls.clear()


LIMITS = Limits(file_bytes=200_000, object_bytes=1_500_000, files=12, objects=3)


@pytest.fixture
def opening(tmp_path, pretended):
    """Opens an application on the same folder, as often as one likes."""
    with contextlib.ExitStack() as there:

        def open_client():
            there.close()
            return there.enter_context(served(tmp_path / "results", LIMITS))

        open_client.close = there.close
        yield open_client


def photographs(count=4, size=(64, 48)):
    """PNGs of the sample, small, with a black background."""
    made = {}
    for index in range(count):
        image = cv2.resize(read_image(SAMPLE / f"L_0{index}.png"), size)
        made[f"{index}.png"] = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
    return made


def of_state(shown, state):
    return {p["name"]: p["why"] for p in shown["photographs"] if p["state"] == state}


def test_one_bad_file_among_eight_is_set_aside(opening):
    client = opening()
    key = client.post("/objects")["id"]
    sent = photographs(5)
    sent["cut.png"] = sent["0.png"][:3000]
    sent["large.png"] = photographs(1, (80, 48))["0.png"]
    black = cv2.imencode(".png", np.zeros((48, 64, 3), np.uint16))[1].tobytes()
    sent["normal_7.png"] = sent["4.png"]  # a map by its name; here a photograph
    sent["black.png"] = black
    for name, data in sent.items():
        assert client.put(key, name, data).status == 200
    shown = client.ready(key)
    aside = of_state(shown, "aside")
    assert aside == {
        "cut.png": "damaged",
        "large.png": "size",
        "black.png": "black",
    }
    details = {p["name"]: p["detail"] for p in shown["photographs"]}
    assert details["large.png"] == "80 x 48"
    assert shown["found"]["names"] == [*map("{}.png".format, range(5)), "normal_7.png"]
    assert shown["found"]["mask"] == "suggested" and shown["problem"] == ""
    client.post(f"/objects/{key}/estimate", name="thing", options={})
    client.state(key, "done")
    chosen = Pretended.calls[-1][0]
    assert len(chosen.photographs) == 6 and set(chosen.aside) == set(aside)


def test_photographs_are_left_out_and_taken_again(opening):
    client = opening()
    key = client.post("/objects")["id"]
    for name, data in photographs(3).items():
        client.put(key, name, data)
    assert len(client.ready(key)["found"]["names"]) == 3
    client.post(f"/objects/{key}/use", file="1.png", use=False)
    shown = client.ready(key)
    assert shown["found"]["names"] == ["0.png", "2.png"]
    assert of_state(shown, "aside") == {"1.png": "you"}
    client.post(f"/objects/{key}/use", file="1.png", use=True)
    assert len(client.ready(key)["found"]["names"]) == 3


def test_a_second_mask_is_set_aside_and_can_be_chosen(opening):
    client = opening()
    key = client.post("/objects")["id"]
    for name, data in photographs(2).items():
        client.put(key, name, data)
    for name, columns in (("mask.png", 20), ("other.mask.png", 40)):
        mask = np.zeros((48, 64), np.uint8)
        mask[8:40, 10:columns] = 255
        client.put(key, name, cv2.imencode(".png", mask)[1].tobytes())
    shown = client.ready(key)
    assert of_state(shown, "aside") == {"other.mask.png": "second_mask"}
    assert shown["found"]["mask"] == "file"
    client.post(f"/objects/{key}/use", file="other.mask.png", use=True)
    shown = client.ready(key)
    assert of_state(shown, "mask") == {"other.mask.png": ""}
    answer = client.ask("GET", f"/api/objects/{key}/pictures/mask.png")
    mask = cv2.imdecode(np.frombuffer(answer.content, np.uint8), 0)
    assert 900 < (mask > 127).sum() <= 32 * 30  # less what is black everywhere


def test_equal_names_all_stay(opening):
    client = opening()
    key = client.post("/objects")["id"]
    sent = [*photographs(6).values()]
    names = ["a b.png", "a_b.png", "A_B.png", "x/a b.png", "é" * 200 + ".png", "e.png"]
    for name, data in zip(names, sent, strict=True):
        assert client.put(key, name, data).status == 200
    shown = client.ready(key)
    assert len(shown["found"]["names"]) == len({*shown["found"]["names"]}) == 6


@pytest.mark.parametrize(
    ("name", "data", "code"),
    [
        ("run.exe", b"0", "not_an_image"),
        ("../../evil.py", b"0", "not_an_image"),
        (".png", b"0", "not_an_image"),
        ("a.png", b"0" * 200_001, "too_large"),
        ("a.png", b"", "empty_file"),
    ],
)
def test_each_refused_file_says_why(opening, name, data, code):
    client = opening()
    key = client.post("/objects")["id"]
    assert client.put(key, name, data).json()["code"] == code
    assert client.get(f"/objects/{key}")["photographs"] == []


def test_uploads_are_bounded_together(opening, monkeypatch):
    client = opening()
    key = client.post("/objects")["id"]
    for index in range(7):
        client.put(key, f"{index}.png", b"0" * 200_000)
    answer = client.put(key, "7.png", b"0" * 190_000)
    assert answer.json()["code"] == "too_large_together"
    for index in range(5):
        client.put(key, f"small{index}.png", b"0")
    assert client.put(key, "more.png", b"0").json()["code"] == "too_many"
    for _ in range(2):
        client.post("/objects")
    answer = client.refused("/objects")
    assert answer == {"code": "too_many_objects", "values": {"most": 3}}


def test_a_full_disk_is_one_line(opening, monkeypatch):
    client = opening()
    key = client.post("/objects")["id"]
    monkeypatch.setattr("unips_jax.app.api._ROOM", 10**18)
    answer = client.put(key, "a.png", b"0")
    assert answer.status == 507 and answer.json()["code"] == "disk_full"
    monkeypatch.undo()
    monkeypatch.setattr(
        "pathlib.Path.open",
        lambda *a, **k: (_ for _ in ()).throw(OSError(28, "No space left")),
    )
    answer = client.put(key, "b.png", b"0")
    assert answer.status == 507 and answer.json()["code"] == "disk_full"
    monkeypatch.undo()
    assert client.get(f"/objects/{key}")["photographs"] == []


def drawn(inside):
    mask = np.zeros((48, 64), np.uint8)
    mask[10:30, 10:inside] = 255
    return cv2.imencode(".png", mask)[1].tobytes()


def test_the_mask_is_kept_when_photographs_are_added(opening):
    client = opening()
    key = client.post("/objects", example=True)["id"]
    client.ready(key)
    assert client.draw(key, "drawn", b"no").status == 415
    assert client.draw(key, "drawn", drawn(40)).status == 200
    client.put(key, "more.png", photographs(1, (192, 192))["0.png"])
    shown = client.ready(key)
    assert shown["mask"] == "drawn" and len(shown["found"]["names"]) == 9
    answer = client.ask("GET", f"/api/objects/{key}/pictures/drawn.png")
    assert answer.content == drawn(40)


def test_estimates_wait_run_one_by_one_and_are_run_again(opening):
    client = opening()
    Pretended.hold.clear()
    keys = []
    for name in ("first", "broken", "third"):
        keys.append(client.post("/objects", example=True)["id"])
        client.ready(keys[-1])
        options = {"mesh": False, "transfer": "srgb", "unknown": 1, "rti": "yes"}
        client.post(f"/objects/{keys[-1]}/estimate", name=name, options=options)
    first = client.state(keys[0], "running")
    assert first["phase"] == "normals" and first["share"] == 0.5
    assert client.get(f"/objects/{keys[2]}")["ahead"] == 2
    assert Pretended.calls[0][4] == work.Choices(mesh=False, transfer="srgb")
    client.post(f"/objects/{keys[2]}/cancel")
    Pretended.hold.set()
    broken = client.state(keys[1], "failed")
    assert broken["error"] == "1.png: expected this"  # and no folder of ours
    assert client.get(f"/objects/{keys[2]}")["state"] == "cancelled"
    shown = client.get(f"/objects/{keys[0]}")
    assert shown["state"] == "done"
    assert [f["name"] for f in shown["results"]] == ["normals.json", "view.html"]
    # What gave no result is changed in place; a result stays beside its change.
    assert client.post(f"/objects/{keys[1]}/again")["id"] == keys[1]
    other = client.post(f"/objects/{keys[0]}/again")["id"]
    shown = client.ready(other)
    assert other != keys[0] and shown["state"] == "draft"
    assert shown["options"]["mesh"] is False and len(shown["photographs"]) == 8
    assert client.get(f"/objects/{keys[0]}")["state"] == "done"


def test_a_running_estimate_is_cancelled_and_the_next_runs(opening):
    client = opening()
    Pretended.hold.clear()
    keys = []
    for _ in range(2):
        keys.append(client.post("/objects", example=True)["id"])
        client.ready(keys[-1])
        client.post(f"/objects/{keys[-1]}/estimate", name="a", options={})
    client.state(keys[0], "running")
    client.post(f"/objects/{keys[0]}/cancel")
    client.state(keys[0], "cancelled")
    client.state(keys[1], "running")
    Pretended.hold.set()
    client.state(keys[1], "done")


def test_work_goes_on_with_the_next_server(opening):
    client = opening()
    Pretended.hold.clear()
    key = client.post("/objects", example=True)["id"]
    client.ready(key)
    client.post(f"/objects/{key}/estimate", name="cat", options={})
    client.state(key, "running")
    opening.close()
    Pretended.hold.set()
    client = opening()
    shown = client.state(key, "done")
    assert shown["name"] == "cat" and len(shown["results"]) == 2


def test_nothing_is_estimated_before_all_is_there(opening):
    client = opening()
    key = client.post("/objects", example=True)["id"]
    answer = client.refused(f"/objects/{key}/estimate", name="a")
    assert "still being read" in answer["error"]
    client.ready(key)
    client.draw(key, "empty", drawn(10))
    answer = client.refused(f"/objects/{key}/estimate", name="a")
    assert "the mask is empty" in answer["error"]


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
    packed = client.ask("GET", f"/api/objects/{key}/zip/all.zip")
    assert packed.content.startswith(b"PK")


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


def test_a_box_is_cut_out(opening):
    client = opening()
    key = client.post("/objects", example=True)["id"]
    client.ready(key)
    client.post(f"/objects/{key}/cut", box=[4, 4, 188, 188])
    answer = client.ask("GET", f"/api/objects/{key}/pictures/cut.png")
    mask = cv2.imdecode(np.frombuffer(answer.content, np.uint8), 0) > 127
    truth = read_image(SAMPLE / "mask.png")[..., 0] > 127
    assert (mask & truth).sum() / (mask | truth).sum() > 0.85
    assert client.refused(f"/objects/{key}/cut", box=[1, 2])["code"] == "failed"


def test_a_click_drops_a_piece_and_takes_it_again(opening):
    client = opening()
    key = client.post("/objects", example=True)["id"]
    client.ready(key)
    mask = np.zeros((192, 192), np.uint8)
    mask[40:150, 40:150] = 255
    mask[60:70, 160:170] = 255
    data = cv2.imencode(".png", mask)[1].tobytes()
    client.draw(key, "drawn", data)
    client.post(f"/objects/{key}/piece", point=[165, 65])
    answer = client.ask("GET", f"/api/objects/{key}/pictures/cut.png")
    found = cv2.imdecode(np.frombuffer(answer.content, np.uint8), 0)
    mask[60:70, 160:170] = 0
    assert (found == mask).all()
    assert client.refused(f"/objects/{key}/piece", point="x")["code"] == "failed"


def test_a_drawn_mask_has_the_photographs_size(tmp_path):
    write_image(tmp_path / "a.png", np.full((50, 70, 3), 9, np.uint8))
    (tmp_path / "drawn.png").write_bytes(drawn(40))
    full = work._full_mask(tmp_path / "drawn.png", tmp_path / "a.png", 10**6)
    assert full.shape == (50, 70) and set(np.unique(full)) == {0, 255}
    assert (full > 0).mean() == pytest.approx(20 * 30 / (48 * 64), abs=0.02)
    (tmp_path / "drawn.png").write_bytes(drawn(10))
    with pytest.raises(InputError, match="the mask is empty"):
        work._full_mask(tmp_path / "drawn.png", tmp_path / "a.png", 10**6)


def test_coarse_normals_are_a_picture(tmp_path):
    normals = np.zeros((3, 5, 3), np.float32)
    normals[1, 2] = 0, 0.6, 0.8
    work._write_preview(tmp_path / "preview.png", normals)
    picture = cv2.imread(str(tmp_path / "preview.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (3, 5, 4) and picture[..., 3].sum() == 255
    assert picture[1, 2].tolist() == [round(127.5 * 1.8), 204, 128, 255]


def test_a_film_becomes_photographs(tmp_path):
    import tifffile

    pages = np.random.default_rng(0).integers(0, 255, (3, 20, 30, 3), np.uint8)
    with tifffile.TiffWriter(tmp_path / "film.tif") as film:
        for page in pages:
            film.write(page, photometric="rgb", contiguous=False)
    tifffile.imwrite(tmp_path / "one.tif", pages[0], photometric="rgb")
    found = work.look(tmp_path / "film.tif", tmp_path / "t.jpg", 10**6, report=silent)
    assert found == {"frames": [f"film_page_{n:03}.tif" for n in (1, 2, 3)]}
    assert (tmp_path / "film_page_003.tif").exists()
    facts = work.look(tmp_path / "one.tif", tmp_path / "t.jpg", 10**6, report=silent)
    assert (facts["width"], facts["height"]) == (30, 20)
    assert (tmp_path / "t.jpg").exists()


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
    codes = set()
    for path in (source / "app").glob("*.py"):
        text = path.read_text()
        codes |= set(re.findall(r'Refused\(\s*\d+, "(\w+)"', text))
        codes |= set(re.findall(r'"(disk_full|not_stored)"', text))
    assert {f"problem_{code}" for code in codes} <= english.keys()
    assert {f"why_{why}" for _, why in desk_module._PLAIN} <= english.keys()


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


def test_results_that_cannot_be_written_are_one_line(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert app(["--results", str(tmp_path / "file/x")]) == 2
    err = capsys.readouterr().err
    assert "cannot be a folder of results" in err and err.count("\n") == 1
