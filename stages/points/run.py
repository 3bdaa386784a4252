"""The points stage: points spread evenly over the mesh, with normals and colours, as PLY in the capture's frame."""

from efficientnerf.asset.format import outline
from efficientnerf.asset.tree import NerfTree
from efficientnerf.surface.mesh import Mesh, PointCloud, sampled
from efficientnerf.surface.nested import face_sizes
from pipeline.errors import StageFailed
from pipeline.stage import Job
from stages.artifacts import BakeOutputs, MeshOutputs, PointsOutputs
from stages.formats.exporters import POINT_EXPORTERS
from stages.formats.exporters.writing import SourceFrame, source_frame
from stages.memory.need import refuse_what_does_not_fit
from stages.mesh.files import mesh_bytes, read_mesh
from stages.points.memory import needed
from stages.points.settings import PointsSettings


def points_of(mesh: Mesh, tree: NerfTree, settings: PointsSettings, frame: SourceFrame) -> PointCloud:
    """Points on a tree's mesh, in the capture's frame; of the tree the grids alone count. Raises StageFailed where the mesh has no faces."""
    if not len(mesh.faces):
        raise StageFailed("points: the mesh has no faces. The asset is nearly empty: train longer, or set mesh.density_threshold by hand.")
    sizes = face_sizes(tree, frame.world_from_capture.points(mesh.vertices), mesh.faces)
    return sampled(mesh, settings.num_points, settings.seed, sizes)


def run(job: Job) -> None:
    mesh_files = MeshOutputs(job.inputs["mesh"])
    remedy = f"Lower points.num_points ({job.settings.num_points}) or mesh.max_faces."
    refuse_what_does_not_fit(job, needed(job.settings.num_points, mesh_bytes(mesh_files)), remedy)
    tree = outline(BakeOutputs(job.inputs["bake"]).asset)
    frame = source_frame(tree.metadata)
    mesh = read_mesh(mesh_files)
    job.safe_point()
    cloud = points_of(mesh, tree, job.settings, frame)
    job.safe_point()
    path = PointsOutputs(job.out).ply
    POINT_EXPORTERS[path.suffix](cloud, path, frame)
    job.say(f"{len(cloud.positions)} points", points=len(cloud.positions))
