"""`enerf export`: a surface as files, taken from the run's stage `mesh` where that has made the same; volumes and cameras. 3D Gaussians:
`workflows.exporting_splats`."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from efficientnerf.asset.format import describe, outline, serialize
from efficientnerf.asset.tree import NerfTree, Region
from efficientnerf.surface.mesh import Mesh, moved
from pipeline.decide import decide
from pipeline.errors import BadInput, UsageError
from pipeline.executors.memory import Limit
from pipeline.files import write_atomically
from pipeline.stage import Stage, settings_from
from stages.artifacts import BakeOutputs, MeshOutputs, PosesOutputs, TrainOutputs
from stages.formats.exporters import MESH_EXPORTERS, POINT_EXPORTERS, SPLAT_EXPORTERS, VOLUME_EXPORTERS, Format, cameras
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.framing.restriction import restricted
from stages.framing.true_frame import TrueFrame, load_frame
from stages.io import scene
from stages.memory.need import Need, libraries, refuse_more_than
from stages.memory.tree import tree_bytes
from stages.mesh.files import read_mesh
from stages.mesh.memory import surface_needed
from stages.mesh.run import SURFACE_SHARE, in_capture, mesh_of
from stages.mesh.settings import STAGE, MeshSettings
from stages.mesh.texture import largest_photograph, textured
from stages.points.memory import needed as points_needed
from stages.points.run import points_of
from stages.viewer.page import compact_bytes, viewer_page
from workflows.cli.resolve import Settings
from workflows.cli.target import asset_of, is_run, open_run
from workflows.destination import check_files, check_free, writing
from workflows.loading import damage_of, load_asset
from workflows.report.viewer import captured

CAMERAS, VIEWER = ".json", ".html"
VOLUME_VOXEL = 250  # bytes of a voxel while its grids are sorted into nodes
Box = tuple[float, float, float, float, float, float]
Progress = Callable[[int, int, str], None]
Written = dict[str, Any]


@dataclass(frozen=True)
class Export:
    """An export request."""

    what: Path  # a run or an asset
    files: tuple[Path, ...]  # to write, by extension
    as_points: bool = False  # instead of a mesh
    as_splats: bool = False  # 3D Gaussians instead of a mesh
    region: str | None = None  # of the asset; None: as the settings say; so is crop
    crop: Box | None = None
    force: bool = False  # whether files that are there are replaced
    texture: str | None = None  # of the mesh; None: what the settings say, where a file keeps it or, of a run, takes colours of vertices from it
    picture: str = "png"  # how textures are stored
    spz_version: int = 4
    limit: Limit | None = None  # of memory

    @property
    def formats(self) -> dict[str, Format]:
        return {**self.table, **VOLUME_EXPORTERS}

    @property
    def table(self) -> dict[str, Format]:
        """Of what is made of the asset besides volumes."""
        return SPLAT_EXPORTERS if self.as_splats else POINT_EXPORTERS if self.as_points else MESH_EXPORTERS

    def format(self, path: Path) -> Format:
        return self.formats[path.suffix.lower()]

    def of(self, extensions: Collection[str]) -> list[Path]:
        """The files with these extensions."""
        return [path for path in self.files if path.suffix.lower() in extensions]

    @property
    def surfaces(self) -> list[Path]:
        """The files that hold the surface."""
        return [] if self.as_splats else self.of(self.table)

    @property
    def keeps_textures(self) -> bool:
        return any(self.format(path).textures for path in self.surfaces)

    @property
    def is_coloured(self) -> bool:
        return any(self.format(path).coloured for path in self.surfaces)

    @property
    def has_photographs(self) -> bool:
        return is_run(self.what) and PosesOutputs.of_run(self.what).scene.is_file()


def faces_from_text(text: str) -> int:
    """20k, 0.1m or a plain number. UsageError for anything else."""
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)([km]?)", text.strip().lower(), re.ASCII)
    count = float(found[1]) * {"": 1, "k": 1e3, "m": 1e6}[found[2]] if found else 0.0
    if not 1 <= count <= 2**31:
        raise UsageError(f"--faces {text}: expected a number of faces, such as 20k, 100k, 500k or 150000.")
    return round(count)


def check(export: Export) -> None:
    """Raise UsageError for what cannot be written, before anything is done."""
    if export.as_points and export.as_splats:
        raise UsageError("--points and --splats: one of the two at a time, for .ply is either.")
    known = [*export.formats, CAMERAS, VIEWER]
    for path in export.files:
        if path.suffix.lower() not in known:
            kind = "points" if export.as_points else "3D Gaussians" if export.as_splats else "a mesh or a volume"
            raise UsageError(f"{path}: the extension {path.suffix!r} names no format for {kind}; expected one of {', '.join(known)}.")
    if (export.picture != "png" and not export.keeps_textures) or (export.texture not in (None, "off") and not (export.is_coloured and not export.as_points)):
        raise UsageError("None of the files keeps a texture (enerf export --list). Give a .glb, .obj, .usdz or .usdc, or leave out --texture and --jpeg.")
    for path in (*export.surfaces, *export.of(VOLUME_EXPORTERS)):
        export.format(path).refuse_without_package(path)
    beside = [] if export.texture == "off" else [each for path in export.surfaces for each in export.format(path).companions(path, export.picture)]
    check_files([*export.files, *dict.fromkeys(beside)], force=export.force, inputs=[export.what])


def export_cameras(export: Export) -> list[Written]:
    """The cameras of a run."""
    written, what = [], export.what
    for path in export.of((CAMERAS,)):
        poses = PosesOutputs(open_run(what).folder("poses")) if is_run(what) else PosesOutputs(what)
        if not poses.scene.is_file():
            raise BadInput(f"{what}: has no cameras; they are in a run whose stage poses is done. Give such a run for {path}.")
        found = scene.load(poses.folder)
        true = load_frame(what) if is_run(what) else None
        found = found if true is None else true.scene(found)
        with writing(path, force=export.force):
            cameras.write(found, path, None if true is None else true.up)
        written.append({"path": str(path.absolute()), "cameras": len(found.views)})
    return written


def export_surface(export: Export, settings: Settings, progress: Progress) -> list[Written]:
    """The surface as a mesh, or points on that. `settings` holds those of the stages mesh and points, with which it is made."""
    if not export.surfaces:
        return []
    wanted, points = (settings.resolved()[name] for name in ("mesh", "points"))
    if not export.as_points:
        return _write_mesh(export, *_surface(export, wanted, progress))
    refuse_more_than(export.limit, str(export.what), points_needed(points.num_points), f"Lower points.num_points ({points.num_points}).")
    mesh, frame = _surface(export, wanted, progress, points.num_points)
    cloud = points_of(mesh, outline(asset_of(export.what)), points, frame)
    for path in export.surfaces:
        with writing(path, force=export.force):
            export.format(path)(cloud, path, frame)
    return [{"path": str(path.absolute()), "points": len(cloud.positions)} for path in export.surfaces]


def _surface(export: Export, wanted: Any, progress: Progress, points: int = 0) -> tuple[Mesh, SourceFrame]:
    """The mesh in the capture's frame: that of the stage, or made here, then with as many faces as so many points are spread over."""
    region = export.region or (wanted.region if export.crop is None else "all")
    shown = export.keeps_textures or (export.is_coloured and (export.texture is not None or export.has_photographs))
    wanted = replace(wanted, region=region, texture=(export.texture or wanted.texture) if shown else "off")
    made = None if export.crop is not None else _made_by_the_stage(export.what, wanted, export.keeps_textures)
    if made is not None:
        return made
    whole = load_asset(export.what)
    tree, border = restricted(whole, region, export.crop), whole.region if region == "foreground" else None
    frame = source_frame(tree.metadata)
    return _meshed(export, tree, border, frame, replace(wanted, max_faces=max(wanted.faces, points)), progress), frame


def export_volumes(export: Export, settings: Settings) -> list[Written]:
    """The asset's voxels as volumes; what of it, the settings of the stage mesh say where --region does not."""
    files = export.of(VOLUME_EXPORTERS)
    if not files:
        return []
    region = export.region or (settings.resolved()["mesh"].region if export.crop is None else "all")
    tree = restricted(load_asset(export.what), region, export.crop)
    voxels = len(tree.density_values)
    need = Need({"grids": VOLUME_VOXEL * voxels, "the asset": tree_bytes(tree), "libraries": libraries()})
    refuse_more_than(export.limit, str(export.what), need, "Take an asset of fewer voxels (enerf convert --resolution).")
    frame = source_frame(tree.metadata)
    for path in files:
        with writing(path, force=export.force):
            export.format(path)(tree, path, frame)
    return [{"path": str(path.absolute()), "voxels": voxels} for path in files]


def export_viewers(export: Export) -> list[Written]:
    """The asset as a page for browsers: all of it, unless --region or --crop say what; with the cameras and photographs of a run."""
    files = export.of((VIEWER,))
    if not files:
        return []
    with damage_of(asset_of(export.what)):
        if export.region is None and export.crop is None and not (is_run(export.what) and load_frame(export.what)):
            asset = compact_bytes(asset_of(export.what))
        else:
            asset = serialize(restricted(load_asset(export.what), export.region or "all", export.crop), "compact")
    cameras, photographs = captured(export.what) if is_run(export.what) else ([], {})
    page = viewer_page(asset, cameras=cameras, photographs=photographs, title=export.what.absolute().stem)
    for path in files:
        with writing(path, force=export.force):
            write_atomically(path, page)
    return [{"path": str(path.absolute()), "bytes": len(page)} for path in files]


def made_with(what: Path, stage: Stage) -> Any:
    """The settings with which a run's stage has made what it holds; None where that is not up to date, and for an asset."""
    decision = decide(stage, open_run(what)) if is_run(what) else None
    if decision is None or not decision.fresh or decision.manifest is None:
        return None
    return settings_from(stage.settings, decision.manifest.request.settings, where=stage.name)


def frame_of(run: Path) -> tuple[SourceFrame, TrueFrame | None]:
    """The frame of a run's exports, and the one that was found since its asset was made."""
    metadata, true = describe(BakeOutputs.of_run(run).asset), load_frame(run)
    return source_frame(metadata) if true is None else true.source_frame(metadata), true


def _made_by_the_stage(what: Path, wanted: MeshSettings, keeps_textures: bool) -> tuple[Mesh, SourceFrame] | None:
    """The mesh that the run's stage `mesh` has made, if that is what is wanted; its texture may be left out."""
    made = made_with(what, STAGE)
    if made is None or replace(made, texture="off", texture_size=2048) != replace(wanted, texture="off", texture_size=2048):
        return None
    if wanted.texture != "off" and (made.texture, made.texture_size) != (wanted.texture, wanted.texture_size):
        return None
    mesh, (frame, true) = read_mesh(MeshOutputs.of_run(what)), frame_of(what)
    if true is not None:
        mesh = moved(mesh, true.from_capture.scale, true.from_capture.rotation, true.from_capture.translation)
    return mesh if wanted.texture != "off" or not keeps_textures else replace(mesh, texture=None), frame


def _meshed(export: Export, tree: NerfTree, border: Region | None, frame: SourceFrame, wanted: MeshSettings, progress: Progress) -> Mesh:
    """The mesh of a tree, clipped to a region, in the capture's frame, textured as its settings say."""
    if wanted.texture == "photographs" and not export.has_photographs:
        raise UsageError(f"{export.what}: holds no photographs. Give a run with its cameras, or --texture asset.")
    choice = "asset" if wanted.texture == "auto" and not export.has_photographs else wanted.texture
    captured = PosesOutputs.of_run(export.what).folder, TrainOutputs.of_run(export.what).folder
    side = 0 if choice == "off" else wanted.texture_size
    remedy = "Take an asset of fewer voxels (enerf convert --resolution)" + (", or a smaller texture (--texture-size)." if side else ".")
    need = surface_needed(tree, texture=side, pixels=largest_photograph(captured[0], choice))
    refuse_more_than(export.limit, str(export.what), need, remedy)
    share = 1.0 if choice == "off" else SURFACE_SHARE

    def between(begin: float, end: float) -> Progress:
        return lambda done, total, text: progress(round(1000 * (begin + (end - begin) * done / max(total, 1))), 1000, text)

    mesh, _ = mesh_of(tree, wanted, between(0.0, share), border)
    return in_capture(textured(mesh, tree, captured, choice, wanted.texture_size, between(share, 1.0)), frame)


def _write_mesh(export: Export, mesh: Mesh, frame: SourceFrame) -> list[Written]:
    written: list[Written] = []
    beside: set[Path] = set()
    for path in export.surfaces:
        kind = export.format(path)
        others = [] if mesh.texture is None else kind.companions(path, export.picture)
        for each in others:
            if each not in beside:  # else of another file of these, and the same
                check_free(each, force=export.force)
        with writing(path, force=export.force):
            kind(mesh, path, frame, **({"picture": export.picture} if kind.textures else {}))
        side = 0 if mesh.texture is None or not kind.textures else max(mesh.texture.colours.shape[:2])
        entry: Written = {"path": str(path.absolute()), "vertices": len(mesh.vertices), "faces": len(mesh.faces)}
        entry |= {"texels a side": side} if side else {}
        written.append(entry | ({"beside": [str(each.absolute()) for each in others]} if others else {}))
        beside |= {*others}
    return written


# What has no table: extension, of what, command, what it keeps and loses, who opens it.
_OTHERS = (
    (CAMERAS, "cameras", "enerf export", "cameras and their lenses, of a run", "the surface", "should: nerfstudio"),
    (VIEWER, "viewer", "enerf export", "all: the asset itself, and photographs of a run's cameras", "nothing, or what --region and --crop say",
     "Chromium, from disk and offline; should: every browser with WebGL2"),
    (".png", "pictures", "enerf render", "colour, 8 bits sRGB, and opacity over a transparent background", "depth", "OpenCV; should: everything"),
    (".exr", "pictures", "enerf render --exr all", "linear colour, opacity, depth, normals and positions, 32 bits; the capture's frame", "nothing",
     "FFmpeg, OpenEXR; should: Nuke, Blender, Fusion, Natron, DJV"),
    (".mp4", "pictures", "enerf render --video", "colour, as video (H.264)", "opacity, depth", "OpenCV, FFmpeg; should: everything"),
    (".nerftree", "asset", "enerf convert", "all: voxels, view-dependent colours, surroundings", "nothing, or what --resolution and --sh-degree say", "enerf"),
)  # fmt: skip


def formats() -> list[dict[str, Any]]:
    """All formats with what they keep and lose, the command that writes them, the extra that they need, and who opens them."""
    rows: list[dict[str, Any]] = []
    for kind, table in (("mesh", MESH_EXPORTERS), ("points", POINT_EXPORTERS), ("splats", SPLAT_EXPORTERS), ("volume", VOLUME_EXPORTERS)):
        command = f"enerf export --{kind}" if kind in ("points", "splats") else "enerf export"
        for each in table.values():
            facts = {"keeps": each.keeps, "loses": each.loses, "extra": each.extra, "opened_by": each.opened_by}
            rows.append({"extension": each.extension, "of": kind, "command": command, **facts})
    for extension, kind, command, keeps, loses, programs in _OTHERS:
        rows.append({"extension": extension, "of": kind, "command": command, "keeps": keeps, "loses": loses, "extra": None, "opened_by": programs})
    return rows


def formats_in_words(rows: Sequence[dict[str, Any]]) -> list[str]:
    """As lines of a listing."""
    lines = []
    for row in rows:
        needed = "" if row["extra"] is None else f"; needs: pip install 'efficientnerf[{row['extra']}]'"
        lines.append(f"{row['extension']:<9} {row['of']}; {row['command']}{needed}")
        lines += [f"          {name:<7} {row[key]}" for name, key in (("keeps", "keeps"), ("loses", "loses"), ("opens", "opened_by"))]
    return lines
