"""Blocks straight from the files of a store: what zarr reads, or nothing."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat._shards import Shards
from chdstat._store import BLOCK
from chdstat.errors import StoreError


@pytest.mark.parametrize(("size", "spp"), [((70, 20), 64), ((16, 80), 96)])
def test_blocks_from_the_files_are_those_of_zarr(tmp_path, size, spp):
    path, (width, height) = tmp_path / "s.zarr", size
    samples = chd.render("cornell-box", spp=spp, size=size, out=path, backend="scalar")
    shards = Shards(path, samples.shape)
    for row, column in np.ndindex(-(-height // BLOCK), -(-width // BLOCK)):
        ys = slice(row * BLOCK, (row + 1) * BLOCK)
        xs = slice(column * BLOCK, (column + 1) * BLOCK)
        found = np.concatenate(shards.block(row, column), axis=-1)
        np.testing.assert_array_equal(found, samples.read(ys, xs))


def test_what_is_damaged_or_another_layout_is_left_to_zarr(tmp_path):
    own_store = tmp_path / "own.zarr"
    chd.render("cornell-box", spp=64, size=(32, 32), out=own_store, backend="scalar")
    shape = chd.open(own_store).shape
    assert Shards(own_store, shape).block(0, 0) is not None
    file = own_store / "radiance/c/0/0/0/0"
    whole = file.read_bytes()
    for place in (100, -3, -100):  # in a chunk, in the table's checksum, in the table
        broken = bytearray(whole)
        broken[place] ^= 0xFF
        file.write_bytes(broken)
        assert Shards(own_store, shape).block(0, 0) is None
    file.write_bytes(whole[:100])
    assert Shards(own_store, shape).block(0, 0) is None
    with pytest.raises(StoreError, match="cannot read"):
        chd.open(own_store).read(slice(0, 1), slice(0, 1))
    file.write_bytes(whole)
    meta = own_store / "radiance/zarr.json"
    meta.write_text(meta.read_text().replace('"end"', '"start"'))
    assert Shards(own_store, shape).block(0, 0) is None
