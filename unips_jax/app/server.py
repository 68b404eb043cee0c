"""The server: who may connect, what is closed in the end."""

from importlib import resources

from nicegui import app, ui
from starlette.middleware.trustedhost import TrustedHostMiddleware

from unips_jax.app.files import router
from unips_jax.app.jobs import Queue
from unips_jax.app.limits import BodyLimit, Limits
from unips_jax.app.page import Page
from unips_jax.app.visitors import Visitors
from unips_jax.errors import InputError

_SLACK = 1_000_000  # what a form adds to a file
_LOOPBACK = ("127.0.0.1", "localhost", "::1")


def serve(host: str, port: int, *, show: bool, limits: Limits | None = None) -> None:
    """Serves the application until it is interrupted.

    Args:
        host: address to listen on.
        port: likewise.
        show: open a browser.
        limits: bounds on what visitors use.
    """
    limits = limits or Limits()
    visitors, queue = Visitors(limits), Queue()
    app.add_middleware(BodyLimit, limit=limits.file_bytes + _SLACK)
    if host in _LOOPBACK:
        # Other sites cannot reach this machine by a name of theirs.
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=[*_LOOPBACK, "[::1]"])
    app.include_router(router(visitors, limits))
    style = (resources.files("unips_jax.app") / "assets" / "app.css").read_text()

    @ui.page("/", title="unips_jax", language="en-US", dark=True)
    def index() -> None:
        ui.add_css(style)
        try:
            visitor = visitors.open()
        except InputError as error:
            ui.label(str(error)).classes("step")
            return
        ui.context.client.on_delete(lambda: visitors.close(visitor))
        Page(visitor, queue, limits).build()

    app.on_shutdown(queue.stop)
    app.on_shutdown(visitors.close_all)  # after SIGTERM nothing below is reached
    try:
        ui.run(
            host=host,
            port=port,
            show=show,
            reload=False,
            title="unips_jax",
            reconnect_timeout=30,
            show_welcome_message=False,
        )
    finally:
        visitors.close_all()
