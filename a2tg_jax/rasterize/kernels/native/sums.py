"""Sums of the splats' cotangents over threads that each composite a part of the tiles.

A splat's row of the results belongs to the first part that lists it. The few splats that a later part lists again, at
the borders between parts, have extra rows of that part, which are added at the end, part by part. The sums equal
((part 0 + part 1) + part 2) + …, bit for bit, and no thread needs memory for all splats.
"""

import itertools

import numpy as np

from a2tg_jax.rasterize.kernels.native import threads

ROWS_PER_THREAD = 2_000
"""Least number of rows to add that is worth another thread."""


class SumsOfParts:
    """Results of one call, set to zero at first, and the extra rows of its parts.

    Args:
      ids: [pairs] splats.
      starts: [tiles + 1] start of each tile's pairs.
      regions: [N, 3] first texel, height and width of each splat's texture; of another length without textures.
      results: cotangents [N, S] of splats, [T, C] of texels, and [N, 4] of the probe, or [1, 4] without a statistic.
      parts: ranges of tiles.
    """

    def __init__(
        self,
        ids: np.ndarray,
        starts: np.ndarray,
        regions: np.ndarray,
        results: list[np.ndarray],
        parts: list[threads.Span],
    ):
        for result in results:
            result[...] = 0
        d_splats, d_texels, d_probe = self.results = results
        spans = [(int(starts[first]), int(starts[last])) for first, last in parts]
        self.places, self.splats, self.borders = _places(ids, spans, len(d_splats))
        num = max(1, len(self.splats))
        self.more_splats = np.zeros((num, d_splats.shape[1]), d_splats.dtype)
        self.more_probe = np.zeros((num, d_probe.shape[1]), d_probe.dtype)
        has_textures = d_texels.shape[1] > 0 and len(regions) == len(d_splats)
        self.regions = regions[self.splats] if has_textures else np.zeros((0, 3), np.int32)
        areas = self.regions[:, 1].astype(np.int64) * self.regions[:, 2]
        self.is_shared = has_textures and len(parts) > 1 and _overlap(regions)
        if self.is_shared:
            self.texels_of_parts = [d_texels, *(np.zeros_like(d_texels) for _ in parts[1:])]
            self.more_texels, self.more_first = self.texels_of_parts, self.regions[:, 0]
        else:
            self.ends = np.concatenate([[0], np.cumsum(areas)])
            self.texels_of_parts = [d_texels] * len(parts)
            self.more_texels = [np.zeros((max(1, self.ends[-1]), d_texels.shape[1]), d_texels.dtype)] * len(parts)
            self.more_first = self.ends[:-1]
        self.more_first = np.append(self.more_first, 0).astype(np.int32)

    def outputs(self, index: int) -> list[np.ndarray]:
        """Return the buffers that the backward pass adds to in a part, from `d_splats` on."""
        d_splats, _, d_probe = self.results
        more = self.more_splats, self.more_texels[index], self.more_probe, self.more_first
        return [d_splats, self.texels_of_parts[index], d_probe, self.places, *more]

    def add_up(self) -> None:
        """Add the extra rows to the results, in the order of the parts."""
        for first, last in itertools.pairwise(self.borders):
            # A splat has at most one extra row in a part, so that threads can divide them.
            spans = threads.even_spans(last - first, ROWS_PER_THREAD)
            threads.run_spans(self._add_rows, [(first + begin, first + end) for begin, end in spans])
        for texels in self.texels_of_parts[1:] if self.is_shared else ():
            self.results[1][...] += texels

    def _add_rows(self, first: int, last: int, _: int) -> None:
        d_splats, d_texels, d_probe = self.results
        splats = self.splats[first:last]
        d_splats[splats] += self.more_splats[first:last]
        if len(d_probe) == len(d_splats):
            d_probe[splats] += self.more_probe[first:last]
        if not self.is_shared and len(self.regions):
            begins, ends = self.ends[first:last], self.ends[first + 1 : last + 1]
            entries = np.arange(self.ends[first], self.ends[last])
            more = self.more_texels[0][self.ends[first] : self.ends[last]]
            d_texels[entries + np.repeat(self.regions[first:last, 0] - begins, ends - begins)] += more


def _places(ids: np.ndarray, spans: list[threads.Span], num: int) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Assign extra rows to the pairs of splats that an earlier part lists.

    Args:
      ids: [pairs] splats.
      spans: range of each part's pairs.
      num: number of splats.

    Returns:
      The extra row of every pair, −1 if it has none; the splat of every extra row; and the borders between the parts'
      extra rows.
    """
    places, is_listed, row = np.full(max(1, spans[-1][1]), -1, np.int32), np.zeros(num, bool), np.empty(num, np.int32)
    again: list[np.ndarray] = []
    borders = [0]
    for index, (first, last) in enumerate(spans):
        listed = ids[first:last]
        pairs = np.flatnonzero(is_listed[listed]) if index else np.zeros(0, np.int64)
        splats = np.unique(listed[pairs])
        row[splats] = borders[-1] + np.arange(len(splats), dtype=np.int32)
        places[first + pairs] = row[listed[pairs]]
        if index + 1 < len(spans):
            is_listed[listed] = True
        again.append(splats)
        borders.append(borders[-1] + len(splats))
    return places, np.concatenate(again), borders


def _overlap(regions: np.ndarray) -> bool:
    """Return whether two textures share texels."""
    first, area = regions[:, 0].astype(np.int64), regions[:, 1].astype(np.int64) * regions[:, 2]
    both = np.sort(first << 32 | area)
    first, area = both >> 32, both & 0xFFFFFFFF
    return bool(np.any(first[:-1] + area[:-1] > first[1:]))
