/** Depth order of splats: by the depth of their means, with the renderer's rule for ties. */

import type { Row4 } from "./math";

const BUCKETS = 1 << 16;

/** Sorts positions by depth. Buffers are reused between calls. */
export class DepthSorter {
  private keys = new Uint32Array(0);
  private order = new Uint32Array(0);
  private readonly counts = new Uint32Array(BUCKETS);

  /**
   * Return the indices, padded with zeros to a multiple of four, of the first `num` positions [x, y, z, …] from the farthest to the nearest. Among equal depths
   * the highest index comes first.
   *
   * @param row - gives the depth row · (x, y, z, 1)
   */
  sort(means: Float32Array, num: number, row: Row4): Uint32Array<ArrayBuffer> {
    if (this.keys.length < num) {
      this.keys = new Uint32Array(num);
      this.order = new Uint32Array(num);
    }
    this.findKeys(means, num, row);
    const found = new Uint32Array(4 * Math.ceil(num / 4));
    // A radix sort: two passes of a stable counting sort, both in descending order.
    this.pass(num, 0, null, this.order);
    this.pass(num, 16, this.order, found);
    return found;
  }

  /** Map depths to unsigned integers of the same order. */
  private findKeys(means: Float32Array, num: number, [a, b, c, d]: Row4): void {
    const depths = new Float32Array(this.keys.buffer);
    for (let i = 0; i < num; i++) {
      depths[i] = a * means[3 * i]! + b * means[3 * i + 1]! + c * means[3 * i + 2]! + d;
      const bits = this.keys[i]!;
      this.keys[i] = bits & 0x80000000 ? ~bits : bits | 0x80000000;
    }
  }

  /** Sort by 16 bits, descending and stable. If `from` is null, the indices start in reverse order. */
  private pass(num: number, shift: number, from: Uint32Array | null, to: Uint32Array): void {
    const { counts, keys } = this;
    counts.fill(0);
    for (let i = 0; i < num; i++) counts[(keys[i]! >>> shift) & (BUCKETS - 1)]!++;
    let place = 0;
    for (let bucket = BUCKETS - 1; bucket >= 0; bucket--) {
      const count = counts[bucket]!;
      counts[bucket] = place;
      place += count;
    }
    for (let i = 0; i < num; i++) {
      const index = from === null ? num - 1 - i : from[i]!;
      to[counts[(keys[index]! >>> shift) & (BUCKETS - 1)]!++] = index;
    }
  }
}
