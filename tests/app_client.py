"""The application served in this process, and what a page asks of it."""

import asyncio
import contextlib
import dataclasses
import http.client
import json
import threading
import time
import urllib.parse
from pathlib import Path

import cv2
import numpy as np
import uvicorn

from unips_jax.app import work
from unips_jax.app.limits import Limits
from unips_jax.app.objects import opened
from unips_jax.app.server import application, listening
from unips_jax.errors import InputError
from unips_jax.io.images import read_image

PATIENCE_S = 200  # several processes may share two cores
SAMPLE = Path(__file__).parents[1] / "unips_jax/assets/sample/obj000.data"
LIMITS = Limits(file_bytes=200_000, object_bytes=1_500_000, files=12, objects=3)


@dataclasses.dataclass
class Answer:
    status: int
    headers: dict
    content: bytes

    @property
    def text(self):
        return self.content.decode()

    def json(self):
        return json.loads(self.content)


class Client:
    """One browser's requests; answers with their cookies."""

    def __init__(self, port, results):
        self.port, self.results = port, results
        self.cookie = None

    def ask(self, method, path, body=None, headers=(), **query):
        if query:
            path += "?" + urllib.parse.urlencode(query)
        given = dict(headers)
        if self.cookie:
            given["cookie"] = self.cookie
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        with contextlib.closing(connection):
            connection.request(method, path, body, given)
            answer = connection.getresponse()
            there = {name.lower(): value for name, value in answer.getheaders()}
            content = answer.read()
        if "set-cookie" in there:
            self.cookie = there["set-cookie"].partition(";")[0]
        return Answer(answer.status, there, content)

    def get(self, path):
        return self.ask("GET", f"/api{path}").json()

    def post(self, path, **body):
        answer = self.ask("POST", f"/api{path}", json.dumps(body))
        assert answer.status == 200, answer.text
        return answer.json()

    def refused(self, path, **body):
        answer = self.ask("POST", f"/api{path}", json.dumps(body))
        assert answer.status >= 400, answer.text
        return answer.json()

    def put(self, key, name, data):
        return self.ask("PUT", f"/api/objects/{key}/files", data, name=name)

    def draw(self, key, kind, data):
        return self.ask("PUT", f"/api/objects/{key}/mask", data, kind=kind)

    def until(self, key, true):
        for _ in range(PATIENCE_S * 20):
            shown = self.get(f"/objects/{key}")
            if true(shown):
                return shown
            time.sleep(0.05)
        raise AssertionError(shown)

    def ready(self, key):
        return self.until(key, lambda shown: shown["ready"])

    def state(self, key, state):
        return self.until(key, lambda shown: shown["state"] == state)


@contextlib.contextmanager
def served(results, limits):
    """A client of a server on a folder of results; its key is "key"."""
    with opened(results, days=30) as objects, listening("127.0.0.1", None) as ears:
        port = ears.getsockname()[1]
        app = application(
            objects, host="127.0.0.1", port=port, key="key", limits=limits
        )
        config = uvicorn.Config(
            app, log_level="warning", ws="none", timeout_graceful_shutdown=1
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [ears]})
        thread.start()
        try:
            yield Client(port, results)
        finally:
            server.should_exit = True
            thread.join(30)
            assert not thread.is_alive()


def photographs(count=4, size=(64, 48)):
    """PNGs of the sample, small, with a black background."""
    made = {}
    for index in range(count):
        image = cv2.resize(read_image(SAMPLE / f"L_0{index}.png"), size)
        made[f"{index}.png"] = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
    return made


def drawn(inside):
    mask = np.zeros((48, 64), np.uint8)
    mask[10:30, 10:inside] = 255
    return cv2.imencode(".png", mask)[1].tobytes()


def silent(phase, share):
    pass


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
