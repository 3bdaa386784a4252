"""Sites to serve: of a run its live page, its progress, its previews and its viewer; of an asset file the viewer alone."""

import functools
import json
import re
import threading
from collections.abc import Sequence
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.failures import cannot_write
from pipeline.stage import Stage
from stages.viewer.page import NAME, policy, write_viewer
from workflows.cli.output import plain
from workflows.cli.target import asset_of, is_run, open_run
from workflows.loading import damage_of
from workflows.report.signature import ASSET_VIEWER, VIEWER, viewers
from workflows.report.viewer import write_viewer_of
from workflows.viewing.progress import PREVIEW, Progress, shown_identity
from workflows.viewing.server import Answer, Site, open_inside

HTML, JSON, PNG = "text/html; charset=utf-8", "application/json", "image/png"
LIVE = {"/": ("live.html", HTML), "/live.js": ("live.js", "text/javascript; charset=utf-8"), "/live.css": ("live.css", "text/css; charset=utf-8")}
LIVE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; frame-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
LARGEST_PAGE, LARGEST_PREVIEW = 2**31, 2**24  # bytes
_PREVIEW = re.compile(rf"/previews/([a-z]+)/({PREVIEW.pattern})")


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
