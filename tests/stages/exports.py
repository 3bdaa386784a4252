"""One small capture as photogrammetry programs, phone apps and data sets write it.

Each writer makes the files from known cameras and returns, beside the folder, where the points `POINTS` lie in each image: by the projection that the format's
own documentation states, computed from the numbers in the files, so that no axis can be wrong in writer and reader alike.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Camera, opengl_from_pose, rays
from stages.formats import importers
from stages.io.capture import Capture
from tests.stages import captures
from tests.stages.captures import FOCAL, HEIGHT, WIDTH, Settings

POINTS = np.random.default_rng(7).uniform(-0.6, 0.6, (9, 3))
Pixels = dict[str, np.ndarray]  # name of an image -> (9, 2), the centre of the first pixel being at 0.5, 0.5


def read(folder: Path, **settings: object) -> Capture:
    """The capture of a folder, by the importer that takes it."""
    return importers.IMPORTERS[importers.candidates(folder)[0]].read(folder, Settings(**settings))  # type: ignore[arg-type]


def cameras(suffix: str = ".png") -> list[Camera]:
    """Six cameras round the origin, each rolled by another angle, so that no axis stands for another."""
    made = []
    for index, camera in enumerate(captures.cameras()):
        c, s = np.cos(0.2 * index), np.sin(0.2 * index)
        pose = camera.world_from_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        made.append(replace(camera, name=f"img_{index}{suffix}", world_from_camera=pose))
    return made


def local(camera_from_world: np.ndarray) -> np.ndarray:
    """(9, 3) the points in a camera's frame."""
    return POINTS @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]


def words(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values, np.float64).ravel())


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


# --- photogrammetry

METASHAPE = {"f": 41.0, "cx": 0.7, "cy": -0.4, "b1": 0.6, "b2": 0.01, "k1": -0.12, "k2": 0.03, "k3": -0.01, "k4": 0.02, "p1": 0.004, "p2": -0.003}
CHUNK = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]), np.array([3.0, -2.0, 10.0]), 2.5


def metashape(folder: Path, lens: dict[str, float] = METASHAPE, kind: str = "frame") -> tuple[Path, Pixels]:
    turn, shift, scale = CHUNK
    rows, pixels = [], {}
    for index, camera in enumerate(cameras()):
        pose = np.eye(4)  # in the chunk's frame: world = scale turn x + shift
        pose[:3, :3] = turn.T @ camera.world_from_camera[:3, :3]
        pose[:3, 3] = turn.T @ (camera.centre - shift) / scale
        label = camera.name if index % 2 else Path(camera.name).stem  # Metashape writes either
        rows.append(f'<camera id="{index}" sensor_id="3" component_id="0" label="{label}"><transform>{words(pose)}</transform></camera>')
        x, y, z = local(np.linalg.inv(camera.world_from_camera)).T
        k = dict.fromkeys(("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2"), 0.0) | lens
        x, y = x / z, y / z
        if kind == "fisheye":
            r0 = np.hypot(x, y)
            x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
        r2 = x * x + y * y
        radial = 1 + k["k1"] * r2 + k["k2"] * r2**2 + k["k3"] * r2**3 + k["k4"] * r2**4
        xd = x * radial + k["p1"] * (r2 + 2 * x * x) + 2 * k["p2"] * x * y
        yd = y * radial + k["p2"] * (r2 + 2 * y * y) + 2 * k["p1"] * x * y
        pixels[camera.name] = np.stack([WIDTH / 2 + k["cx"] + xd * k["f"] + xd * k["b1"] + yd * k["b2"], HEIGHT / 2 + k["cy"] + yd * k["f"]], -1)
    last = f'<group id="0" label="g">{rows.pop()}</group><camera id="9" sensor_id="3" label="img_9"/>'  # in a group; and one that is not aligned
    parameters = "".join(f"<{key}>{value!r}</{key}>" for key, value in lens.items())
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="4"><sensor id="3" label="X" type="{kind}"><resolution width="{WIDTH}" height="{HEIGHT}"/>
<calibration type="{kind}" class="initial"><resolution width="{WIDTH}" height="{HEIGHT}"/><f>1</f></calibration>
<calibration type="{kind}" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>{parameters}</calibration></sensor></sensors>
<components next_id="1" active_id="0"><component id="0" label="Component 1"><transform><rotation>{words(turn)}</rotation>
<translation>{words(shift)}</translation><scale>{scale!r}</scale></transform></component></components>
<cameras next_id="6" next_group_id="1">{"".join(rows)}{last}</cameras></chunk></document>
"""
    write(folder / "cameras.xml", text)
    captures.write_pictures(folder / "images", [camera.name for camera in cameras()])
    return folder, pixels


CAPTURED = {"f": 45.0, "px": 0.02, "py": -0.03, "k": (-0.1, 0.02, 0.005, -0.01), "t": (0.004, -0.003)}


def captured_pixels(camera: Camera) -> np.ndarray:
    """By the equations of RealityCapture's article: shares of the longer side, from the middle of the image."""
    x, y, z = local(np.linalg.inv(camera.world_from_camera)).T
    x, y = x / z, y / z
    r2 = x * x + y * y
    (k1, k2, k3, k4), (t1, t2) = CAPTURED["k"], CAPTURED["t"]  # type: ignore[misc]
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    xd = x * radial + t1 * (r2 + 2 * x * x) + 2 * t2 * x * y
    yd = y * radial + t2 * (r2 + 2 * y * y) + 2 * t1 * x * y
    longer = max(WIDTH, HEIGHT)
    u, v = xd * CAPTURED["f"] / 36 + CAPTURED["px"], yd * CAPTURED["f"] / 36 + CAPTURED["py"]  # type: ignore[operator]
    return np.stack([u * longer + WIDTH / 2, v * longer + HEIGHT / 2], -1)


def realitycapture_csv(folder: Path) -> tuple[Path, Pixels]:
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for camera in cameras():
        r = opengl_from_pose(camera.world_from_camera)[:3, :3]  # Rz(-heading) Rx(pitch) Ry(roll)
        pitch = np.arcsin(r[2, 1])
        heading, roll = np.arctan2(r[0, 1], r[1, 1]), np.arctan2(-r[2, 0], r[2, 2])
        lens = [CAPTURED["f"], CAPTURED["px"], CAPTURED["py"], *CAPTURED["k"], *CAPTURED["t"]]  # type: ignore[misc]
        lines.append(f"{camera.name},{words([*camera.centre, *np.degrees([heading, pitch, roll]), *lens]).replace(' ', ',')}")
    write(folder / "registration.csv", "\n".join(lines) + "\n")
    captures.write_pictures(folder / "images", [camera.name for camera in cameras()])
    return folder, {camera.name: captured_pixels(camera) for camera in cameras()}


def realitycapture_xmp(folder: Path) -> tuple[Path, Pixels]:
    for camera in cameras():
        text = f"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xcr:Version="3" xcr:PosePrior="locked" xcr:Coordinates="absolute" xcr:DistortionModel="brown4t2" xcr:FocalLength35mm="{CAPTURED["f"]}"
 xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="{CAPTURED["px"]}" xcr:PrincipalPointV="{CAPTURED["py"]}"
 xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Rotation>{words(camera.world_from_camera[:3, :3].T)}</xcr:Rotation>
<xcr:Position>{words(camera.centre)}</xcr:Position><xcr:DistortionCoeficients>{words([*CAPTURED["k"], *CAPTURED["t"]])}</xcr:DistortionCoeficients>
</rdf:Description></rdf:RDF></x:xmpmeta>"""  # type: ignore[misc]
        write((folder / "images" / camera.name).with_suffix(".xmp"), text)
    captures.write_pictures(folder / "images", [camera.name for camera in cameras()])
    return folder, {camera.name: captured_pixels(camera) for camera in cameras()}


OPENSFM = {"focal_x": 1.3, "focal_y": 1.25, "c_x": 0.02, "c_y": -0.01, "k1": -0.1, "k2": 0.02, "k3": 0.01, "p1": 0.004, "p2": -0.003}


def opensfm(folder: Path, place: str = "opensfm") -> tuple[Path, Pixels]:
    shots, pixels = {}, {}
    longer = max(WIDTH, HEIGHT)
    for camera in cameras():
        inverse = np.linalg.inv(camera.world_from_camera)
        w, *axis = captures.quaternion(inverse[:3, :3])
        sine = np.linalg.norm(axis)
        vector = np.array(axis) / sine * 2 * np.arctan2(sine, w)
        shots[camera.name] = {"rotation": vector.tolist(), "translation": inverse[:3, 3].tolist(), "camera": "v2 x", "orientation": 1}
        x, y, z = local(inverse).T
        x, y = x / z, y / z
        k, r2 = OPENSFM, x * x + y * y
        radial = 1 + k["k1"] * r2 + k["k2"] * r2**2 + k["k3"] * r2**3
        u = k["focal_x"] * (x * radial + 2 * k["p1"] * x * y + k["p2"] * (r2 + 2 * x * x)) + k["c_x"]
        v = k["focal_y"] * (y * radial + 2 * k["p2"] * x * y + k["p1"] * (r2 + 2 * y * y)) + k["c_y"]
        pixels[camera.name] = np.stack([u * longer + WIDTH / 2, v * longer + HEIGHT / 2], -1)
    points = {str(index): {"coordinates": point.tolist(), "color": [10.0, 20.0, 30.0 + index]} for index, point in enumerate(POINTS)}
    lens = {"projection_type": "brown", "width": WIDTH, "height": HEIGHT} | OPENSFM
    whole = {"cameras": {"v2 x": lens}, "shots": shots, "points": points, "reference_lla": {"latitude": 48.0, "longitude": 11.0, "altitude": 500.0}}
    part = {"cameras": {"v2 x": lens}, "shots": {"img_0.png": shots["img_0.png"]}, "points": {}}
    captures.write_json(folder / place / "reconstruction.json", [part, whole])
    tracks = [f"{camera.name}\t{index}\t7\t0.1\t0.2\t0.003\t1\t2\t3" for camera in cameras()[:4] for index in range(3)]
    write(folder / place / "tracks.csv", "\n".join(["OPENSFM_TRACKS_VERSION_v2", *tracks]) + "\n")
    captures.write_pictures(folder / "images", [camera.name for camera in cameras()])
    return folder, pixels


# --- apps


def pinhole(camera: Camera, fx: float = FOCAL, fy: float = FOCAL, cx: float = WIDTH / 2, cy: float = HEIGHT / 2) -> np.ndarray:
    """(9, 2) K (R x + t) by the camera's matrix, x right, y down, z forward."""
    x, y, z = local(np.linalg.inv(camera.world_from_camera)).T
    return np.stack([fx * x / z + cx, fy * y / z + cy], -1)


def opengl_pinhole(matrix: np.ndarray, fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """(9, 2) by a camera-to-world matrix with x right, y up, looking along -z: v grows downwards."""
    x, y, z = local(np.linalg.inv(matrix)).T
    return np.stack([cx + fx * x / -z, cy - fy * y / -z], -1)


def polycam(folder: Path, corrected: bool = True) -> tuple[Path, Pixels]:
    pixels = {}
    for index, camera in enumerate(cameras(".jpg")):
        matrix, lens = opengl_from_pose(camera.world_from_camera), {"fx": 40.0 + index, "fy": 41.0 + index, "cx": 15.5, "cy": 12.5}
        document = lens | {"width": WIDTH, "height": HEIGHT, "blur_score": 100.0, "timestamp": index}
        document |= {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        captures.write_json(folder / f"keyframes/cameras/img_{index}.json", document | ({"t_03": 99.0} if corrected else {}))
        if corrected:
            captures.write_json(folder / f"keyframes/corrected_cameras/img_{index}.json", document)
        pixels[camera.name] = opengl_pinhole(matrix, **lens)
    names = [camera.name for camera in cameras(".jpg")]
    for place in ("images", "depth", *(["corrected_images"] if corrected else [])):
        captures.write_pictures(folder / "keyframes" / place, [name if place != "depth" else f"{Path(name).stem}.png" for name in names])
    captures.write_json(folder / "mesh_info.json", {"vertexCount": 3})
    return folder, pixels


def record3d(folder: Path) -> tuple[Path, Pixels]:
    poses, lenses, pixels = [], [], {}
    for index, camera in enumerate(cameras(".jpg")):
        matrix = opengl_from_pose(camera.world_from_camera)
        w, x, y, z = captures.quaternion(matrix[:3, :3])
        poses.append([x, y, z, w, *matrix[:3, 3]])
        lenses.append([40.0 + index, 41.0, 15.5, 12.5])
        pixels[f"{index}.jpg"] = opengl_pinhole(matrix, *lenses[-1])
    document = {"w": WIDTH, "h": HEIGHT, "fps": 60, "K": [1, 0, 0, 0, 1, 0, 0, 0, 1], "poses": poses, "perFrameIntrinsicCoeffs": lenses}
    captures.write_json(folder / "EXR_RGBD/metadata.json", document)
    captures.write_pictures(folder / "EXR_RGBD/rgb", list(pixels))
    return folder, pixels


def scanner_app(folder: Path) -> tuple[Path, Pixels]:
    """As in life with more poses than pictures."""
    pixels = {}
    made = cameras()
    for index, camera in enumerate([*made, *made[:2]]):
        matrix, lens = opengl_from_pose(camera.world_from_camera), {"fx": 40.0 + index, "fy": 41.0 + index, "cx": 15.5, "cy": 12.5}
        k = [lens["fx"], 0, lens["cx"], 0, lens["fy"], lens["cy"], 0, 0, 1]
        document = {"cameraPoseARFrame": matrix.ravel().tolist(), "intrinsics": k, "projectionMatrix": [0.0] * 16, "time": 0.5 * index, "motionQuality": 1}
        captures.write_json(folder / f"frame_{index:05d}.json", document | {"frame_index": index})
        if index < len(made):
            pixels[f"frame_{index:05d}.jpg"] = opengl_pinhole(matrix, **lens)
    captures.write_pictures(folder, [*pixels, "textured_output.png"])
    captures.write_json(folder / "info.json", {"title": "a scan"})
    return folder, pixels


# --- data sets


def scannetpp(folder: Path) -> tuple[Path, Pixels]:
    """A fisheye lens, by OpenCV's equations."""
    lens = {"fl_x": 30.0, "fl_y": 31.0, "cx": 16.5, "cy": 11.5, "k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": -0.001}
    entries, pixels = [], {}
    for camera in cameras(".JPG"):
        entries.append({"file_path": camera.name, "transform_matrix": opengl_from_pose(camera.world_from_camera).tolist(), "is_bad": False})
        x, y, z = local(np.linalg.inv(camera.world_from_camera)).T
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        d = theta * (1 + lens["k1"] * theta**2 + lens["k2"] * theta**4 + lens["k3"] * theta**6 + lens["k4"] * theta**8) / r
        pixels[camera.name] = np.stack([lens["fl_x"] * x * d + lens["cx"], lens["fl_y"] * y * d + lens["cy"]], -1)
    bad = {**entries[0], "file_path": "img_9.JPG", "is_bad": True}
    document = lens | {"camera_model": "OPENCV_FISHEYE", "w": WIDTH, "h": HEIGHT, "frames": [*entries[:4], bad], "test_frames": entries[4:]}
    captures.write_json(folder / "dslr/nerfstudio/transforms.json", document)
    captures.write_json(folder / "dslr/train_test_lists.json", {"train": ["img_0.JPG", "img_1.JPG", "img_2.JPG"], "test": ["img_4.JPG", "img_5.JPG"]})
    names = [camera.name for camera in cameras(".JPG")]
    for index, name in enumerate([*names, "img_9.JPG"]):
        captures.write_picture(folder / "dslr/resized_images" / name, captures.picture(index), format="JPEG")
    return folder, pixels


def kapture(folder: Path) -> tuple[Path, Pixels]:
    """Two cameras on a rig: the odd images are those of the second."""
    second = np.eye(4)  # sensor from rig
    second[:3, :3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    second[:3, 3] = 0.3, -0.1, 0.2

    def pose(matrix: np.ndarray) -> str:
        return words([*captures.quaternion(matrix[:3, :3]), *matrix[:3, 3]]).replace(" ", ", ")

    trajectories, records, pixels = [], [], {}
    for index, camera in enumerate(cameras()):
        device = np.linalg.inv(camera.world_from_camera)
        if index % 2:
            device = np.linalg.inv(second) @ device  # rig from world
        trajectories.append(f"{index}, rig, {pose(device)}")
        records.append(f"{index}, cam{index % 2}, map/{camera.name}")
        pixels[camera.name] = pinhole(camera, 41.0, 41.0, 16.5, 11.5) if index % 2 else pinhole(camera, 40.0, 42.0, 15.0, 13.0)
    first = "# kapture format: 1.1\n"
    sensors = ["cam0, , camera, PINHOLE, 32, 24, 40, 42, 15, 13", f"cam1, , camera, SIMPLE_PINHOLE, {WIDTH}, {HEIGHT}, 41, 16.5, 11.5", "w, , wifi"]
    write(folder / "sensors/sensors.txt", first + "\n".join(sensors) + "\n")
    write(folder / "sensors/rigs.txt", f"{first}rig, cam0, 1, 0, 0, 0, 0, 0, 0\nrig, cam1, {pose(second)}\n")
    write(folder / "sensors/trajectories.txt", first + "\n".join(trajectories) + "\n")
    write(folder / "sensors/records_camera.txt", first + "\n".join(records) + "\n7, cam0, map/lost.png\n")
    write(folder / "reconstruction/points3d.txt", first + "\n".join(f"{words(point).replace(' ', ', ')}, 10, 20, 30" for point in POINTS) + "\n")
    write(folder / "reconstruction/observations.txt", first + "2, sift, map/img_0.png, 5, map/img_3.png, 6\n4, sift, map/img_1.png, 0, map/x.png, 6\n")
    captures.write_pictures(folder / "sensors/records_data/map", [camera.name for camera in cameras()])
    return folder, pixels


K = np.array([[40.0, 0, 15.5], [0, 42.0, 12.5], [0, 0, 1]])


def mvsnet(folder: Path, place: str = "cams", images: str = "images") -> tuple[Path, Pixels]:
    pixels = {}
    for index, camera in enumerate(cameras()):
        rows = "\n".join(words(row) for row in np.linalg.inv(camera.world_from_camera))
        lens = "\n".join(words(row) for row in K)
        write(folder / place / f"{index:08d}_cam.txt", f"extrinsic\n{rows}\n\nintrinsic\n{lens}\n\n2.5 0.05 192 7.0\n")
        pixels[f"{index:08d}.jpg"] = pinhole(camera, 40, 42, 15.5, 12.5)
    write(folder / "pair.txt", "0\n")
    captures.write_pictures(folder / images, list(pixels))
    return folder, pixels


def dtu(folder: Path) -> tuple[Path, Pixels]:
    """Two lights of six views."""
    _, pixels = mvsnet(folder, "Cameras")
    for path in (folder / "images").iterdir():
        path.unlink()
    (folder / "images").rmdir()
    names = [f"rect_{index + 1:03d}_{light}_r5000.png" for index in range(6) for light in (2, 3)]
    captures.write_pictures(folder / "Rectified/scan9", names)
    return folder, dict(zip(names[1::2], pixels.values(), strict=True))


def idr(folder: Path) -> tuple[Path, Pixels]:
    matrices, pixels = {}, {}
    for index, camera in enumerate(cameras()):
        lens = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # the centre of the first pixel is at 0, 0
        world = np.eye(4)
        world[:3] = 1.7 * lens @ np.linalg.inv(camera.world_from_camera)[:3]  # of any scale, and any sign
        matrices[f"world_mat_{index}"] = world * (-1 if index % 2 else 1)
        matrices[f"scale_mat_{index}"] = np.array([[2.0, 0, 0, 0.1], [0, 2.0, 0, 0.2], [0, 0, 2.0, 0.3], [0, 0, 0, 1]])
        p = world @ np.concatenate([POINTS, np.ones((9, 1))], 1).T
        pixels[f"{index:06d}.png"] = (p[:2] / p[2]).T + 0.5
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "cameras_sphere.npz", **matrices)
    captures.write_pictures(folder / "image", list(pixels))
    for index in range(6):
        captures.write_picture(folder / f"mask/{index:03d}.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    return folder, pixels


def nsvf(folder: Path) -> tuple[Path, Pixels]:
    pixels = {}
    for index, camera in enumerate(cameras()):
        stem = f"{index // 2}_train_{index:04d}"
        write(folder / f"pose/{stem}.txt", "\n".join(words(row) for row in camera.world_from_camera) + "\n")
        pixels[f"{stem}.png"] = pinhole(camera, 40, 40, 16, 12)
    write(folder / "intrinsics.txt", f"40. 16. 12. 0.\n0. 0. 0.\n0.\n1.\n{HEIGHT} {WIDTH}\n")
    write(folder / "bbox.txt", "-1 -1.5 -2 1 1.5 2 0.4\n")
    captures.write_pictures(folder / "rgb", list(pixels), channels=4)
    return folder, pixels


def tanks(folder: Path) -> tuple[Path, Pixels]:
    lines, pixels = [], {}
    for index, camera in enumerate(cameras()):
        lines += [f"{index} {index} 0", *(words(row) for row in camera.world_from_camera)]
        pixels[f"{index + 1:06d}.jpg"] = pinhole(camera, 40, 42, 15.5, 12.5)
    write(folder / "Barn_COLMAP_SfM.log", "\n".join(lines) + "\n")
    write(folder / "intrinsics.txt", "40 42 15.5 12.5\n")
    captures.write_pictures(folder / "images", list(pixels))
    return folder, pixels


# --- depth


def plane_depth(camera: Camera, width: int, height: int) -> np.ndarray:
    """(h, w) depth of the plane z = 0 along the view axis."""
    y, x = np.mgrid[0:height, 0:width] + 0.5
    pixels = np.stack([x.ravel() * camera.width / width, y.ravel() * camera.height / height], -1)
    origins, directions = rays(camera, pixels)
    distance = -origins[:, 2] / directions[:, 2]
    along = np.where(distance > 0, distance * (directions @ camera.forward), 0)
    return np.where(along < 20, along, 0).reshape(height, width)


def write_depth(path: Path, values: np.ndarray, unit: float = 0.001) -> None:
    captures.write_picture(path, np.clip(np.rint(values / unit), 0, 65535).astype(np.uint16))


EXPORTS: dict[str, tuple[str, Callable[[Path], tuple[Path, Pixels]]]] = {
    "polycam": ("polycam", polycam),
    "metashape": ("metashape", metashape),
    "realitycapture csv": ("realitycapture", realitycapture_csv),
    "realitycapture xmp": ("realitycapture", realitycapture_xmp),
    "opensfm": ("opensfm", opensfm),
    "record3d": ("record3d", record3d),
    "3d scanner app": ("3d-scanner-app", scanner_app),
    "kapture": ("kapture", kapture),
    "mvsnet": ("mvsnet", mvsnet),
    "blended mvs": ("mvsnet", lambda folder: mvsnet(folder, images="blended_images")),
    "dtu": ("mvsnet", dtu),
    "idr": ("idr", idr),
    "nsvf": ("nsvf", nsvf),
    "tanks and temples": ("tanks-and-temples", tanks),
    "scannet++": ("scannetpp", scannetpp),
}
