"""The page: photographs, mask, estimate, results, the list of all objects."""

import html
import re
from importlib import resources
from typing import Any

from nicegui import events, ui

from unips_jax.app import work
from unips_jax.app.child import Child, Stopped
from unips_jax.app.jobs import Job, Queue
from unips_jax.app.limits import Limits
from unips_jax.app.visitors import Visitor
from unips_jax.errors import InputError

_FOR_PHASE = {
    "reading": "reading photographs",
    "starting": "loading the network",
    "normals": "estimating normals",
    "surface": "integrating the surface, writing files",
}


class Page:
    """One visitor's page."""

    def __init__(self, visitor: Visitor, queue: Queue, limits: Limits) -> None:
        """Belongs to a visitor.

        Args:
            visitor: whose.
            queue: of all visitors.
            limits: bounds.
        """
        self._visitor = visitor
        self._queue = queue
        self._limits = limits
        self._found: dict[str, Any] = {}
        self._reading: Child | None = None

    def build(self) -> None:
        """Lays out the page."""
        assets = resources.files("unips_jax.app") / "assets"
        ui.add_body_html(f"<script>{(assets / 'mask.js').read_text()}</script>")
        ui.colors(primary="#1565c0")
        with ui.element("main").classes("w-full"):
            with ui.element("section").classes("step"):
                ui.html("<h1>Surface normals from photographs</h1>", sanitize=False)
                ui.label(
                    "Photographs of one object by a camera that stands still, under "
                    "light from different sides. Nothing leaves this machine."
                ).classes("note")
            self._build_photographs()
            self._build_mask((assets / "mask.html").read_text())
            self._build_estimate()
            with ui.element("section").classes("step") as self._results:
                pass
        ui.timer(0.5, self._refresh)

    def _build_photographs(self) -> None:
        with ui.element("section").classes("step"):
            ui.html("<h2>1. Photographs</h2>", sanitize=False)
            self._upload = ui.upload(
                multiple=True,
                auto_upload=True,
                max_file_size=self._limits.file_bytes,
                max_files=self._limits.files,
                label="Drop photographs here, or choose them with +",
                on_multi_upload=self._uploaded,
                on_rejected=lambda: self._say("Some files are too large or too many."),
            ).classes("w-full")
            self._upload.props('aria-label="Photographs"')
            self._status = ui.label().classes("note").props('role="status"')
            self._thumbnails = ui.html("", sanitize=False)
            self._advice = ui.column()

    def _build_mask(self, editor: str) -> None:
        with ui.element("section").classes("step") as self._mask_step:
            ui.html("<h2>2. Where is the object?</h2>", sanitize=False)
            self._mask_note = ui.label().classes("note")
            ui.html(editor, sanitize=False)
        self._mask_step.set_visibility(False)

    def _build_estimate(self) -> None:
        with ui.element("section").classes("step") as self._estimate_step:
            ui.html("<h2>3. Estimate</h2>", sanitize=False)
            self._transfer = ui.select(
                {"linear": "linear", "srgb": "sRGB"}, label="Values encode light as"
            ).classes("w-48")
            self._transfer_note = ui.label().classes("note")
            self._perspective = ui.checkbox("Perspective depth")
            self._focal_note = ui.label().classes("note")
            self._name = ui.input("Name of the object", value="object").classes("w-48")
            self._start = ui.button("Estimate normals", on_click=self._estimate)
            self._start.props("no-caps")
        self._estimate_step.set_visibility(False)

    def _say(self, text: str) -> None:
        self._status.set_text(text)

    async def _uploaded(self, event: events.MultiUploadEventArguments) -> None:
        refused = []
        for file in event.files:
            try:
                await file.save(self._visitor.place_for(file.name, file.size()))
            except InputError as error:
                refused.append(str(error))
        self._upload.reset()
        await self._inspect()
        if refused:
            self._say(f"{self._status.text}. Left out: {'; '.join(refused[:3])}")

    async def _inspect(self) -> None:
        """Reads what is there now, in a process of its own."""
        if self._reading is not None:
            self._reading.stop()
        visitor = self._visitor
        child = Child(
            work.inspect,
            *(visitor.photographs, visitor.about, self._limits.pixels),
            memory=self._limits.reading_bytes,
        )
        self._reading = child
        self._say("Reading photographs …")
        try:
            self._found = await visitor.alone(child)
        except Stopped:
            pass
        except InputError as error:
            self._say(_without_folders(str(error)))
        else:
            self._show_found()

    def _show_found(self) -> None:
        found, address = self._found, self._address()
        count = len(found["names"])
        self._say(f"{count} photographs of {found['width']} x {found['height']} pixels")
        items = "".join(
            f'<li><img src="{address}/about/thumbnail-{i}.jpg" alt="">'
            f"<span>{html.escape(name)}</span></li>"
            for i, name in enumerate(found["names"])
        )
        self._thumbnails.set_content(f'<ol class="thumbnails">{items}</ol>')
        self._advice.clear()
        with self._advice:
            for text in found["warnings"]:
                ui.label(f"Advice: {text}").classes("note")
        self._mask_note.set_text(_mask_note(found))
        self._transfer.set_value(found["transfer"])
        self._transfer_note.set_text(f"Because: {found['transfer_rule']}.")
        focal = found["focal"]
        self._perspective.set_value(focal is not None)
        self._perspective.set_enabled(focal is not None)
        self._focal_note.set_text(
            "The photographs' EXIF data do not tell the focal length: the depth is "
            "orthographic."
            if focal is None
            else f"Focal length by the EXIF data: {focal:.0f} pixels."
        )
        self._mask_step.set_visibility(True)
        self._estimate_step.set_visibility(True)
        mask = "null" if found["mask"] == "none" else '"mask.png"'
        ui.run_javascript(f'unipsMask.load("{address}", {mask})')

    async def _estimate(self) -> None:
        self._start.disable()
        try:
            mask = await ui.run_javascript("return await unipsMask.send()", timeout=60)
            if mask not in ("drawn", "none"):
                ui.notify("The mask is empty: draw over the object, or take it all.")
                return
            await self._enqueue(mask)
        except InputError as error:
            ui.notify(str(error))
        except TimeoutError:
            ui.notify("The page did not answer in time; try again.")
        finally:
            self._start.enable()

    async def _enqueue(self, mask: str) -> None:
        visitor = self._visitor
        name = re.sub(r"[^\w-]+", "_", self._name.value or "")[:60] or "object"
        transfer = self._transfer.value
        if transfer == self._found["transfer"]:
            transfer = "auto"  # by the files' own rule
        choices = work.Choices(transfer, self._perspective.value, mask)
        target = visitor.target(name)
        child = Child(
            work.estimate,
            *(visitor.photographs, target, visitor.about / "drawn.png", choices),
            self._limits.pixels,
            memory=self._limits.estimating_bytes,
        )
        job = Job(name, target, child)
        visitor.jobs[visitor.object] = job
        self._add_row(visitor.object, job)
        self._queue.add(job)
        visitor.begin()
        self._found = {}
        self._thumbnails.set_content("")
        self._advice.clear()
        self._say("Drop the next object's photographs here, if there is one.")
        self._name.set_value(f"object-{visitor.object}")
        self._mask_step.set_visibility(False)
        self._estimate_step.set_visibility(False)

    def _address(self, number: int | None = None) -> str:
        number = self._visitor.object if number is None else number
        return f"/files/{self._visitor.key}/{number}"

    def _add_row(self, number: int, job: Job) -> None:
        if not self._visitor.jobs or number == min(self._visitor.jobs):
            with self._results:
                ui.html("<h2>Results</h2>", sanitize=False)
        with self._results, ui.column().classes("w-full job") as row:
            with ui.row().classes("items-center"):
                ui.label(job.name).classes("text-bold")
                state = ui.label().props('role="status"')
                cancel = ui.button("Cancel", on_click=job.cancel).props("flat")
            bar = ui.linear_progress(0, show_value=False).props('aria-label="Progress"')
        row.job = job  # type: ignore[attr-defined]
        shown = {"over": False}

        def refresh() -> None:
            if shown["over"]:
                return
            state.set_text(_state_text(job, self._queue))
            bar.set_value(job.share if job.phase == "normals" else float(job.over))
            if job.over:
                shown["over"] = True
                cancel.set_visibility(False)
                bar.set_visibility(False)
                with row:
                    self._show_result(number, job)

        self._rows = [*getattr(self, "_rows", []), refresh]

    def _refresh(self) -> None:
        for refresh in getattr(self, "_rows", []):
            refresh()

    def _show_result(self, number: int, job: Job) -> None:
        for text in job.warnings:
            ui.label(f"Advice: {text}").classes("note")
        if job.state != "done":
            return
        address = f"{self._address(number)}/results"
        with ui.row():
            ui.link("Everything (zip)", f"{address}/{job.name}.zip").props("download")
            for name in work.RESULT_FILES:
                if (job.target / name).is_file():
                    link = ui.link(name, f"{address}/{name}", new_tab=True)
                    if name != "view.html":
                        link.props(f"download={name}")
        ui.html(
            f'<iframe class="viewer" title="{html.escape(job.name)}" '
            'sandbox="allow-scripts allow-downloads" '
            f'src="{address}/view.html"></iframe>',
            sanitize=False,
        ).classes("w-full")


def _state_text(job: Job, queue: Queue) -> str:
    if job.state == "waiting":
        ahead = queue.ahead_of(job)
        return "starts at once" if not ahead else f"waits for {ahead} before it"
    if job.state == "failed":
        return f"failed: {_without_folders(job.error)}"
    if job.state != "running":
        return job.state
    text = _FOR_PHASE.get(job.phase, "starting")
    if job.phase == "normals":
        text += f", {job.share:.0%}"
    left = job.seconds_left
    if left is not None:
        text += f", about {left:.0f} s left" if left < 100 else f", {left / 60:.0f} min"
    return text


def _mask_note(found: dict[str, Any]) -> str:
    contrast = found["contrast"]
    if found["mask"] == "file":
        return "The mask is the one among the files. What is dark is not the object."
    if found["mask"] == "suggested":
        return (
            f"Suggested, as the background is plain (contrast {contrast:.2f}). What is "
            "dark is not the object; paint, if something is wrong."
        )
    return (
        f"The background is not plain enough to tell (contrast {contrast:.2f}): draw a "
        "box around the object, or paint over it."
    )


def _without_folders(text: str) -> str:
    """Errors name files by paths of this machine, which say nothing to visitors."""
    return re.sub(r"/\S*/", "", text)
