"""Renders of a mesh file by Blender, for `blender_check.py`: run by an interpreter that has `bpy`, with a JSON document of what to do.

{"mesh": FILE, "views": [{"out": PNG, "width", "height", "focal", "pose": 4x4 of the camera, x right, y up, looking along -z}], "samples", "report": JSON}

Cycles on the CPU, box filter, transparent film, the standard view transform; light is what materials emit. Writes the bounds of what was imported, in Blender's
frame (z up), and what its materials are.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix, Vector


def imported(path: Path) -> list[Any]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(path))
    elif path.suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path), up_axis="Z", forward_axis="Y")
    else:
        bpy.ops.wm.usd_import(filepath=str(path))
    return [each for each in bpy.data.objects if each.type == "MESH"]


def unlit(material: Any) -> None:
    """An OBJ's material knows no light of its own: its picture is made to shine, as users do by hand."""
    tree = material.node_tree
    picture = next((node for node in tree.nodes if node.type == "TEX_IMAGE"), None)
    if picture is None:
        return
    emission = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(picture.outputs["Color"], emission.inputs["Color"])
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])


def main() -> None:
    wanted = json.loads(Path(sys.argv[-1]).read_text())
    path = Path(wanted["mesh"])
    objects = imported(path)
    if path.suffix == ".obj":
        for material in bpy.data.materials:
            unlit(material)
    corners = [each.matrix_world @ Vector(corner) for each in objects for corner in each.bound_box]
    bounds = [[pick(corner[axis] for corner in corners) for axis in range(3)] for pick in (min, max)]
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", wanted["samples"], False
    scene.cycles.pixel_filter_type, scene.cycles.max_bounces, scene.cycles.use_adaptive_sampling = "BOX", 4, False
    scene.render.film_transparent, scene.render.threads_mode, scene.render.threads = True, "FIXED", wanted.get("threads", 1)
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
    lens = bpy.data.cameras.new("camera")
    camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(camera)
    scene.camera = camera
    lens.sensor_fit, lens.sensor_width, lens.clip_start, lens.clip_end = "HORIZONTAL", 36.0, 1e-3, 1e5
    for view in wanted["views"]:
        scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = view["width"], view["height"], 100
        lens.lens = view["focal"] * 36.0 / view["width"]
        camera.matrix_world = Matrix(view["pose"])
        scene.render.filepath = view["out"]
        bpy.ops.render.render(write_still=True)
    nodes = sorted({node.type for material in bpy.data.materials if material.node_tree for node in material.node_tree.nodes})
    faces = sum(len(each.data.polygons) for each in objects)
    report = {"bounds": bounds, "faces": faces, "nodes": nodes, "images": len(bpy.data.images), "blender": bpy.app.version_string}
    Path(wanted["report"]).write_text(json.dumps(report))


if __name__ == "__main__":
    main()
