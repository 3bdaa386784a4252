"""`enerf diff`, `enerf convert` and `enerf view`: commands on assets."""

from pathlib import Path

import click

from efficientnerf.asset.format import describe
from pipeline.errors import UsageError
from workflows.cli.options import folder_type, force_option, output_options, workflow
from workflows.cli.output import closing, conclude, listing, write_json
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
@click.option("--views", type=click.IntRange(0, 1000), default=4, show_default=True, help="Number of renders to compare, on an orbit of A.")
@click.option("--size", type=click.IntRange(16, 4096), default=400, show_default=True, help="Side of the renders in pixels.")
@output_options
def diff(first: Path, second: Path, views: int, size: int, as_json: bool, quiet: bool) -> int:
    """Compare the assets (or runs) A and B: metadata and tensors that differ, and the PSNR between their renders.

    The exit code is 0 if they are equal, 6 if they differ, 4 if one is damaged.
    """
    found = compare(first, second, views, size)
    code = 0 if found["equal"] else DIFFERENT
    if not as_json and not quiet:
        listing(*in_words(found))
    return conclude(as_json=as_json, quiet=True, code=code, ok=True, first=str(first), second=str(second), **found)


@click.command()
@click.argument("what", metavar="RUN|ASSET", type=folder_type)
@click.argument("out", metavar="OUT", type=folder_type)
@click.option("--layout", type=click.Choice(LAYOUTS), help="Voxel layout of OUT; by default that of ASSET.")
@click.option("--sh-degree", "degree", type=click.IntRange(0, 4), help="Keep the spherical harmonics up to this degree.")
@click.option("--resolution", type=click.IntRange(1, 65536), help="Voxels along the longest side, or of the innermost cascade; fewer than ASSET has.")
@force_option
@output_options
def convert(what: Path, out: Path, layout: str | None, degree: int | None, resolution: int | None, force: bool, as_json: bool, quiet: bool) -> None:
    """Write the asset of RUN, or ASSET, to the file OUT.

    Layouts: compact (4 bytes per voxel, and one per harmonic above the first), packed (the same, entropy-coded, to send or keep), small (6 bytes per
    voxel), sparse (16-bit floats), full (all voxels of each brick, 16-bit floats), full32 (the same, 32-bit floats). OUT is written completely or
    not at all. An existing file is replaced only with --force, a file of a run never.
    """
    if out.suffix.lower() != ".nerftree":
        raise UsageError(f"{out}: the extension {out.suffix!r} is not that of an asset; expected .nerftree. For meshes and points: enerf export")
    check_files([out], force=force, inputs=[asset_of(what)])
    with writing(out, force=force):
        convert_asset(what, out, layout, degree, resolution)
    about = describe(out)
    facts = {key: about[key] for key in ("layout", "resolution", "voxels", "sh_degree", "bytes", "bytes_per_voxel")}
    words = f"{out}: {about['layout']}, {about['voxels']} voxels, degree {about['sh_degree']}, {size(about['bytes'])}"
    conclude(words, as_json=as_json, quiet=quiet, written=[{"path": str(out.absolute()), **facts}])


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
