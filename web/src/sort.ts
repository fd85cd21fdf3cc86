/** The order in which splats are drawn: by the depth of their means, as the trainer's renderer has it. */

import type { Row4 } from "./math";

const BUCKETS = 1 << 16;

/** Sorts any number of positions; room is kept between calls. */
export class DepthSorter {
  private keys = new Uint32Array(0);
  private order = new Uint32Array(0);
  private readonly counts = new Uint32Array(BUCKETS);

  /**
   * Indices of the first `num` of the positions [x, y, z, …] from the farthest to the nearest; of equally deep ones the
   * last comes first.
   *
   * @param row depth = row · (x, y, z, 1)
   */
  sort(means: Float32Array, num: number, row: Row4): Uint32Array<ArrayBuffer> {
    if (this.keys.length < num) {
      this.keys = new Uint32Array(num);
      this.order = new Uint32Array(num);
    }
    this.findKeys(means, num, row);
    const found = new Uint32Array(num);
    // Two passes of a stable counting sort; both go backwards through a descending order.
    this.pass(num, 0, null, this.order);
    this.pass(num, 16, this.order, found);
    return found;
  }

  /** Unsigned integers in the order of the depths. */
  private findKeys(means: Float32Array, num: number, [a, b, c, d]: Row4): void {
    const depths = new Float32Array(this.keys.buffer);
    for (let i = 0; i < num; i++) {
      depths[i] = a * means[3 * i]! + b * means[3 * i + 1]! + c * means[3 * i + 2]! + d;
      const bits = this.keys[i]!;
      this.keys[i] = bits & 0x80000000 ? ~bits : bits | 0x80000000;
    }
  }

  /** Descending by 16 bits; without a `from`, indices come from the last to the first. */
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
