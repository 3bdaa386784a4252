"""From photographs to everything: the stages, in order."""

from __future__ import annotations

from stages import bake, evaluate, mesh, points, poses, train, turntable

STAGES = (
    poses.STAGE,  # the source -> cameras, images, sparse points
    train.STAGE,  # poses -> field, density voxels
    bake.STAGE,  # train, poses -> asset.nerftree
    evaluate.STAGE,  # bake, train, poses -> PSNR and SSIM of the network and of the asset
    turntable.STAGE,  # bake -> frames, video, EXR
    mesh.STAGE,  # bake -> PLY, GLB
    points.STAGE,  # bake -> PLY
)
