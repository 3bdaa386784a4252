"""Textures of meshes: an atlas, colours from photographs and from the asset, a normal map. Arrays in, arrays out.

`texture_of_asset` (of `texturing.asset`) takes all colours from a tree; `PhotographTexture` (of `texturing.photographs`) from photographs, one at a time.

F faces, V vertices, C charts, T texels, S x S texels of a texture, H x W pixels of a photograph.
"""
