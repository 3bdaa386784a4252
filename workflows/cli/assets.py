"""`enerf diff`, `enerf convert` and `enerf view`: commands on assets."""

from __future__ import annotations

from pathlib import Path

import click

from efficientnerf.asset.format import describe
from pipeline.errors import UsageError
from workflows.cli.options import common_options, folder_type, force_option, json_option, quiet_option, workflow
from workflows.cli.output import closing, listing, write_json
from workflows.cli.progress import size
from workflows.cli.target import asset_of
from workflows.destination import check_files, writing
from workflows.inspection.compare import compare, in_words
from workflows.inspection.convert import convert as convert_asset
from workflows.viewing.serving import check_address, open_in_browser, page_of, serve

DIFFERENT = 6  # exit code of `enerf diff`; 1 would be that of a defect
# efficientnerf.asset.file.serialisation.WRITERS, which a test compares; that import is heavy
LAYOUTS = ("compact", "packed", "small", "sparse", "full", "full32")


@click.command()
@click.argument("first", metavar="A", type=folder_type)
@click.argument("second", metavar="B", type=folder_type)
@click.option("--views", type=click.IntRange(0, 1000), default=4, show_default=True, help="Number of renders to compare, on the orbit of A.")
@click.option("--size", type=click.IntRange(16, 4096), default=400, show_default=True, help="Pixels along a side of the renders.")
@json_option
@quiet_option
@common_options
def diff(first: Path, second: Path, views: int, size: int, as_json: bool, quiet: bool) -> int:
    """Show which metadata and tensors of the assets (or runs) A and B differ, and the PSNR between their renders.

    Exit code 0 if they are equal, 6 if they differ, 4 if one is damaged.
    """
    found = compare(first, second, views, size)
    code = 0 if found["equal"] else DIFFERENT
    if as_json:
        write_json({"event": "summary", "ok": True, "first": str(first), "second": str(second), **found, "exit_code": code})
    elif not quiet:
        listing(*in_words(found))
    return code


@click.command()
@click.argument("what", metavar="RUN|ASSET", type=folder_type)
@click.argument("out", metavar="OUT", type=folder_type)
@click.option("--layout", type=click.Choice(LAYOUTS), help="Layout of the voxels in OUT; by default that of ASSET.")
@click.option("--sh-degree", "degree", type=click.IntRange(0, 4), help="Keep the spherical harmonics up to this degree.")
@click.option("--resolution", type=click.IntRange(1, 65536), help="Voxels along the longest side, of the innermost cascade; fewer than there are.")
@force_option
@json_option
@quiet_option
@common_options
def convert(what: Path, out: Path, layout: str | None, degree: int | None, resolution: int | None, force: bool, as_json: bool, quiet: bool) -> None:
    """Write the asset of RUN, or ASSET, to the file OUT.

    compact: 4 bytes a voxel and one for each harmonic above the first; packed: the same, entropy-coded, to send or keep; small: 6 bytes; sparse:
    16-bit floats; full: all voxels of each brick, 16-bit floats, or 32-bit ones as full32. OUT appears whole or not at all; an existing file is
    replaced with --force only, a file of a run never.
    """
    if out.suffix.lower() != ".nerftree":
        raise UsageError(f"{out}: the extension {out.suffix!r} is not that of an asset; expected .nerftree. For meshes and points: enerf export")
    check_files([out], force=force, inputs=[asset_of(what)])
    with writing(out, force=force):
        convert_asset(what, out, layout, degree, resolution)
    about = describe(out)
    facts = {key: about[key] for key in ("layout", "resolution", "voxels", "sh_degree", "bytes", "bytes_per_voxel")}
    if as_json:
        write_json({"event": "summary", "ok": True, "written": [{"path": str(out.absolute()), **facts}], "exit_code": 0})
    elif not quiet:
        closing(f"{out}: {about['layout']}, {about['voxels']} voxels, degree {about['sh_degree']}, {size(about['bytes'])}")


@click.command()
@click.argument("what", metavar="RUN|ASSET", type=folder_type)
@click.option("--no-browser", is_flag=True, help="Only make the page, and say where it is.")
@click.option("--serve", "port", metavar="PORT", type=click.IntRange(0, 65535), help="Serve the page on this port until Ctrl-C; 0: one that is free.")
@click.option("--address", metavar="IP", help="With --serve: the interface to listen on, 127.0.0.1 by default; on others, whoever reaches it may look.")
@click.option("--force", is_flag=True, help="Make the page again even if there is one of the present asset.")
@json_option
@quiet_option
@common_options
def view(what: Path, no_browser: bool, port: int | None, address: str | None, force: bool, as_json: bool, quiet: bool) -> None:
    """Open the viewer page of RUN or ASSET, which needs no network: RUN/viewer.html, made if it is missing, older than the asset or written by another; for
    an asset file a new one in a temporary folder.

    With --serve, the stages, curves and previews of a RUN are shown while it trains, and the viewer once there is an asset. From another machine:
    'ssh -L 8000:localhost:PORT HOST', then http://localhost:8000/. The server reads, and answers for these pages alone.
    """
    loopback = check_address(address, port)
    if port is None:
        page, made = page_of(what, force=force)
        opened = not no_browser and open_in_browser(page.absolute().as_uri())
        if as_json:
            write_json({"event": "summary", "ok": True, "page": str(page.absolute()), "made": made, "opened": opened, "exit_code": 0})
        elif not quiet:
            closing(str(page.absolute()) + ("" if opened or no_browser else "  (open it in a browser)"))
        return

    def ready(url: str) -> None:
        if as_json:
            write_json({"event": "serving", "url": url})
        else:
            closing(f"{url}  (Ctrl-C ends it)" + ("" if loopback else "; whoever reaches this machine may look"))
        if not no_browser and loopback:
            open_in_browser(url)

    serve(what, workflow().stages, address, port, ready)
    if as_json:
        write_json({"event": "summary", "ok": True, "exit_code": 0})
