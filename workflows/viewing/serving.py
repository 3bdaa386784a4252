"""`enerf view`: a page is opened, or served until Ctrl-C: of a run its live page, its progress, its previews and its viewer; of an asset file the viewer
alone."""

import functools
import ipaddress
import json
import os
import re
import sys
import tempfile
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path

import click

from pipeline.errors import PipelineError, UsageError
from pipeline.failures import cannot_write
from pipeline.interrupt import stopping
from pipeline.stage import Stage
from stages.viewer.page import NAME, policy, write_viewer
from workflows.cli.options import folder_type, output_options, workflow
from workflows.cli.output import closing, conclude, plain, write_json
from workflows.cli.target import asset_of, is_run, open_run
from workflows.loading import damage_of
from workflows.report.signature import ASSET_VIEWER, VIEWER, viewers
from workflows.report.viewer import is_newest, write_viewer_of
from workflows.viewing.progress import PREVIEW, Progress, shown_identity
from workflows.viewing.server import LOOPBACK, Answer, Server, Site, open_inside

POLL_SECONDS = 0.2  # seconds between two checks whether a signal came
HTML, JSON, PNG = "text/html; charset=utf-8", "application/json", "image/png"
LIVE = {"/": ("live.html", HTML), "/live.js": ("live.js", "text/javascript; charset=utf-8"), "/live.css": ("live.css", "text/css; charset=utf-8")}
LIVE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; frame-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
LARGEST_PAGE, LARGEST_PREVIEW = 2**31, 2**24  # bytes
_PREVIEW = re.compile(rf"/previews/([a-z]+)/({PREVIEW.pattern})")


@click.command()
@click.argument("what", metavar="RUN|ASSET", type=folder_type)
@click.option("--no-browser", is_flag=True, help="Only write the page and print its path.")
@click.option("--serve", "port", metavar="PORT", type=click.IntRange(0, 65535), help="Serve the page on this port until Ctrl-C; 0: any free port.")
@click.option("--address", metavar="IP", help="With --serve: address to listen on, 127.0.0.1 by default. Everyone who can reach it can view the page.")
@click.option("--force", is_flag=True, help="Rewrite the page even if it is up to date.")
@output_options
def view(what: Path, no_browser: bool, port: int | None, address: str | None, force: bool, as_json: bool, quiet: bool) -> None:
    """Open the viewer page of RUN or ASSET, which works offline. For a run it is RUN/viewer.html, rewritten if it is missing, out of date or of another
    version. For an asset file it is a new page in a temporary folder.

    With --serve, the page shows the stages, curves and previews of a RUN while it trains, and the viewer once there is an asset, then that of its
    Gaussians. From another machine: 'ssh -L 8000:localhost:PORT HOST', then http://localhost:8000/. The server only reads files, and serves only these
    pages.
    """
    loopback = check_address(address, port)
    if port is None:
        page, made = page_of(what, force=force)
        opened = not no_browser and open_in_browser(page.absolute().as_uri())
        words = str(page.absolute()) + ("" if opened or no_browser else "  (open it in a browser)")
        conclude(words, as_json=as_json, quiet=quiet, page=str(page.absolute()), made=made, opened=opened)
        return

    def ready(url: str) -> None:
        if as_json:
            write_json({"event": "serving", "url": url})
        else:
            closing(f"{url}  (Ctrl-C ends it)" + ("" if loopback else "; whoever reaches this machine may look"))
        if not no_browser and loopback:
            open_in_browser(url)

    serve(what, workflow().stages, address, port, ready)
    conclude(as_json=as_json, quiet=True)


def asset_site(page: Path) -> Site:
    """Of an asset file, whose viewer page is made."""
    return lambda path: _page(page) if path in ("/", "/viewer.html") else None


class RunSite:
    """A run that may still be made. Nothing is written into it.

    folder  takes the viewer page: the run's own page may be untrusted
    """

    def __init__(self, run: Path, stages: Sequence[Stage], folder: Path) -> None:
        self.run, self.folder = run, folder
        self.progress = Progress(run, stages)
        self._making = threading.Lock()
        self._made: str | None = None  # of what the page in the folder is

    def __call__(self, path: str) -> Answer | None:
        if path in LIVE:
            name, kind = LIVE[path]
            return Answer(kind, Path(__file__).with_name(name).read_bytes(), policy=LIVE_POLICY)
        if path == "/status.json":
            return Answer(JSON, self.status())
        if path == "/viewer.html":
            return self._viewer()
        found = _PREVIEW.fullmatch(path)
        return None if found is None else self._preview(found[1], found[2])

    def status(self) -> bytes:
        return json.dumps(plain(self.progress.state()), ensure_ascii=True, allow_nan=False).encode("ascii")

    def _preview(self, stage: str, name: str) -> Answer | None:
        place = self.progress.previews.get((stage, name))
        file = None if place is None else open_inside(self.run, place, LARGEST_PREVIEW)
        return None if file is None else Answer(PNG, file=file)

    def _viewer(self) -> Answer | None:
        """Of what the run shows now, made on the first request for it."""
        with self._making:
            try:
                asset = asset_of(self.run)
                identity, page = shown_identity(open_run(self.run)), self.folder / NAME
                if identity is None:
                    return None
                if identity != self._made:
                    make_page(self.run, asset, page)
                    self._made = identity
            except PipelineError:  # no asset yet, or one that is just replaced: status.json says
                return None
            return _page(page)


def make_page(what: Path, asset: Path, target: Path) -> None:
    """Write the page of a run, of its Gaussians or its asset, with its cameras and photographs; or that of an asset file; atomically.

    Raises CorruptArtifact for a damaged file, DiskFull, and BadInput where it cannot be written.
    """
    pages = viewers(open_run(what)) if is_run(what) else {}
    shown = pages.get(VIEWER, asset)
    try:
        with damage_of(shown):
            if is_run(what):
                write_viewer_of(what, shown, target, ASSET_VIEWER if ASSET_VIEWER in pages and target == what / NAME else None)
            else:
                write_viewer(asset, target)
    except OSError as error:
        raise cannot_write(target, error) from error


def _page(path: Path) -> Answer | None:
    file = open_inside(path.parent, path.name, LARGEST_PAGE)
    return None if file is None else Answer(HTML, file=file, policy=viewer_policy())


@functools.cache
def viewer_policy() -> str:
    """The page's own policy once more, and a sandbox: its origin is none, so that nothing in it reaches the rest of what is served."""
    return f"{policy()}; sandbox allow-scripts allow-downloads; frame-ancestors 'self'"


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
