from efficientnerf.asset.camera_paths import turntable_cameras as turntable_cameras
from efficientnerf.asset.captured import MetadataError as MetadataError
from efficientnerf.asset.format import FormatError as FormatError
from efficientnerf.asset.format import load as load
from efficientnerf.asset.format import save as save
from efficientnerf.asset.rendering import Rendering as Rendering
from efficientnerf.asset.rendering import render as render
from efficientnerf.asset.rendering import render_rays as render_rays
from efficientnerf.asset.tree import NerfTree as NerfTree
from efficientnerf.geometry.cameras import Camera as Camera

__version__: str
__all__ = ["Camera", "FormatError", "MetadataError", "NerfTree", "Rendering", "__version__", "load", "render", "render_rays", "save", "turntable_cameras"]

BEGAN: float
