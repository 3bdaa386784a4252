"""A hostile file for each rule of FORMAT.md about whole scenes: nested grids, environment map, region."""

from collections.abc import Callable

import numpy as np

from tests.efficientnerf.damaged import NESTED, added, beyond_the_last_cell, cascade, header_with, meta_with, region, shells, tensor, with_tensor, without

SCENES: dict[str, tuple[Callable[[], bytes], str]] = {
    # nested grids
    "nested, no cascades": (lambda: meta_with(NESTED[0], cascades="absent"), "'cascades' is None; expected a list of at most 15 objects"),
    "cascades of text": (lambda: meta_with(NESTED[0], cascades="two"), "'cascades' is two; expected a list"),
    "cascades of numbers": (lambda: meta_with(NESTED[0], cascades=[2]), r"'cascades' is \[2\]; expected a list of at most 15 objects"),
    "seventeen cascades": (lambda: shells(17, 4), "expected a list of at most 15 objects"),
    "a cascade without shape": (lambda: cascade(shape="absent"), r"'shape' is None; expected 3 numbers .*\(cascade 1\)"),
    "a cascade of fractional shape": (lambda: cascade(shape=[4, 4, 4.5]), r"expected whole numbers .*\(cascade 1\)"),
    "a cascade of nothing": (lambda: cascade(shape=[4, 0, 4]), r"'shape' is \[4, 0, 4\]; expected 3 numbers from 1"),
    "a cascade too large": (lambda: cascade(shape=[65536] * 3), r"a product of at most 1073741824 \(cascade 1\)"),
    "cascades too large together": (lambda: shells(10, 512), "cascades of 1342177280 coarse cells; expected at most 1073741824 in all"),
    "a cascade without corner": (lambda: cascade(bounds_min="absent"), r"'bounds_min' is None; expected 3 numbers .*\(cascade 1\)"),
    "a cascade beyond what floats resolve": (lambda: cascade(bounds_min=[0, 0, 1e20]), "'bounds_min'"),
    "a cascade off its cells": (lambda: cascade(bounds_min=[-0.95, 0, -1.3]), "the box of cascade 0 does not lie on faces of the coarse cells of cascade 1"),
    "a cascade beside the one before": (lambda: cascade(bounds_min=[-0.5, 0, -1.3]), "cascade 1 does not enclose cascade 0"),
    "a cascade that ends too early": (lambda: cascade(shape=[4, 4, 2]), "cascade 1 does not enclose cascade 0"),
    "a cascade of an odd number of cells": (lambda: meta_with(NESTED[0], shape=[4, 4, 3]), "the box of cascade 0 does not lie on faces"),
    "a cascade without cells": (lambda: without("coarse.occupancy.1", NESTED[0]), r"tensor 'coarse\.occupancy\.1' is missing"),
    "cells of no cascade": (lambda: meta_with(NESTED[0], cascades=[]), r"unknown tensor 'coarse\.occupancy\.1'"),
    "cells of a cascade in a layout of one grid": (lambda: added("coarse.occupancy.1"), r"unknown tensor 'coarse\.occupancy\.1'"),
    "too few cells of a cascade": (
        lambda: with_tensor("coarse.occupancy.1", np.zeros(7, "<u1"), NESTED[0]),
        r"'coarse\.occupancy\.1' has shape \(7,\); expected \(8,\)",
    ),
    "a cell beyond a cascade's last": (lambda: beyond_the_last_cell(), r"'coarse\.occupancy\.1' has bits set beyond its 36 cells"),
    "fewer cells than bricks in all cascades": (
        lambda: with_tensor("coarse.occupancy.1", np.zeros(8, "<u1"), NESTED[0]),
        "[0-9]+ occupied cells but [0-9]+ brick masks",
    ),
    "nested by its cascades alone": (lambda: meta_with(NESTED[0], layout="sparse"), "unknown tensor"),
    "nested by its layout alone": (lambda: meta_with(layout="nested-sparse"), "'cascades' is None; expected a list"),
    "nested in normalised device coordinates": (lambda: meta_with(NESTED[0], layout="nested-ndc-sparse"), "layout nested-ndc-sparse; this build reads"),
    "normalised device coordinates that are nested": (lambda: meta_with(NESTED[0], layout="ndc-nested-sparse"), "layout ndc-nested-sparse; this build reads"),
    "nested before nearest": (
        lambda: meta_with(NESTED[0], layout="nested-nearest-sparse", lookup="nearest"),
        "layout nested-nearest-sparse; this build reads",
    ),
    # environment map
    "nested, no word of an environment": (lambda: meta_with(NESTED[0], environment="absent"), "'environment' is missing; expected the rows of the map or null"),
    "an environment of no rows": (lambda: meta_with(NESTED[0], environment=0), "'environment' is 0; expected a whole number from 1 to 2048"),
    "an environment of too many rows": (lambda: meta_with(NESTED[0], environment=2049), "'environment' is 2049"),
    "an environment that is true": (lambda: meta_with(NESTED[0], environment=True), "'environment' is True"),
    "an environment without a map": (lambda: without("environment", NESTED[0]), "tensor 'environment' is missing"),
    "a map without an environment": (lambda: meta_with(NESTED[0], environment=None), "unknown tensor 'environment'"),
    "a map in a layout of one grid": (lambda: added("environment"), "unknown tensor 'environment'"),
    "a map of other rows": (lambda: meta_with(NESTED[0], environment=3), r"'environment' has shape \(2, 4, 3\); expected \(3, 6, 3\)"),
    "a square map": (lambda: with_tensor("environment", np.zeros((2, 2, 3), "<u1"), NESTED[0]), r"has shape \(2, 2, 3\); expected \(2, 4, 3\)"),
    "a map of halves": (lambda: header_with("environment", NESTED[0], dtype="I8"), "'environment' is I8; expected U8"),
    # region
    "a region of text": (lambda: meta_with(NESTED[0], region="front"), "'region' is front; expected an object"),
    "a region that is null": (lambda: meta_with(format_version="1.4", region=None), "'region' is None; expected an object"),
    "a region without bounds": (lambda: region(bounds="absent"), "'bounds' is None; expected 2 rows"),
    "a region of one corner": (lambda: region(bounds=[[0, 0, 0]]), "expected 2 rows"),
    "a region of short corners": (lambda: region(bounds=[[0, 0], [1, 1]]), "expected 3 numbers"),
    "a region from its greatest corner": (lambda: region(bounds=[[0, 0, 0], [1, -1, 1]]), "expected the least corner, then the greatest"),
    "a region without height": (lambda: region(bounds=[[0, 0, 0], [1, 1, 0]]), "expected the least corner, then the greatest"),
    "a region beyond what floats resolve": (lambda: region(bounds=[[0, 0, 0], [1, 1, 1e20]]), "'bounds'"),
    "a region of negative radius": (lambda: region(corner_radius=-0.1), "'corner_radius' is -0.1"),
    "a region without fade": (lambda: region(fade="absent"), "'fade' is None"),
    "a region of bricks, perhaps": (lambda: region(bricks=1), "'bricks' is 1; expected true or false"),
    "a region without its bricks": (lambda: without("x.region.bricks", NESTED[0]), r"tensor 'x\.region\.bricks' is missing"),
    "a region of other bricks": (
        lambda: with_tensor("x.region.bricks", np.zeros(9, "<u1"), NESTED[0]),
        r"'x\.region\.bricks' has shape \(9,\); expected \([0-9],\)",
    ),
    "a region of halves": (lambda: header_with("x.region.bricks", NESTED[0], dtype="I8"), r"'x\.region\.bricks' is I8; expected U8"),
    "a brick beyond the last": (
        lambda: with_tensor("x.region.bricks", tensor("x.region.bricks", NESTED[0]) | np.uint8(128), NESTED[0]),
        r"'x\.region\.bricks' has bits set beyond its [0-9]+ bricks",
    ),
}
