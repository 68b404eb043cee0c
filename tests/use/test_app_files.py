"""Files that the application gets: photographs, masks, bounds."""

import dataclasses
import io
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

import app_client
from app_client import Pretended, drawn, photographs

from unips_jax.app import work
from unips_jax.io.images import read_image

SAMPLE = Path(__file__).parents[2] / "unips_jax/assets/sample/obj000.data"


def of_state(shown, state):
    return {p["name"]: p["why"] for p in shown["photographs"] if p["state"] == state}


def test_one_bad_file_among_eight_is_set_aside(opening):
    client = opening()
    key = client.post("/objects")["id"]
    sent = photographs(5)
    sent["cut.png"] = sent["0.png"][:3000]
    sent["large.png"] = photographs(1, (80, 48))["0.png"]
    black = cv2.imencode(".png", np.zeros((48, 64, 3), np.uint16))[1].tobytes()
    sent["normal_7.png"] = sent["4.png"]  # a map by its name, until it is taken
    sent["black.png"] = black
    for name, data in sent.items():
        assert client.put(key, name, data).status == 200
    shown = client.ready(key)
    aside = of_state(shown, "aside")
    assert aside == {
        "cut.png": "damaged",
        "large.png": "size",
        "black.png": "black",
        "normal_7.png": "map",
    }
    client.post(f"/objects/{key}/use", file="normal_7.png", use=True)
    shown = client.ready(key)
    aside = of_state(shown, "aside")
    assert aside.keys() == {"cut.png", "large.png", "black.png"}
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


def test_photographs_that_are_too_many_together_can_be_left_out(opening, monkeypatch):
    limits = dataclasses.replace(app_client.LIMITS, pixels=64 * 48)
    monkeypatch.setattr(app_client, "LIMITS", limits)
    client = opening()
    key = client.post("/objects")["id"]
    for number in range(11):  # ten times the pixels of a photograph are allowed
        client.put(key, f"{number}.png", photographs(1)["0.png"])
    shown = client.ready(key)
    assert shown["problem"] == "too_much_together" and shown["found"] is None
    client.post(f"/objects/{key}/use", file="3.png", use=False)
    shown = client.ready(key)
    assert shown["problem"] == "" and len(shown["found"]["names"]) == 10


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


def test_maps_are_set_aside_unless_the_visitor_takes_them(opening):
    client = opening()
    key = client.post("/objects")["id"]
    names = ("normal_gt.png", "L_1.png", "baseColor.png", "L_2.png")
    for name, data in zip(names, photographs(4).values(), strict=True):
        client.put(key, name, data)
    shown = client.ready(key)
    assert of_state(shown, "aside") == {"normal_gt.png": "map", "baseColor.png": "map"}
    assert shown["found"]["names"] == ["L_1.png", "L_2.png"]
    client.post(f"/objects/{key}/use", file="normal_gt.png", use=True)
    shown = client.ready(key)
    assert shown["found"]["names"] == ["L_1.png", "L_2.png", "normal_gt.png"]
    # A series with such a word in its names is one of photographs if there is no other.
    key = client.post("/objects")["id"]
    for number, data in enumerate(photographs(3).values()):
        client.put(key, f"metal_bowl_{number}.png", data)
    assert len(client.ready(key)["found"]["names"]) == 3
    client.put(key, "mine.png", photographs(1)["0.png"])
    assert client.ready(key)["found"]["names"] == ["mine.png"]


def test_equal_names_all_stay(opening):
    client = opening()
    key = client.post("/objects")["id"]
    sent = [*photographs(6).values()]
    names = ["a b.png", "a_b.png", "A_B.png", "x/a b.png", "é" * 200 + ".png", "e.png"]
    for name, data in zip(names, sent, strict=True):
        assert client.put(key, name, data).status == 200
    shown = client.ready(key)
    assert len(shown["found"]["names"]) == len({*shown["found"]["names"]}) == 6


def stack(level):
    """A TIFF of three pages, darker ones and brighter ones."""
    file = io.BytesIO()
    pages = np.full((3, 48, 64, 3), level, np.uint8)
    pages[:, 10:30, 10:40] += np.uint8([[[[20]]], [[[60]]], [[[90]]]])
    tifffile.imwrite(file, pages, photometric="rgb")
    return file.getvalue()


def test_frames_of_files_of_one_name_all_stay(opening):
    client = opening()
    key = client.post("/objects", name="vase")["id"]
    for level in (50, 100):
        assert client.put(key, "stack.tif", stack(level)).status == 200
        shown = client.ready(key)
    assert shown["name"] == "vase"
    names = [
        f"{stem}_page_00{n}.tif" for stem in ("stack-2", "stack") for n in (1, 2, 3)
    ]
    assert sorted(p["file"] for p in shown["photographs"]) == names
    inbox = client.results / ".app" / key / "photographs"
    assert sorted(path.name for path in inbox.iterdir()) == names
    corners = [int(read_image(inbox / name)[0, 0, 0]) for name in names]
    assert corners == [100] * 3 + [50] * 3


@pytest.mark.parametrize("name", ["0.png", "stack.tif"])
def test_what_is_left_out_while_it_is_looked_at_stays_out(opening, monkeypatch, name):
    began, go_on, look = threading.Event(), threading.Event(), work.look

    def slow(path, *arguments, **options):
        found = look(path, *arguments, **options)
        if path.name == name:
            began.set()
            go_on.wait(60)
        return found

    monkeypatch.setattr(work, "look", slow)
    client = opening()
    key = client.post("/objects")["id"]
    sent = photographs(3) | {"stack.tif": stack(50)}
    client.put(key, name, sent[name])
    client.get(f"/objects/{key}")
    assert began.wait(60)
    client.post(f"/objects/{key}/use", file=name, use=False)
    go_on.set()
    client.put(key, "2.png", sent["2.png"])
    shown = client.ready(key)
    assert of_state(shown, "aside") == {name: "you"}
    assert of_state(shown, "used") == {"2.png": ""}
    inbox = client.results / ".app" / key / "photographs"
    assert {path.name for path in inbox.iterdir()} == {name, "2.png"}
    client.post(f"/objects/{key}/use", file=name, use=True)
    used = client.ready(key)["found"]["names"]
    pages = [f"stack_page_00{n}.tif" for n in (1, 2, 3)]  # of another type than 2.png
    assert used == (["0.png", "2.png"] if name == "0.png" else pages)


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
    monkeypatch.setattr("unips_jax.app.answers._ROOM", 10**18)
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
