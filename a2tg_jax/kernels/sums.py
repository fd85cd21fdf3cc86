"""Cotangents of splats, summed over threads that each composite a part of the tiles.

A splat's rows of the results belong to the first part that lists it. The few splats that a later part lists again, at
the borders between parts, have rows of that part beside them, which are added at the end, part by part. The sums are
those of ((part 0 + part 1) + part 2) + …, bit by bit, and no thread needs room for all splats.
"""

import itertools

import numpy as np

from a2tg_jax.kernels import threads

ROWS_PER_THREAD = 2_000
"""Fewer rows to be added than these are not worth another thread."""


class SumsOfParts:
    """The results, set to zero, and rows beside them, for one call.

    Args:
      ids: [pairs] splats.
      starts: [tiles + 1] where the pairs of each tile begin.
      images: [N, 3] first entry, height and width of each splat's image in the table; of another length without images.
      results: [N, S] of splats, [entries, C] of the table, and [N, 4], or [1, 4] where nobody asks for these.
      parts: ranges of tiles.
    """

    def __init__(self, ids: np.ndarray, starts: np.ndarray, images: np.ndarray, results, parts: list[threads.Span]):
        for result in results:
            result[...] = 0
        d_splats, d_table, d_tap = self.results = results
        spans = [(int(starts[first]), int(starts[last])) for first, last in parts]
        self.places, self.splats, self.borders = _places(ids, spans, len(d_splats))
        num = max(1, len(self.splats))
        self.more_splats = np.zeros((num, d_splats.shape[1]), d_splats.dtype)
        self.more_tap = np.zeros((num, d_tap.shape[1]), d_tap.dtype)
        has_images = d_table.shape[1] > 0 and len(images) == len(d_splats)
        self.images = images[self.splats] if has_images else np.zeros((0, 3), np.int32)
        areas = self.images[:, 1].astype(np.int64) * self.images[:, 2]
        self.is_shared = has_images and len(parts) > 1 and _overlap(images)
        if self.is_shared:
            self.tables = [d_table, *(np.zeros_like(d_table) for _ in parts[1:])]
            self.more_tables, self.more_first = self.tables, self.images[:, 0]
        else:
            self.ends = np.concatenate([[0], np.cumsum(areas)])
            self.tables = [d_table] * len(parts)
            self.more_tables = [np.zeros((max(1, self.ends[-1]), d_table.shape[1]), d_table.dtype)] * len(parts)
            self.more_first = self.ends[:-1]
        self.more_first = np.append(self.more_first, 0).astype(np.int32)

    def outputs(self, index: int) -> list[np.ndarray]:
        """What the loop adds to in a part, from `d_splats` on."""
        d_splats, _, d_tap = self.results
        more = self.more_splats, self.more_tables[index], self.more_tap, self.more_first
        return [d_splats, self.tables[index], d_tap, self.places, *more]

    def add_up(self) -> None:
        """Adds the further rows to the results, in the order of the parts."""
        for first, last in itertools.pairwise(self.borders):
            # A splat has at most one row of a part, so that threads may share these.
            spans = threads.even_spans(last - first, ROWS_PER_THREAD)
            threads.run_spans(self._add_rows, [(first + begin, first + end) for begin, end in spans])
        for table in self.tables[1:] if self.is_shared else ():
            self.results[1][...] += table

    def _add_rows(self, first: int, last: int, _: int) -> None:
        d_splats, d_table, d_tap = self.results
        splats = self.splats[first:last]
        d_splats[splats] += self.more_splats[first:last]
        if len(d_tap) == len(d_splats):
            d_tap[splats] += self.more_tap[first:last]
        if not self.is_shared and len(self.images):
            begins, ends = self.ends[first:last], self.ends[first + 1 : last + 1]
            entries = np.arange(self.ends[first], self.ends[last])
            more = self.more_tables[0][self.ends[first] : self.ends[last]]
            d_table[entries + np.repeat(self.images[first:last, 0] - begins, ends - begins)] += more


def _places(ids: np.ndarray, spans: list[threads.Span], num: int) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """The further row of every pair, −1 where it has none; the splat of every further row; where each part's end.

    Args:
      ids: [pairs] splats.
      spans: of the pairs of each part.
      num: splats.
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


def _overlap(images: np.ndarray) -> bool:
    """Whether two images share entries of the table."""
    first, area = images[:, 0].astype(np.int64), images[:, 1].astype(np.int64) * images[:, 2]
    both = np.sort(first << 32 | area)
    first, area = both >> 32, both & 0xFFFFFFFF
    return bool(np.any(first[:-1] + area[:-1] > first[1:]))
