"""Photographs of which some are unlike the others: most decide, not the first."""

import struct

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("starlette", reason="starlette is not installed")

from unips_jax.app import work
from unips_jax.app.desk import Desk
from unips_jax.app.limits import Limits
from unips_jax.app.objects import Object, Objects, Photograph
from unips_jax.app.sorting import sort_out
from unips_jax.io.door import NotWritten


def curve(gamma):
    """A colour profile of one tone curve, which other files do not have."""
    entry = b"curv" + bytes(4) + struct.pack(">IH", 1, int(gamma * 256)) + bytes(2)
    head = bytearray(128)
    head[12:16], head[16:20], head[36:40] = b"mntr", b"RGB ", b"acsp"
    data = bytes(head) + struct.pack(">I4sII", 1, b"gTRC", 144, len(entry)) + entry
    return struct.pack(">I", len(data)) + data[4:]


def turned():
    """EXIF's orientation 6."""
    exif = Image.Exif()
    exif[0x0112] = 6
    return exif.tobytes()


ODD = {
    "curve": lambda: {"icc_profile": curve(1.8)},
    "orientation": lambda: {"exif": turned()},
    "size": dict,
}


def gathered(folder, odd, which, count, *, mask=False):
    """What is used and what is refused of photographs, some of them odd."""
    rng = np.random.default_rng(0)
    inbox, pictures = folder / "photographs", folder / "pictures"
    inbox.mkdir(), pictures.mkdir()
    y, x = np.mgrid[:96, :128]
    names = tuple(f"{number}.png" for number in range(1, count + 1))
    for number, name in enumerate(names, 1):
        waves = 120 + 60 * np.sin(x / 9 + number) * np.cos(y / 7)
        pixels = waves + 20 * rng.random((96, 128))
        if number in which:
            pixels = 255 * rng.random((96, 128))  # no edge says how it was turned
        if number in which and odd == "size":
            pixels = pixels[:80]
        image = Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).convert("RGB")
        image.save(inbox / name, **(ODD[odd]() if number in which else {}))
    if mask:
        pixels = np.zeros((96, 128), np.uint8)
        pixels[30:80, 30:90] = 255
        Image.fromarray(pixels).save(inbox / "mask.png")
    chosen = work.Chosen(inbox, names, "mask.png" if mask else None, ())
    options = {"transfer": "auto"}
    found = work.gather(chosen, pictures, options, 10**8, report=lambda *_: None)
    assert (found["mask"] == "file") == mask
    return {int(name[0]) for name in found["names"]}, found["refused"]


@pytest.mark.parametrize(
    ("odd", "which", "count", "mask"),
    [
        ("curve", {1}, 6, False),
        ("curve", {1, 2}, 8, True),
        ("curve", {4}, 6, False),
        ("curve", {1}, 3, False),
        ("orientation", {1}, 6, True),
        ("size", {1}, 4, True),
    ],
)
def test_most_photographs_decide(tmp_path, odd, which, count, mask):
    used, refused = gathered(tmp_path, odd, which, count, mask=mask)
    assert used == set(range(1, count + 1)) - which
    assert {int(name[0]) for name in refused} == which
    if 1 in which:
        assert refused["1.png"].startswith("most others are not like it: ")


def test_of_two_the_first_decides(tmp_path):
    used, refused = gathered(tmp_path, "curve", {1}, 2)
    assert used == {1} and list(refused) == ["2.png"]


@pytest.mark.parametrize(
    ("given", "aside"), [("auto", ["2.png"]), ("srgb", []), ("linear", [])]
)
def test_a_transfer_that_is_given_holds_for_all(tmp_path, given, aside):
    photos = []
    for name in ("0.png", "1.png", "2.png"):
        transfer = "linear" if name == "2.png" else "srgb"
        facts = {"width": 4, "height": 3, "type": "uint8", "transfer": transfer}
        photos.append(Photograph(name, name, 9, "used", facts=facts))
    item = Object("a", tmp_path, photographs=photos, options={"transfer": given})
    sort_out(item)
    assert [photo.name for photo in item.of_state("aside")] == aside


def test_a_full_disk_leaves_a_draft(tmp_path, monkeypatch):
    (tmp_path / ".app").mkdir()
    objects = Objects(tmp_path)
    item = objects.begin("cup", {"1.png": b"x"})
    item.photographs[0].state, item.found = "used", {"names": ["1.png"]}
    item.found_version = item.version
    desk = Desk(objects, Limits(), "tiny")

    def full():
        raise NotWritten(tmp_path, OSError(28, "No space left on device"))

    monkeypatch.setattr(item, "save", full)
    with pytest.raises(NotWritten):
        desk.estimate(item, "cup", work.Choices())
    assert item.state == "draft" and not desk.queue
