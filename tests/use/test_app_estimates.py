"""The application's estimates: one after the other, and none is lost."""

import asyncio

import pytest

pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

from app_client import Pretended, drawn

from unips_jax.app import work
from unips_jax.app.desk import Desk
from unips_jax.app.limits import Limits
from unips_jax.app.objects import Objects


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


@pytest.mark.parametrize("at_once", [True, False])
def test_what_runs_waits_when_the_server_ends(tmp_path, at_once):
    (tmp_path / ".app").mkdir()
    objects = Objects(tmp_path)
    for number in range(3):
        item = objects.begin(str(number))
        item.state, item.asked, item.target = "waiting", 1.0 + number, str(number)
        item.save()
    begun = []

    async def call(function, chosen, target, *rest, **more):
        begun.append(target.name)
        if target.name == "1":
            await asyncio.Event().wait()
        return []

    async def serve():
        desk = Desk(objects, Limits(), "tiny")
        desk._estimating.call = call
        desk.start()
        while len(begun) < 2:
            await asyncio.sleep(0)
        if not at_once:  # after Ctrl-C twice all tasks are cancelled, without this
            await desk.close()

    asyncio.run(serve())
    kept = sorted(Objects(tmp_path).all(), key=lambda item: item.asked)
    assert [item.state for item in kept] == ["done", "waiting", "waiting"]
    assert begun == ["0", "1"]


def test_nothing_is_estimated_before_all_is_there(opening):
    client = opening()
    key = client.post("/objects", example=True)["id"]
    answer = client.refused(f"/objects/{key}/estimate", name="a")
    assert "still being read" in answer["error"]
    client.ready(key)
    client.draw(key, "empty", drawn(10))
    answer = client.refused(f"/objects/{key}/estimate", name="a")
    assert "the mask is empty" in answer["error"]


@pytest.mark.parametrize("kind", ["auto", "whole", "drawn"])
def test_the_mask_that_was_chosen_is_the_estimates(opening, kind):
    client = opening()
    key = client.post("/objects", example=True)["id"]
    client.ready(key)
    client.draw(key, kind, drawn(40))
    client.post(f"/objects/{key}/estimate", name="cat", options={})
    client.state(key, "done")
    own = client.results / ".app" / key / "drawn.png"
    masks = {"auto": "auto", "whole": "none", "drawn": own}
    assert Pretended.calls[-1][2] == masks[kind]
