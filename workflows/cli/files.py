"""`enerf export`, `enerf render` and `enerf inspect`: commands on a run or an asset file."""

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from efficientnerf.asset.camera_paths import PATHS, similarity_of
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from pipeline.errors import UsageError
from pipeline.run import Run
from stages.figures.frames import RenderOptions, encode_frames, render_frames
from stages.formats.exporters import MESH_EXPORTERS, POINT_EXPORTERS, SPLAT_EXPORTERS, VOLUME_EXPORTERS
from stages.formats.exporters.frames import frame_background
from stages.framing.restriction import restricted, with_region
from stages.io.camera_path import read_camera_path
from stages.memory.need import refuse_more_than
from stages.mesh import run as mesh
from stages.points import run as points
from stages.splats import run as splats
from stages.turntable.memory import frames_needed
from stages.turntable.run import cameras_of
from stages.turntable.settings import TurntableSettings
from workflows import exporting, exporting_splats
from workflows.cli.options import common_options, crop_option, folder_type, force_option, json_option, memory_limit, memory_option, output_options, set_option
from workflows.cli.output import conclude, listing, write_json
from workflows.cli.progress import display
from workflows.cli.resolve import Settings
from workflows.cli.target import is_run
from workflows.destination import check_files, check_folder, check_free, writing
from workflows.inspection.describe import describe, in_words
from workflows.loading import load_asset

TEXTURES = ("auto", "photographs", "asset", "off")  # of mesh.texture, which a test compares
REGIONS = ("foreground", "all")
EXR = ("off", "first", "all")  # of turntable.exr, which a test compares
SURFACE_STAGES: dict[str, type] = {"mesh": mesh.MeshSettings, "points": points.PointsSettings, "splats": splats.SplatsSettings}
Crop = tuple[float, float, float, float, float, float] | None


def _either(formats: Iterable[str]) -> str:
    *others, last = formats
    return f"{', '.join(others)} or {last}"


@click.command(
    help=f"""Export RUN or ASSET: a mesh as {_either(MESH_EXPORTERS)}; with --points a point cloud as {_either(POINT_EXPORTERS)}; with --splats 3D Gaussians as
    {_either(SPLAT_EXPORTERS)}; the voxels as a volume ({", ".join(VOLUME_EXPORTERS)}); a viewer page (.html); or the cameras of RUN as .json (nerfstudio).

    Each file is written completely or not at all. An existing file is replaced only with --force, a file of a run never. Results of the run's stages mesh
    and splats are reused if their settings are the same. Settings of the stages mesh, points and splats apply: '--set mesh.max_faces=...'.
    """
)
@click.argument("what", metavar="RUN|ASSET", required=False, type=folder_type)
@click.argument("more", metavar="[FILE]...", nargs=-1, type=folder_type)
@click.option("--to", "first", metavar="FILE", type=folder_type, help="File to write; more may follow. The extension selects the format.")
@click.option("--list", "as_list", is_flag=True, help="List all formats: what they keep and lose, what they need, which programs open them.")
@click.option("--points", "as_points", is_flag=True, help="Write points instead of a mesh.")
@click.option("--splats", "as_splats", is_flag=True, help="Write 3D Gaussians instead of a mesh.")
@click.option(
    "--region", type=click.Choice(REGIONS), help="The subject (foreground) or the whole scene (all); by default foreground, and all for splats."
)
@crop_option
@click.option("--faces", metavar="20k|100k|500k|N", help="Maximum number of faces, instead of mesh.max_faces.")
@click.option(
    "--texture", type=click.Choice(TEXTURES), help="Source of the texture, instead of mesh.texture; off: vertex colours only."
)
@click.option("--texture-size", metavar="N", help="Maximum number of texels along a side, instead of mesh.texture_size.")
@click.option("--jpeg", is_flag=True, help="Write textures as JPEG instead of PNG, for smaller files.")
@click.option("--spz-version", type=click.Choice(("3", "4")), default="4", show_default=True, help="Version of .spz files; 3 for older programs and Spark.")
@force_option
@memory_option
@set_option
@output_options
def export(
    what: Path | None, first: Path | None, more: tuple[Path, ...], as_list: bool, sets: tuple[str, ...], memory: str | None, as_json: bool, quiet: bool,
    **given: Any,
) -> None:
    if as_list:
        rows = exporting.formats()
        if not as_json:
            listing(*exporting.formats_in_words(rows))
        conclude(as_json=as_json, quiet=True, formats=rows)
        return
    if what is None or first is None:
        raise UsageError("Give a run or an asset, and --to FILE. 'enerf export --list' names the formats.")
    faces, size, jpeg, spz = (given.pop(name) for name in ("faces", "texture_size", "jpeg", "spz_version"))
    asked = exporting.Export(what, (first, *more), limit=memory_limit(memory), picture="jpeg" if jpeg else "png", spz_version=int(spz), **given)
    exporting.check(asked)
    options = [] if faces is None else [f"mesh.max_faces={exporting.faces_from_text(faces)}"]
    options += [] if size is None else [f"mesh.texture_size={size}"]
    with display(as_json=as_json, quiet=quiet) as show:
        written = exporting.export_cameras(asked)
        settings = _settings_for(what, (*sets, *options), SURFACE_STAGES)
        written += exporting.export_viewers(asked)
        written += exporting.export_volumes(asked, settings)
        written += exporting_splats.export_splats(asked, settings, _progress("export", show))
        written += exporting.export_surface(asked, settings, _progress("export", show))
    words = []
    for entry in written:
        facts = ", ".join(f"{value} {name}" for name, value in entry.items() if name not in ("path", "beside"))
        words += [f"{entry['path']}  ({facts})", *(f"{each}  (belongs to it)" for each in entry.get("beside", ()))]
    conclude(*words, as_json=as_json, quiet=quiet, written=written)


def _settings_for(what: Path, sets: tuple[str, ...], types: dict[str, type]) -> Settings:
    """Settings of some stages: those that the run recorded, or the defaults for an asset file; then `--set`."""
    settings = Settings(types)
    if is_run(what):
        recorded = Run.open(what).settings
        settings.put_recorded({name: recorded[name] for name in types if name in recorded})
    for text in sets:
        settings.put_option(text)
    return settings


@click.command()
@click.argument("what", metavar="RUN|ASSET", type=folder_type)
@click.option("--out", required=True, type=folder_type, metavar="DIR", help="Folder for frame_0000.png and so on; created if missing.")
@click.option(
    "--path",
    "way",
    type=folder_type,
    metavar="orbit|sway|captured|JSON",
    help="A circle, to and fro, past the captured cameras, or a camera path exported by nerfstudio, in the capture's frame.",
)
@click.option("--region", type=click.Choice(REGIONS), help="The whole scene (all, the default) or only the subject (foreground).")
@crop_option
@click.option("--frames", type=click.IntRange(1, 9999), help="Number of frames of the turntable.")
@click.option("--width", type=click.IntRange(16, 8192), help="Width in pixels; with a camera path, instead of the file's.")
@click.option("--height", type=click.IntRange(16, 8192), help="Height in pixels; with a camera path, instead of the file's.")
@click.option("--background", metavar="COLOUR", help="white, black, transparent or #rrggbb; by default the scene's environment, or white.")
@click.option("--exr", type=click.Choice(EXR), help="Frames also written as EXR, with depth, normals and positions, instead of turntable.exr.")
@click.option("--video", metavar="FILE", type=folder_type, help="Also write the frames as an MP4 (H.264).")
@force_option
@memory_option
@set_option
@output_options
def render(
    what: Path, out: Path, way: Path | None, crop: Crop, video: Path | None, force: bool, sets: tuple[str, ...], as_json: bool, quiet: bool, **given: Any
) -> None:
    """Render the asset of RUN, or ASSET, to DIR, on a turntable or along a camera path.

    With the whole scene, its surroundings are the background, unless one is given. Settings of the stage turntable apply:
    '--set turntable.elevation=30'. Existing frames are replaced only with --force. DIR cannot be in a run.
    """
    if video is not None and video.suffix.lower() != ".mp4":
        raise UsageError(f"--video {video}: the extension {video.suffix!r} is not known; expected .mp4.")
    check_folder(out)
    camera_path = None if way is None or str(way) in PATHS else way
    read = [what, *([] if camera_path is None else [camera_path])]
    check_files([] if video is None else [video], force=force, inputs=read)
    if camera_path is not None and given["frames"] is not None:
        raise UsageError("--frames: the path says how many there are; give either --path or --frames.")
    limit = memory_limit(given.pop("memory"))
    settings = _settings_for(what, sets, {"turntable": TurntableSettings}).resolved()["turntable"]
    given["region"] = given["region"] or (None if any(text.startswith("turntable.region=") for text in sets) else "all")
    given["path"] = str(way) if way is not None and camera_path is None else None
    settings = replace(settings, **{name: value for name, value in given.items() if value is not None})
    frame_background(settings.background)
    tree, cameras, fps = _restricted_with_cameras(load_asset(what), settings, crop, camera_path, given["width"], given["height"])
    most = max((camera.width * camera.height for camera in cameras), default=0)
    refuse_more_than(limit, str(what), frames_needed(tree, most), "Render smaller frames (--width, --height).")
    for k in range(len(cameras)):
        for kind in ("png", "exr"):
            check_free(out / f"frame_{k:04d}.{kind}", force=force, inputs=read)
    options = RenderOptions(background=settings.background, supersample=settings.supersample, exr=settings.exr, fps=fps, crf=settings.crf)
    with display(as_json=as_json, quiet=quiet) as show:
        progress = _progress("render", show)
        with writing(out / "frame_0000.png", force=force):
            written = render_frames(tree, cameras, out, options, lambda done, total: progress(done, total, "frames"))
        if video is not None:
            with writing(video, force=force):
                encode_frames([each for each in written if each.suffix == ".png"], video, options)
            written.append(video)
    words = f"{len(cameras)} frames in {out}" + (f", {video}" if video is not None else "")
    conclude(words, as_json=as_json, quiet=quiet, written=[str(each.absolute()) for each in written])


def _restricted_with_cameras(
    whole: NerfTree, settings: TurntableSettings, crop: Crop, camera_path: Path | None, width: int | None, height: int | None
) -> tuple[NerfTree, list[Camera], int]:
    """The part of an asset that is rendered, the cameras, and the frame rate."""
    tree = restricted(whole, settings.region, crop)
    if camera_path is None:
        return tree, cameras_of(whole if crop is None else with_region(tree), settings), settings.fps
    path = read_camera_path(camera_path, similarity_of(whole), width=width, height=height)
    return tree, list(path.cameras), path.fps or settings.fps


@click.command()
@click.argument("what", metavar="FILE|FOLDER", type=folder_type)
@json_option
@common_options
def inspect(what: Path, as_json: bool) -> None:
    """Describe an asset, a run, a data set or a folder of photographs: number of images, resolution, camera model, bounds, warnings; or a mesh, points or
    3D Gaussians (.ply, .spz, .sog, .glb), also from other programs."""
    found = describe(what)
    if as_json:
        write_json(found, indent=1)
    else:
        listing(*in_words(found))


def _progress(stage: str, show: Callable[[dict[str, Any]], None]) -> Callable[[int, int, str], None]:
    """A callable that turns (done, total, text) into events, at most ten a second."""
    last = [0.0]

    def progress(done: int, total: int, text: str) -> None:
        now = time.monotonic()
        if done >= total or now - last[0] >= 0.1:
            last[0] = now
            show({"event": "progress", "stage": stage, "time": time.time(), "done": done, "total": total, "text": text})

    return progress
