# mypy: ignore-errors
"""Numba kernels: depth order of the records and their distribution to image tiles, without atomics."""

import numpy as np
from numba import njit, prange

RADIX_BITS = 11
RADIX = 1 << RADIX_BITS


@njit(cache=True)
def depth_order(rec, n, chunks, counts, keys, order, spare_keys, spare_order):
    """Stable order of the records by depth; returns their number M, the first M of `order` index `rec`.

    Least-significant-digit radix sort of the bits of z: positive floats sort like integers.
    """
    m = 0
    hist = np.zeros((3, RADIX), np.int64)
    depth_bits = rec.view(np.uint32)
    for c in range(chunks):
        start = n * c // chunks
        for k in range(start, start + counts[c]):
            key = depth_bits[k, 11]
            keys[m] = key
            order[m] = k
            hist[0, key & (RADIX - 1)] += 1
            hist[1, (key >> RADIX_BITS) & (RADIX - 1)] += 1
            hist[2, key >> (2 * RADIX_BITS)] += 1
            m += 1
    a_keys, a_order, b_keys, b_order = keys, order, spare_keys, spare_order
    for digit in range(3):
        shift = np.uint32(digit * RADIX_BITS)
        total = 0
        for d in range(RADIX):
            count = hist[digit, d]
            hist[digit, d] = total
            total += count
        for j in range(m):
            key = a_keys[j]
            d = (key >> shift) & np.uint32(RADIX - 1)
            at = hist[digit, d]
            hist[digit, d] = at + 1
            b_keys[at] = key
            b_order[at] = a_order[j]
        a_keys, a_order, b_keys, b_order = b_keys, b_order, a_keys, a_order
    for j in range(m):  # three passes end in the spare arrays
        order[j] = a_order[j]
    return m


@njit(parallel=True, cache=True)
def count_entries(order, m, box, tiles_x, tile_slot, parts, part_counts, entries_of):
    """Count, for every part of the depth order, the entries of each tile, and the tiles of each record.

    `tile_slot` (tiles,) position of a tile in the list that is drawn, or -1; `part_counts` (parts, slots).
    """
    slots = part_counts.shape[1]
    for part in prange(parts):
        for s in range(slots):
            part_counts[part, s] = 0
        for j in range(m * part // parts, m * (part + 1) // parts):
            k = order[j]
            found = 0
            for ty in range(box[k, 2], box[k, 3]):
                for tx in range(box[k, 0], box[k, 1]):
                    s = tile_slot[ty * tiles_x + tx]
                    if s >= 0:
                        part_counts[part, s] += 1
                        found += 1
            entries_of[k] = found


@njit(cache=True)
def prefix_sums(part_counts, n, chunks, counts, entries_of, tile_start, first_entry):
    """Turn counts into places: part_counts[p, s] becomes where part p writes in tile s; returns the total."""
    parts, slots = part_counts.shape
    total = 0
    for s in range(slots):
        tile_start[s] = total
        for p in range(parts):
            count = part_counts[p, s]
            part_counts[p, s] = total
            total += count
    tile_start[slots] = total
    at = 0
    for c in range(chunks):
        start = n * c // chunks
        for k in range(start, start + counts[c]):
            first_entry[k] = at
            at += entries_of[k]
        # The chunk's records are followed by a gap, so the end of its last record is written here.
        first_entry[start + counts[c]] = at
    return total


@njit(parallel=True, cache=True)
def fill_entries(order, m, box, tiles_x, tile_slot, parts, places, first_entry, entries):
    """Write the tile lists: `entries` (E, 2) int32 record and number of the entry, front to back in each tile."""
    for part in prange(parts):
        for j in range(m * part // parts, m * (part + 1) // parts):
            k = order[j]
            e = first_entry[k]
            for ty in range(box[k, 2], box[k, 3]):
                for tx in range(box[k, 0], box[k, 1]):
                    s = tile_slot[ty * tiles_x + tx]
                    if s >= 0:
                        at = places[part, s]
                        places[part, s] = at + 1
                        entries[at, 0] = k
                        entries[at, 1] = e
                        e += 1
