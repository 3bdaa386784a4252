"""Harmonics kept as codes into palettes."""

import numpy as np
import pytest

from efficientnerf.asset.palettes import PaletteHarmonics


def random_palette(count: int, groups: tuple[int, ...], *, entries: int = 7, seed: int = 0) -> PaletteHarmonics:
    rng = np.random.default_rng(seed)
    return PaletteHarmonics(
        base=rng.integers(0, 5, (count, 3)).astype(np.uint8),
        base_table=rng.normal(size=(5, 3)).astype(np.float32),
        codes=rng.integers(0, entries, (count, len(groups))).astype(np.uint16 if entries > 256 else np.uint8),
        palette=rng.normal(size=(entries, sum(groups), 3)).astype(np.float32),
        groups=groups,
    )


@pytest.mark.parametrize(("groups", "entries"), [((), 1), ((3,), 7), ((1, 1, 1), 256), ((3, 5), 300), ((1, 2, 12, 9), 9)])
def test_each_coefficient_is_its_entry(groups: tuple[int, ...], entries: int) -> None:
    codes = random_palette(50, groups, entries=entries)
    decoded = codes.decoded()
    assert decoded.shape == (len(codes), codes.count, 3)
    assert decoded.dtype == np.float32
    for n, k, c in np.ndindex(decoded.shape):
        group = next(g for g in range(len(groups)) if k <= sum(groups[: g + 1])) if k else None
        assert decoded[n, k, c] == (codes.base_table[codes.base[n, c], c] if group is None else codes.palette[codes.codes[n, group], k - 1, c])
    some = np.array([4, 0, 9])
    assert np.array_equal(codes.decoded(some), decoded[some])
    assert np.array_equal(codes.subset(some).decoded(), decoded[some])
