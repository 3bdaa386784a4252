"""`enerf view`: a page is opened, or served until Ctrl-C."""

import ipaddress
import os
import sys
import tempfile
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.errors import UsageError
from pipeline.interrupt import stopping
from pipeline.stage import Stage
from stages.viewer.page import NAME
from workflows.cli.target import asset_of, is_run, open_run
from workflows.report.viewer import is_newest
from workflows.viewing.server import LOOPBACK, Server, Site
from workflows.viewing.sites import RunSite, asset_site, make_page

POLL_SECONDS = 0.2  # seconds between two checks whether a signal came


def page_of(what: Path, *, force: bool) -> tuple[Path, bool]:
    """The viewer page of a run or an asset file, and whether it was made now: in a run that can be written, or in a new temporary folder that stays."""
    asset = asset_of(what)
    if not force and is_run(what) and is_newest(open_run(what), what / NAME):
        return what / NAME, False
    target = (what if is_run(what) and os.access(what, os.W_OK) else Path(tempfile.mkdtemp(prefix="enerf-view-"))) / NAME
    make_page(what, asset, target)
    return target, True


def check_address(address: str | None, port: int | None) -> bool:
    """Whether what is to be listened on is reached from this machine alone. Raises UsageError for what is no number of an interface."""
    if address is None:
        return True
    if port is None:
        raise UsageError("--address: says where to listen; give --serve PORT, too.")
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        raise UsageError(f"--address {address}: expected the number of an interface, such as 127.0.0.1, ::1 or 0.0.0.0.") from None


def open_in_browser(url: str) -> bool:
    """Whether a browser was asked to show a page: not without a screen, where one would take the terminal."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    try:
        return webbrowser.open(url)
    except (webbrowser.Error, OSError):
        return False


def serve(what: Path, stages: Sequence[Stage], address: str | None, port: int, ready: Callable[[str], None]) -> None:
    """Serve a run, finished or not, or an asset file, until a signal comes. Raises as `asset_of` and `Server` do.

    address  None: this machine alone
    ready    is called with the URL
    """
    with tempfile.TemporaryDirectory(prefix="enerf-view-") as name, stopping() as stop:
        folder = Path(name)
        if is_run(what):
            open_run(what)
            site: Site = RunSite(Path(os.path.abspath(what)), stages, folder)
        else:
            asset = asset_of(what)
            make_page(what, asset, folder / NAME)
            site = asset_site(folder / NAME)
        with Server(site, address or LOOPBACK, port) as server:
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": POLL_SECONDS}, daemon=True).start()
            try:
                ready(server.url)
                while stop() is None:
                    time.sleep(POLL_SECONDS)
            finally:
                server.shutdown()
