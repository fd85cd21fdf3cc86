/** Streaming reader for the body of a scene file. */

import { SceneError, fixedColumns } from "./format";
import type { Header } from "./format";

/** Columns of consecutive rows, encoded as in the file. */
export interface Chunk {
  /** Index of the first row. */
  readonly start: number;
  readonly num: number;
  /** [6, n] low bytes of x, y, z, then high bytes. */
  readonly means: Uint8Array;
  /** [9, n] log-scales u, v; quaternion x, y, z; opacity; degree 0: red − green, green, blue − green. */
  readonly numbers: Uint8Array;
  /** [n] degrees of the spherical harmonics. */
  readonly degrees: Uint8Array;
  /** [2, n] texture sizes Tv, Tu; zeros without textures. */
  readonly sizes: Uint8Array;
  /** [n] shapes of the kernels; zeros if all are Gaussians. */
  readonly shapes: Uint8Array;
  /** Band l ≥ 1 at index l − 1: [3, 2l + 1, m] red − green, green, blue − green of the m rows of degree ≥ l. */
  readonly bands: readonly Uint8Array[];
  /** [4, t]: red − green, green, blue − green, alpha. */
  readonly texels: Uint8Array;
}

/** Splits a stream of bytes into chunks. */
export class ChunkReader {
  private readonly header: Header;
  private row = 0;
  private numRead = 0;
  private fixed: Uint8Array | null = null;
  private buffer: Uint8Array;
  private filled = 0;

  constructor(header: Header) {
    this.header = header;
    this.buffer = new Uint8Array(this.fixedBytes);
  }

  /** Return the chunks that these bytes complete. */
  push(bytes: Uint8Array): Chunk[] {
    const found: Chunk[] = [];
    let place = 0;
    while (place < bytes.length) {
      if (this.row >= this.header.num) throw new SceneError("The scene is damaged: there is data after the last row.");
      const taken = Math.min(bytes.length - place, this.buffer.length - this.filled);
      this.buffer.set(bytes.subarray(place, place + taken), this.filled);
      place += taken;
      this.filled += taken;
      // The second part of a chunk may be empty, and is then complete at once.
      for (let i = 0; i < 2 && this.filled === this.buffer.length && this.row < this.header.num; i++) {
        const chunk = this.advance();
        if (chunk !== null) found.push(chunk);
      }
    }
    return found;
  }

  /** Throw a SceneError if rows are missing. */
  end(): void {
    if (this.row < this.header.num || this.numRead !== this.header.bytes) {
      throw new SceneError("The scene is cut off: rows are missing.");
    }
  }

  private get numRows(): number {
    return Math.min(this.header.chunk, this.header.num - this.row);
  }

  private get fixedBytes(): number {
    return fixedColumns(this.header) * this.numRows;
  }

  /** Handle a full buffer. The fixed columns give the size of the second part; the second part completes a chunk. */
  private advance(): Chunk | null {
    this.numRead += this.filled;
    const full = this.buffer;
    if (this.fixed === null) {
      this.fixed = full;
      const rest = this.restBytes(full);
      if (this.numRead + rest > this.header.bytes) {
        throw new SceneError("The scene is damaged: a chunk is larger than the rest of the body.");
      }
      this.room(rest);
      return null;
    }
    const chunk = this.chunkOf(this.fixed, full);
    this.row += chunk.num;
    this.fixed = null;
    this.room(this.fixedBytes);
    return chunk;
  }

  private room(bytes: number): void {
    this.buffer = new Uint8Array(bytes);
    this.filled = 0;
  }

  private parts(fixed: Uint8Array): Pick<Chunk, "means" | "numbers" | "degrees" | "sizes" | "shapes"> {
    const n = this.numRows;
    const { numTexels, hasShapes } = this.header;
    return {
      means: fixed.subarray(0, 6 * n),
      numbers: fixed.subarray(6 * n, 15 * n),
      degrees: fixed.subarray(15 * n, 16 * n),
      sizes: numTexels === null ? new Uint8Array(2 * n) : fixed.subarray(16 * n, 18 * n),
      shapes: hasShapes ? fixed.subarray(fixed.length - n) : new Uint8Array(n),
    };
  }

  private restBytes(fixed: Uint8Array): number {
    const { degrees, sizes } = this.parts(fixed);
    const { baseDegree, numBands } = this.header;
    if (degrees.some((degree) => degree < baseDegree || degree >= numBands)) {
      throw new SceneError("The scene is damaged: a spherical harmonics degree is out of range.");
    }
    return this.bandLengths(degrees).reduce((a, b) => a + b, 0) + 4 * numTexelsOf(sizes, this.numRows);
  }

  private bandLengths(degrees: Uint8Array): number[] {
    const counted = (least: number): number => {
      let count = 0;
      for (const degree of degrees) if (degree >= least) count++;
      return count;
    };
    return Array.from({ length: this.header.numBands - 1 }, (_, i) => 3 * (2 * i + 3) * counted(i + 1));
  }

  private chunkOf(fixed: Uint8Array, rest: Uint8Array): Chunk {
    const parts = this.parts(fixed);
    const bands: Uint8Array[] = [];
    let place = 0;
    for (const length of this.bandLengths(parts.degrees)) {
      bands.push(rest.subarray(place, place + length));
      place += length;
    }
    return { start: this.row, num: this.numRows, ...parts, bands, texels: rest.subarray(place) };
  }
}

function numTexelsOf(sizes: Uint8Array, num: number): number {
  let total = 0;
  for (let i = 0; i < num; i++) {
    const [height, width] = [sizes[i]!, sizes[num + i]!];
    if (height > 16 || width > 16 || (height === 0) !== (width === 0)) {
      throw new SceneError("The scene is damaged: a texture size is out of range.");
    }
    total += height * width;
  }
  return total;
}
