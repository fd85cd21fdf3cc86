"""Sparse voxels: blocks of 8 × 8 × 8, of which those near surfaces exist (host)."""

import numpy as np

SIDE = 8
"""Voxels along a side of a block."""
VOXELS = SIDE**3
OFFSET = 1 << 20
"""Largest block coordinate."""
BYTES_PER_BLOCK = VOXELS * (3 * 4 + 3 * 2)
LOCAL = np.stack(np.meshgrid(*[np.arange(SIDE, dtype=np.int32)] * 3, indexing="ij"), -1).reshape(-1, 3)
"""[VOXELS, 3] voxels within a block."""


class GridFullError(ValueError):
    """The memory budget has no room for the voxels."""


class BlockGrid:
    """Truncated signed distances and colours of voxels, with their weights.

    A block is named by its integer coordinates [3]: its voxels are 8·block to 8·block + 7. Memory is reserved for as
    many blocks as the budget has room for, and used as blocks are made.
    """

    def __init__(self, max_bytes: int):
        """Make an empty grid.

        Args:
          max_bytes: memory budget; blocks beyond it are refused.
        """
        self.capacity = max(1, int(max_bytes) // BYTES_PER_BLOCK)
        self.max_bytes = max_bytes
        self.num = 0
        self.distance = np.zeros((self.capacity, VOXELS), np.float32)
        """Weighted sums of distances, in units of the truncation."""
        self.weight = np.zeros((self.capacity, VOXELS), np.float32)
        """Sums of weights."""
        self.color = np.zeros((self.capacity, VOXELS, 3), np.float16)
        """Mean colours."""
        self.color_weight = np.zeros((self.capacity, VOXELS), np.float32)
        """Sums of the weights of colours."""
        self.coordinates = np.zeros((0, 3), np.int32)
        self._keys = np.zeros(0, np.int64)
        self._rows = np.zeros(0, np.int64)

    @property
    def num_bytes(self) -> int:
        """Bytes of the blocks that exist."""
        return self.num * BYTES_PER_BLOCK

    def find(self, blocks: np.ndarray) -> np.ndarray:
        """Return the rows [B] of blocks [B, 3]; -1 for those that do not exist."""
        keys = _keys_of(blocks)
        if not self.num:
            return np.full(len(keys), -1, np.int64)
        place = np.minimum(np.searchsorted(self._keys, keys), self.num - 1)
        return np.where(self._keys[place] == keys, self._rows[place], -1)

    def allocate(self, blocks: np.ndarray) -> np.ndarray:
        """Return the rows [B] of different blocks [B, 3], after making those that do not exist.

        Raises:
          GridFullError: if the memory budget has no room for them.
        """
        rows = self.find(blocks)
        new = np.flatnonzero(rows < 0)
        if self.num + len(new) > self.capacity:
            raise GridFullError(f"{self.max_bytes / 1e9:.3g} GB hold no more than {self.capacity:,} blocks of voxels")
        rows[new] = np.arange(self.num, self.num + len(new))
        self.num += len(new)
        self.coordinates = np.concatenate([self.coordinates, blocks[new].astype(np.int32)])
        keys = np.concatenate([self._keys, _keys_of(blocks[new])])
        order = np.argsort(keys, kind="stable")
        self._keys, self._rows = keys[order], np.concatenate([self._rows, rows[new]])[order]
        return rows


def unique_blocks(blocks: np.ndarray) -> np.ndarray:
    """Return the different blocks [B, 3] among blocks [P, 3]; those too far out are left out."""
    if len(blocks):  # Neighbouring pixels mostly repeat a block, and sorting is slow.
        is_new = np.r_[True, (blocks[1:] != blocks[:-1]).any(axis=1)]
        blocks = blocks[is_new]
    is_near = ((blocks > -OFFSET) & (blocks < OFFSET)).all(axis=1)
    keys = np.unique(_keys_of(blocks[is_near]))
    return np.stack([(keys >> shift & (2 * OFFSET - 1)) - OFFSET for shift in (42, 21, 0)], axis=-1).astype(np.int32)


def _keys_of(blocks: np.ndarray) -> np.ndarray:
    """Return [B] int64 names of blocks [B, 3], different for different ones."""
    x, y, z = blocks.astype(np.int64).T + OFFSET
    keys: np.ndarray = x << 42 | y << 21 | z
    return keys
